"""`deepracer-exp compare`: runs, groups of runs and logs beside each other."""

import csv
import io
import json
import re
import shutil
from pathlib import Path

import pytest

from tests.aws.made_up_logs import write_run_as_logs
from tests.page_html import Html
from tests.reports.tables.made_up_runs import made_up_run, made_up_seeds

LAPS = ("track=Straight_track", "action_space=deepracer", "reward=progress_delta", "budget.env_steps=16384")


@pytest.fixture
def run_dir(copied) -> Path:
    """A copy of a trained run of one's own, under `runs/tiny/`."""
    return copied(*LAPS)


@pytest.fixture
def logs(run_dir, tmp_path) -> str:
    """The run as logs of the service."""
    write_run_as_logs(run_dir, tmp_path / "from aws", "Straight_track")
    return "from aws"


@pytest.fixture(scope="module")
def made_up_study(tmp_path_factory) -> Path:
    """An experiment of two learning rates and five seeds."""
    folder = tmp_path_factory.mktemp("study")
    made_up_seeds(folder, ["algorithm.lr=1e-4"], 9.0)
    made_up_seeds(folder, ["algorithm.lr=1e-3"], 8.0)
    return folder


@pytest.fixture
def study(made_up_study, tmp_path) -> Path:
    """A copy of it under `runs/`."""
    return shutil.copytree(made_up_study, tmp_path / "runs" / "study")


def page_of(path: Path) -> Html:
    return Html(path.read_text(encoding="utf-8"))


