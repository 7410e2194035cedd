"""Family trees, by function and by command."""

import json
import shutil

import pytest

from deepracer_exp.runs.lineage import best_members, family


def rows(stdout: str, *words: str) -> list[str]:
    return [line for line in stdout.splitlines() if all(word in line for word in words)]


@pytest.fixture
def clan(season):
    """An original, its two clones and a grandchild, and a run of another family."""
    root = season.run("1-root")
    season.result(root, (1, -11.0), 11.0)
    child = season.clone("2-child", root, algorithm={"lr": 0.0001})
    season.result(child, (1, -9.5), 9.5)
    season.result(season.clone("3-sibling", root), (0, 80.0), None, completion=80.0)
    grandchild = season.clone("4-grandchild", child, 2, "000030", algorithm={"lr": 1e-5})
    season.result(grandchild, (1, -10.0), 10.0)
    season.run("9-stranger")
    return season


def test_any_member_shows_the_whole_family_and_no_other(clan):
    for run in ("1-root", "3-sibling", "4-grandchild"):
        root = family(clan.runs_dir / "season" / run, clan.runs_dir)
        found = {member.name: member for member in root.walk()}
        assert list(found) == ["1-root", "2-child", "4-grandchild", "3-sibling"]
        assert [member.generation for member in found.values()] == [0, 1, 2, 1]
        assert found["4-grandchild"].changes == {"algorithm.lr": (0.0001, 1e-5)}
        assert best_members(root) == {id(found["2-child"]): "best by mean lap (usual)"}
    (alone,) = family(clan.runs_dir / "season" / "9-stranger", clan.runs_dir).walk()
    assert alone.name == "9-stranger"


def test_the_best_of_each_generation_stands_at_the_end(clan, call):
    ended = call("runs", "lineage", "3-sib")
    assert ended.code == 0, ended.stderr
    assert ended.stdout.splitlines()[-6:] == [
        "best of generation 0: season/1-root",
        "  mean usual lap 11.00 s, usual completion 90%",
        "best of generation 1: season/2-child",
        "  mean usual lap 9.50 s, usual completion 90%",
        "best of generation 2: season/4-grandchild",
        "  mean usual lap 10.00 s, usual completion 90%",
    ]


