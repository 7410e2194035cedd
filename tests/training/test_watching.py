"""Somebody looks on while a run is made: ends it, or takes it away."""

import json
from types import MappingProxyType

import pytest
from rich.console import Console

from benchmarks.same import different_rows, different_tensors
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.formats.run_files import read_metrics
from deepracer_exp.training.run import resume, train
from deepracer_exp.training.run_folder import RunFolder, is_held
from deepracer_exp.training.watching import TakenOver, copied

TINY = ("experiment=tiny", "tracking=off", "collector=in_process", "checkpoints.every=2")


class Eyes:
    """Does at an iteration what it was made for."""

    title = "trial 3"
    tags = MappingProxyType({"sweep.trial": "3"})

    def __init__(self, at, do):
        self.at, self.do, self.dir = at, do, None

    def begins(self, run_dir):
        self.dir = run_dir

    def sees(self, row):
        return self.do() if row["iteration"] == self.at else None


def take_away():
    raise TakenOver


def run(folder, watch, *overrides):
    experiment, composition = compose_experiment([*TINY, f"runs_dir={folder}", *overrides])
    return train(experiment, composition, Console(quiet=True), None, watch)


def test_a_run_that_its_watch_gives_up_is_hopeless_and_keeps_a_best_policy(tmp_path):
    outcome = run(tmp_path, Eyes(3, lambda: "median: slower than the others"))
    assert (outcome.status, outcome.reason) == ("hopeless", "median: slower than the others")
    rows = read_metrics(outcome.folder / "metrics.jsonl")
    assert [row["eval_completion"] is not None for row in rows] == [False, True, True]
    assert (outcome.folder / "checkpoints" / "best").exists()


def test_nothing_is_written_of_a_run_once_it_was_taken_over(tmp_path):
    eyes = Eyes(3, take_away)
    with pytest.raises(TakenOver):
        run(tmp_path, eyes)
    assert [row["iteration"] for row in read_metrics(eyes.dir / "metrics.jsonl")] == [1, 2]
    assert not (eyes.dir / "summary.json").exists()
    assert not is_held(eyes.dir)


def test_a_copy_goes_on_as_the_run_would_have_while_its_folder_is_held(tmp_path):
    eyes = Eyes(3, take_away)
    with pytest.raises(TakenOver):
        run(tmp_path / "cut", eyes)
    holder = RunFolder(eyes.dir)
    assert is_held(eyes.dir)
    copy = copied(eyes.dir, 2)
    assert copy.name == f"{eyes.dir.name}-attempt2"
    outcome = resume(copy, [], Console(quiet=True))
    assert outcome.status == "finished"
    whole = run(tmp_path / "whole", None).folder
    assert different_rows(*(read_metrics(one / "metrics.jsonl") for one in (whole, copy))) is None
    assert different_tensors(*(one / "checkpoints" / "last" for one in (whole, copy))) is None
    assert not (eyes.dir / "summary.json").exists()
    holder.release()


def test_a_copy_of_a_copy_has_one_attempt_in_its_name(tmp_path):
    first = run(tmp_path, None).folder
    assert copied(copied(first, 2), 3).name == f"{first.name}-attempt3"


def test_a_copy_is_another_run_of_mlflow(tmp_path):
    outcome = run(tmp_path, Eyes(0, None), "tracking=mlflow")
    before = json.loads((outcome.folder / "tracking.json").read_text())
    after = json.loads((copied(outcome.folder, 2) / "tracking.json").read_text())
    assert before["run_id"]
    assert before["tags"]["sweep.trial"] == "3"
    assert before["run_name"] == "trial 3"
    assert after["run_id"] is None
    assert after["tags"]["run_dir"].endswith("-attempt2")
    assert {**after["tags"], "run_dir": ""} == {**before["tags"], "run_dir": ""}
