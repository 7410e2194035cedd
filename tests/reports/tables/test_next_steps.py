"""What to do next with a run, as commands to paste."""

import shlex
import shutil

import pytest
import yaml

from deepracer_exp.runs.next_steps import next_steps, own_word, run_word
from deepracer_exp.runs.run_files import read_object
from deepracer_exp.tracking.resolve import resolve


@pytest.fixture
def runs(copied, monkeypatch):
    """Return two equal runs of one experiment, of which the later one is the best, in the folder's `runs`."""
    first = copied()
    monkeypatch.chdir(first.parents[2])
    later = first.with_name(first.name.replace(first.name[:15], "20990101-000000"))
    shutil.copytree(first, later, symlinks=True)
    return first, later


def test_a_word_names_one_run_though_another_experiment_has_a_run_of_the_same_second(runs):
    first, later = runs
    other = first.parents[1] / "other" / first.name
    shutil.copytree(first, other, symlinks=True)
    assert run_word(later) == f"best:{later.parent.name}"
    assert run_word(first) == own_word(first) == f"runs/{first.parent.name}/{first.name}"
    for run in (*runs, other):
        for word in (run_word(run), own_word(run)):
            assert resolve(word, first.parents[1], None).path.samefile(run)


def test_a_run_elsewhere_is_named_by_its_folder(runs, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert run_word(runs[0].absolute()) == str(runs[0].absolute())


def test_a_policy_for_the_car_is_raced_as_the_car_and_exported(runs):
    run = runs[1]
    config = yaml.safe_load((run / "config.yaml").read_text())
    plain = [line for line, _ in next_steps(run, read_object(run / "summary.json"))]
    config["evaluation"]["real_car"] = {"picture": {"jpeg_quality": 95}, "timing": None, "controls": None}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    first, second, *others = [line for line, _ in next_steps(run, read_object(run / "summary.json"))]
    assert first == f"deepracer-exp evaluate {run_word(run)} evaluation=real_car"
    assert second == f"deepracer-exp export {run_word(run)} format=car"
    assert [line.split()[1] for line in others] == [line.split()[1] for line in plain[1:]]


def test_what_ended_a_run_decides_which_step_is_the_first(runs):
    run = runs[1]
    summary = {**read_object(run / "summary.json"), "limit": None}
    lines = {
        rule: next_steps(run, {**summary, "rule": rule}) for rule in ("reliable", "overfitting", "converged")
    }
    first = {rule: some[0][0] for rule, some in lines.items()}
    assert first["reliable"] == f"deepracer-exp resume {own_word(run)} stopping=entropy"
    second_phase = f"deepracer-exp clone {run_word(run)} randomization=sim2real budget.env_steps=1000000"
    assert first["overfitting"] == second_phase
    assert second_phase in [line for line, _ in lines["converged"]]
    # A clone has had its second phase.
    (run / "lineage.json").write_text("{}")
    steps = [line for line, _ in next_steps(run, {**summary, "rule": "converged"})]
    assert f"deepracer-exp clone {run_word(run)}" in steps
    assert second_phase not in steps
    (run / "lineage.json").unlink()
    assert first["converged"] == f"deepracer-exp evaluate {run_word(run)}"
    assert [line.split()[1] for line, _ in lines["overfitting"]].count("clone") == 1
    # What is trained on changing conditions alone is not advised to be.
    config = yaml.safe_load((run / "config.yaml").read_text())
    for share, offered in ((0.5, True), (1.0, False)):
        config["randomization"] |= {"friction_scale": [0.8, 1.2], "car_share": share}
        (run / "config.yaml").write_text(yaml.safe_dump(config))
        steps = [line for line, _ in next_steps(run, {**summary, "rule": "overfitting"})]
        assert steps[0] == (second_phase if offered else first["converged"])
        assert (second_phase in steps) is offered


@pytest.mark.parametrize(
    ("lr_schedule", "algorithm", "held"),
    [
        ({"kind": "constant", "by": "fraction"}, {"entropy_end_factor": 1.0}, None),
        ({"kind": "linear", "by": "iteration"}, {"entropy_end_factor": 1.0}, None),
        ({"kind": "linear", "by": "fraction"}, {"entropy_end_factor": 1.0}, "learning rate"),
        ({"kind": "constant", "by": "fraction"}, {"entropy_end_factor": 0.0}, "entropy bonus"),
        ({"target": "my:Own"}, {"entropy_end_factor": 0.0}, "learning rate and entropy bonus"),
    ],
)
def test_as_long_again_holds_what_follows_the_budget(runs, lr_schedule, algorithm, held):
    run = runs[0]
    config = yaml.safe_load((run / "config.yaml").read_text())
    config |= {"lr_schedule": lr_schedule, "algorithm": config["algorithm"] | algorithm}
    config["budget"]["env_steps"] = 1000
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    spent = {"status": "finished", "limit": "env_steps", "env_steps": 1024}
    line, what = next_steps(run, {**read_object(run / "summary.json"), **spent})[-1]
    words = [word for word in shlex.split(line) if word.startswith("budget.")]
    assert words[0] == "budget.env_steps=2048"
    # 1,000 of 2,048, rounded down: the schedule had come to its end by then.
    assert words[1:] == ([] if held is None else ["budget.schedule_until=0.4882"])
    assert what == "continue it for as long again" + (f", holding {held}" if held else "")


def test_the_fastest_reliable_checkpoint_is_a_command_away_where_it_is_not_the_best(runs):
    run = runs[1]
    summary = read_object(run / "summary.json")
    link = run / "checkpoints" / "fastest"
    for target, offered in (("best", False), ("000000", True)):
        (run / "checkpoints" / "000000").mkdir(exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        lines = [line for line, _ in next_steps(run, summary)]
        assert (f"deepracer-exp evaluate {run_word(run)} checkpoint=fastest" in lines) is offered


@pytest.mark.parametrize(
    ("limit", "spent_s", "more"),
    [(1.5, 90.4, "3"), (0.5, 30.9, "1"), (10.0, 603.0, "20"), (0.05, 3.4, "0.11"), (120, 7201.0, "240")],
)
def test_as_long_again_is_twice_the_minutes_used(runs, limit, spent_s, more):
    run = runs[0]
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("minutes: null", f"minutes: {limit}", 1))
    reason = {"status": "finished", "limit": "minutes", "wall_clock_s": spent_s}
    line, what = next_steps(run, {**read_object(run / "summary.json"), **reason})[-1]
    assert what == "continue it for as long again"
    minutes = [word for word in shlex.split(line) if word.startswith("budget.minutes=")]
    assert minutes == [f"budget.minutes={more}"]