def test_the_tree_in_a_terminal_is_styled(clan, call, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "\x1b[1mseason/1-root" in call("runs", "lineage", "4-grandchild").stdout


def test_the_tree_in_a_pipe_says_what_a_terminal_shows_by_colour(clan, call):
    ended = call("runs", "lineage", "4-grandchild")
    assert rows(ended.stdout, "4-grandchild", "<- this run")
    assert rows(ended.stdout, "2-child", "* best by mean lap (usual)")
    assert len(rows(ended.stdout, "<- this run")) == len(rows(ended.stdout, "* best")) == 1
    assert rows(ended.stdout, "generation 2, from checkpoint 30")
    assert rows(ended.stdout, "mean usual lap 10.00 s, usual completion 90%")
    assert rows(ended.stdout, "algorithm.lr 0.0001 -> 1e-05")
    assert "\x1b" not in ended.stdout
    assert all(line == line.rstrip() for line in ended.stdout.splitlines())


@pytest.mark.parametrize(
    ("gone", "generation", "run", "relative", "stranger"),
    [
        ("2-child", 1, "4-grandchild", "4-grandchild", "1-root"),
        # Clones of one missing parent are one family.
        ("1-root", 0, "3-sibling", "4-grandchild", "9-stranger"),
    ],
)
def test_a_missing_parent_is_shown_as_missing(clan, call, gone, generation, run, relative, stranger):
    shutil.rmtree(clan.runs_dir / "season" / gone)
    ended = call("runs", "lineage", run)
    lines = ended.stdout.splitlines()
    assert lines[0] == f"season/{gone}"
    assert f"generation {generation}, missing: its folder was removed" in lines[1]
    assert rows(ended.stdout, relative)
    assert not rows(ended.stdout, stranger)


def test_a_family_that_moved_is_still_one(clan, call, tmp_path):
    clan.runs_dir.rename(tmp_path / "moved")
    ended = call("runs", "lineage", "4-grandchild", "runs_dir=moved")
    assert ended.code == 0, ended.stderr
    assert not rows(ended.stdout, "missing")
    assert rows(ended.stdout, "1-root")


def test_runs_elsewhere_bring_their_relatives_along(clan, call):
    run = clan.runs_dir / "season" / "2-child"
    ended = call("runs", "lineage", str(run), "runs_dir=nowhere")
    assert rows(ended.stdout, "4-grandchild")


def test_a_clone_on_another_track_has_a_best_of_its_own(clan, call):
    parent = clan.runs_dir / "season" / "2-child"
    there = clan.clone("5-away", parent, 2, track={"name": "bowtie", "knots": [1]})
    clan.result(there, (1, -20.0), 20.0)
    ended = call("runs", "lineage", "1-root")
    assert rows(ended.stdout, "5-away", "* best on bowtie by mean lap (usual)")
    assert rows(ended.stdout, "2-child", "* best on oval by mean lap (usual)")
    assert rows(ended.stdout, "track oval -> bowtie")
    lines = ended.stdout.splitlines()
    for best, lap in (("bowtie: season/5-away", "20.00 s"), ("oval: season/4-grandchild", "10.00 s")):
        assert lap in lines[lines.index(f"best of generation 2 on {best}") + 1]


def test_laps_of_the_training_count_where_nothing_was_evaluated(season, call):
    root = season.run("1")
    season.result(root, lap_share=0.5, best_lap_time_s=12.0, last={"completion": 61.0})
    season.result(season.clone("2", root), lap_share=0.9, best_lap_time_s=13.0)
    ended = call("runs", "lineage", "1")
    assert rows(ended.stdout, "exploring completion 61%, fastest exploring lap 12.00 s")
    assert rows(ended.stdout, "2", "* best by exploring laps")


def test_a_long_family_fits_120_columns(season, call):
    name = "20261126-111454-reinvent_base-progress_delta-seed0"
    best = {"iteration": 20, "metric": "race_score", "rank": [1, -105.06], "eval_race_score_s": 105.06}
    best |= {"eval_completion": 99.5, "eval_lap_share": 0.875, "eval_lap_time_s": 104.74}
    best |= {"held_out_completion": 100.0}
    parent = season.run(name)
    season.result(parent, **{"best": best})
    for generation in range(1, 5):
        parent = season.clone(f"{name}-clone{generation}", parent, generation, algorithm={"lr": generation})
        season.result(parent, **{"best": best})
    ended = call("runs", "lineage", parent.name)
    assert ended.code == 0, ended.stderr
    assert "105.06 s" in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 120


def test_many_changes_are_counted(season, call):
    root = season.run("1", algorithm={str(n): 0 for n in range(10)})
    season.clone("2", root, algorithm={str(n): 1 for n in range(10)}, status=None)
    ended = call("runs", "lineage", "1")
    assert "algorithm.5 0 -> 1, and 4 more" in " ".join(ended.stdout.split())
    assert rows(ended.stdout, "generation 1, from checkpoint 20, running or killed")


@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_run_that_descends_from_itself_is_refused(season, call, length):
    runs = [season.run(str(n)) for n in range(length)]
    for n, run in enumerate(runs):
        shutil.rmtree(run)
        season.clone(run.name, runs[n - 1])
    call("runs", "lineage", "0").assert_refused("descends from itself")
    season.run("apart")
    assert call("runs", "lineage", "apart").code == 0


WHOLE = {"parent": "1", "parent_dir": "/", "parent_run_id": None, "checkpoint": "000001", "sha256": ""}
WHOLE |= {"generation": 1, "registered": None}
WRONG = (("parent", "../x"), ("generation", 0), ("generation", "1"), ("checkpoint", "../000001"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *((text, "") for text in ("", "{", "[]", "{}", '{"parent": 1}')),
        *((json.dumps(WHOLE | {key: value}), f"{key}: ") for key, value in WRONG),
    ],
)
def test_a_lineage_file_that_is_none_is_refused_in_one_line(season, call, text, words):
    (season.run("1") / "lineage.json").write_text(text)
    ended = call("runs", "lineage", "1")
    ended.assert_refused(f"1/lineage.json: {words}")
    assert len(ended.stderr.splitlines()) == 1


def test_a_relatives_configuration_that_is_none_is_refused(clan, call):
    (clan.runs_dir / "season" / "3-sibling" / "config.yaml").write_text("- a")
    call("runs", "lineage", "1-root").assert_refused("3-sibling/config.yaml")


def test_a_changed_reward_is_seen_by_its_hash(season, call):
    for name, sha256 in (("1", "a" * 64), ("2", "b" * 64)):
        run = season.run(name) if name == "1" else season.clone(name, season.runs_dir / "season" / "1")
        (run / "provenance.json").write_text(json.dumps({"reward": {"sha256": sha256}, "git_commit": name}))
    ended = call("runs", "lineage", "1")
    assert rows(ended.stdout, "reward_function.py sha256 aaaaaaaa -> sha256 bbbbbbbb")
    assert "code" not in ended.stdout