def lines(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_an_experiment_is_compared_by_what_differs_besides_the_seed(study, call):
    ended = call("compare", "runs/study")
    assert ended.code == 0, ended.stderr
    said = lines(ended.stdout)
    (verdict,) = (line for line in said if line.startswith("algorithm.lr=1e-4 against algorithm.lr=1e-3: "))
    assert re.search(r"slower by 1.00 s a lap \(0.\d\d to 1.\d\d, not chance\); as sure; as robust", verdict)
    assert any(line.startswith("algorithm.lr=1e-3 5 8.00 (") for line in said)
    assert said[-1] == "page study-comparison.html"
    page = page_of(ended.cwd / "study-comparison.html")
    assert {"figure-learning_curves", "figure-best_checkpoints"} <= set(page.ids)
    assert not page.loads
    for line in said[:3]:
        assert line in page.text
    # The verdict comes first, what differs after it.
    places = [page.text.index(words) for words in (verdict, "algorithm.lr 0.001 0.0001", "8.00 (")]
    assert places == sorted(places)


def test_experiments_and_groups_of_ones_own_keep_their_names(study, call, tmp_path):
    made_up_seeds(tmp_path / "runs" / "other", [], 7.0)
    said = call("compare", "other", "study").stdout
    assert "study: algorithm.lr=1e-3 against other: slower by 1.00 s a lap (" in said
    names = [one.name for one in sorted(study.iterdir())]
    ended = call("compare", f"mine={names[0]},{names[1]}", f"theirs={','.join(names[5:])}", "-o", "mine.html")
    assert ended.code == 0, ended.stderr
    assert (
        "theirs against mine: slower by 1.08 s a lap; as sure; as robust. Too few runs to tell"
        in ended.stdout
    )
    assert "mine, theirs compared" in page_of(tmp_path / "mine.html").text


def test_single_runs_stand_side_by_side(call, tmp_path):
    made_up_run(tmp_path / "runs" / "e" / "first", ["seed=1", "algorithm.lr=1e-4"], 10.0)
    made_up_run(tmp_path / "runs" / "e" / "second", ["seed=2", "algorithm.lr=1e-3"], 9.25)
    ended = call("compare", "first", "second", "-o", "out.html")
    assert ended.code == 0, ended.stderr
    said = lines(ended.stdout)
    text = page_of(tmp_path / "out.html").text
    for row in ("A runs/e/first", "seed 1 2", "algorithm.lr 0.0001 0.001", "mean usual lap, s 10.00 9.25"):
        assert row in said
        assert row in text
    verdict = (
        "algorithm.lr=1e-3 (B) against algorithm.lr=1e-4 (A): faster by 0.75 s a lap; as sure; as robust."
    )
    assert verdict in ended.stdout
    assert verdict in text
    assert "nothing says how much of a difference is chance" in ended.stdout
    # Alike but for their seed, they are one group.
    made_up_run(tmp_path / "runs" / "e" / "third", ["seed=3", "algorithm.lr=1e-3"], 9.0)
    said = lines(call("compare", "second", "third").stdout)
    assert "best checkpoint 10 10" in said
    assert any(line.startswith("default 2") for line in said)


def test_of_many_groups_the_best_are_shown(call, tmp_path):
    for number in range(15):
        made_up_run(
            tmp_path / "runs" / "s" / f"run{number}", [f"algorithm.lr={1 + number}e-4"], 20.0 - number
        )
    said = call("compare", "s").stdout
    assert "15 groups: shown are the 12 with the best race score." in said
    assert "runs/s/run14" in said
    assert "runs/s/run2\n" not in said.replace(" \n", "\n")


def test_the_curves_are_exported(study, call):
    rows = list(csv.DictReader(io.StringIO(call("compare", "study", "--format", "csv").stdout)))
    laps = [row for row in rows if row["curve"] == "eval_lap_time_s" and row["group"] == "algorithm.lr=1e-3"]
    assert [float(row["iqm"]) for row in laps] == [12, 11, 10, 9, 8]
    assert {row["runs"] for row in laps} == {"5"}
    ended = call("compare", "study", "--format", "json")
    assert {one["name"] for one in json.loads(ended.stdout)["groups"]} == {
        "algorithm.lr=1e-4",
        "algorithm.lr=1e-3",
    }
    assert not list(ended.cwd.glob("*.html"))


def test_logs_are_compared_by_what_analyze_says_of_each(call, reference, tmp_path):
    inputs = reference / "inputs/fourth"
    slow, fast = (str(inputs / f"05-compare-two-logs/{name}-robomaker.log") for name in "ab")
    evaluated = str(inputs / "02-evaluated-checkpoint")
    ended = call("compare", slow, fast, evaluated, "-o", "logs.html")
    assert ended.code == 0, ended.stderr
    said = page_of(tmp_path / "logs.html").text
    for log in (slow, fast, evaluated):
        lines = call("analyze", log, "-o", "one.html").stdout.splitlines()
        (headline,) = [line.rpartition(": ")[2].strip() for line in lines if "control steps" in line][:1]
        assert headline in said
        assert not headline.startswith("0 control steps")
    assert "1_Step-265: 3 of 3 laps, 10.10 s" in said


def test_runs_and_several_logs_show_how_they_learned(run_dir, logs, call, tmp_path):
    shutil.copytree(tmp_path / logs, tmp_path / "more")
    ended = call("compare", str(run_dir), logs, "more", "-o", "all.html")
    assert ended.code == 0, ended.stderr
    page = page_of(tmp_path / "all.html")
    assert "figure-recordings_compared" in page.ids
    assert run_dir.name in ended.stdout
    assert "more" in page.text
    assert call("compare", logs, "more", "--replay", "laps.html").code == 0
    assert (tmp_path / "laps.html").is_file()


def test_a_run_and_its_clone_are_generations(run_dir, call):
    lineage = {"parent": run_dir.name, "parent_dir": str(run_dir), "parent_run_id": None}
    lineage |= {"checkpoint": "000010", "sha256": "0" * 64, "generation": 1, "registered": None}
    clone = shutil.copytree(run_dir, run_dir.parent / "clone", symlinks=True)
    (clone / "lineage.json").write_text(json.dumps(lineage))
    ended = call("compare", run_dir.name, "clone", "-o", "family.html")
    assert ended.code == 0, ended.stderr
    assert "figure-generations" in page_of(ended.cwd / "family.html").ids
    shutil.rmtree(clone / "trace")
    assert call("compare", run_dir.name, "clone", "-o", "family.html").code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["first"], "1 run and 0 logs; accepted: two or more"),
        (["first", "runs/e/first"], "1 run and 0 logs"),
        (["first", "third"], "third: no such file or folder, and no run: no such run"),
        (
            ["first", "second", "-o", "nowhere/out.html"],
            "--output nowhere/out.html: its folder does not exist",
        ),
        (["first", "second", "--track", "Oval_track"], "--track Oval_track: accepted with logs only"),
        (["first", "second", "--replay", "laps.mp4"], "--replay laps.mp4: accepted: the name of a page"),
        (["first", "empty"], "empty/metrics.jsonl: has no iteration"),
    ],
)
def test_what_cannot_be_compared_is_refused(call, tmp_path, arguments, words):
    for name in ("first", "second", "empty"):
        made_up_run(tmp_path / "runs" / "e" / name)
    (tmp_path / "runs" / "e" / "empty" / "metrics.jsonl").write_text("")
    call("compare", *arguments).assert_refused(words)
    assert not list(tmp_path.glob("*.html"))


@pytest.mark.parametrize("options", [(), ("--format", "csv"), ("--replay", "laps.html")])
def test_of_an_experiment_runs_without_an_iteration_are_left_out(call, tmp_path, options):
    for name in ("first", "second"):
        made_up_run(tmp_path / "runs" / "e" / name)
    (tmp_path / "runs" / "e" / "second" / "metrics.jsonl").write_text("")
    call("compare", "e", *options).assert_refused("e: 1 run with an iteration; accepted: two or more")
