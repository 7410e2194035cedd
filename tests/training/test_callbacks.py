"""Own callbacks: they end a run, add to it, or find that another process has taken it over."""

import json

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.runs.folder import RunFolder, is_held
from deepracer_exp.runs.run_files import read_metrics, read_run_id
from deepracer_exp.runs.run_result import STOPPED_EARLY, fastest_reliable
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.training.plan import plan_resume, plan_training
from deepracer_exp.training.run import copy_run, run_training
from deepracer_exp.training.train_result import TakenOver
from deepracer_exp.training.trainer import Callback
from tests.conftest import IN_PROCESS, OFTEN

from .conftest import assert_same_run

TINY = (*IN_PROCESS, *OFTEN, "budget.env_steps=null", "budget.iterations=4")


class At(Callback):
    """Calls a function after an iteration."""

    def __init__(self, iteration, do):
        self.iteration, self.do, self.dir = iteration, do, None

    def on_fit_start(self, trainer):
        self.dir = trainer.folder.path

    def on_iteration_end(self, trainer):
        if trainer.iteration == self.iteration:
            self.do(trainer)


def take_away(trainer):
    raise TakenOver


def run(folder, callback, *overrides, **options):
    plan = plan_training(*compose_experiment([*TINY, f"runs_dir={folder}", *overrides]))
    return run_training(plan, callbacks=[callback] if callback else (), **options)


def test_a_run_that_a_callback_stops_early_keeps_a_best_policy(tmp_path):
    callback = At(3, lambda trainer: trainer.request_stop("median: slower than the others", STOPPED_EARLY))
    outcome = run(tmp_path, callback)
    assert (outcome.status, outcome.reason) == ("stopped early", "median: slower than the others")
    rows = read_metrics(outcome.folder / "metrics.jsonl")
    assert [row["eval_completion"] is not None for row in rows] == [False, True, True]
    assert (outcome.folder / "checkpoints" / "best").exists()


class MadeUpLaps(Callback):
    """Replaces the evaluated laps of each iteration by reliable ones of made-up times."""

    times_s = (7.0, 5.0, 6.0, 6.5)

    def on_iteration_end(self, trainer):
        laps = {"eval_lap_share": 1.0, "eval_laps": 8, "eval_laps_tried": 8}
        trainer.row |= laps | {"eval_lap_time_s": self.times_s[trainer.iteration - 1]}


def test_the_fastest_reliable_checkpoint_is_kept_whatever_is_the_best(tmp_path):
    often = ("checkpoints.every=1", "checkpoints.keep=1", "budget.iterations=3")
    outcome = run(tmp_path, MadeUpLaps(), *often)
    link = outcome.folder / "checkpoints" / "fastest"
    assert link.readlink().name == "000002"
    plan = plan_resume(outcome.folder, ["budget.iterations=4"])
    assert run_training(plan, callbacks=[MadeUpLaps()]).status == "finished"
    assert link.readlink().name == "000002"
    lap = fastest_reliable(read_metrics(outcome.folder / "metrics.jsonl"))
    assert str(lap) == "checkpoint 2, 5.00 s, 8 of 8"
    chosen = StoredRun(outcome.folder).with_policy("fastest").read_policy()
    assert chosen.counters["iteration"] == lap.iteration


def test_nothing_is_written_of_a_run_once_it_was_taken_over(tmp_path):
    callback = At(3, take_away)
    with pytest.raises(TakenOver):
        run(tmp_path, callback)
    assert [row["iteration"] for row in read_metrics(callback.dir / "metrics.jsonl")] == [1, 2]
    assert not (callback.dir / "summary.json").exists()
    assert not is_held(callback.dir)


def test_a_copy_continues_as_the_run_would_have_while_its_folder_is_held(tmp_path):
    callback = At(3, take_away)
    with pytest.raises(TakenOver):
        run(tmp_path / "cut", callback)
    holder = RunFolder(callback.dir)
    assert is_held(callback.dir)
    copy = copy_run(callback.dir, 2)
    assert copy.name == f"{callback.dir.name}-attempt2"
    outcome = run_training(plan_resume(copy, []))
    assert outcome.status == "finished"
    whole = run(tmp_path / "whole", None).folder
    assert_same_run(whole, copy)
    assert not (callback.dir / "summary.json").exists()
    holder.release()


@pytest.mark.processes
def test_a_copy_of_a_copy_is_another_run_of_mlflow_and_has_one_attempt_in_its_name(tmp_path, mlflow_here):
    one = ("tracking=mlflow", "budget.iterations=1")
    first = run(tmp_path / "runs", None, *one, run_name="trial 3", tags={"sweep.trial": "3"}).folder
    before = json.loads((first / "tracking.json").read_text())
    assert read_run_id(first)
    assert (before["run_name"], before["tags"]["sweep.trial"]) == ("trial 3", "3")
    copy = copy_run(copy_run(first, 2), 3)
    after = json.loads((copy / "tracking.json").read_text())
    assert (read_run_id(copy), after["tags"]["run_dir"]) == (None, str(copy.resolve()))
    assert copy.name == f"{first.name}-attempt3"
    old, new = str(first.resolve()), str(copy.resolve())
    assert after["tags"] == {key: value.replace(old, new) for key, value in before["tags"].items()}
    assert f"Run folder: `{new}`" in after["tags"]["mlflow.note.content"]


def test_a_callback_adds_a_column_to_the_metrics(tmp_path):
    outcome = run(tmp_path, At(2, lambda trainer: trainer.row.update(mine=1.5)))
    assert [row.get("mine") for row in read_metrics(outcome.folder / "metrics.jsonl")] == [
        None,
        1.5,
        None,
        None,
    ]
