"""The last stage of a sweep: its best trial is cloned, and the clone races the best and the second best one.

It runs in the process of the sweep itself, once the workers have ended, with all cores.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
from filelock import FileLock, Timeout
from optuna.trial import FrozenTrial

from deepracer_exp.errors import RunFailed
from deepracer_exp.evaluation.results import HELD_OUT, USUAL
from deepracer_exp.reports.pages.run_page import RunReport
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.run_files import is_run
from deepracer_exp.runs.run_result import FAILED, INTERRUPTED
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sweeps.report.best_trial import (
    best_trial,
    complete_trials,
    has_runs,
    reranked,
    run_of,
)
from deepracer_exp.tracking.metadata import STUDY
from deepracer_exp.training.budget import RunEnded
from deepracer_exp.training.clone import plan_clone
from deepracer_exp.training.plan import ResumePlan, TrainPlan, plan_resume
from deepracer_exp.training.run import run_training
from deepracer_exp.training.trainer import Callback, Trainer

from .fresh_laps import drive_fresh, fresh, interval_of
from .queue.claims import Claim
from .queue.worker_config import WorkerConfig
from .report.last_race import LastRace, Racer, clone_words, store_last_race
from .report.view import SweepView
from .search.objectives import objective_values
from .trial import Interrupted

_CLONE = "clone_run"
"""Attribute of a study in Optuna: the clone's parent, overrides and run."""
_LOCK = ".last_stage.lock"
_LOOK_S = 0.5


class LastStage:
    """Clones the best trial of a study, and lets the clone race."""

    def __init__(
        self,
        config: WorkerConfig,
        study: optuna.Study,
        stored: bool,
        view: SweepView,
        claims: Callable[[], Sequence[Claim]],
        check: Callable[..., None],
    ):
        """Do nothing yet.

        Args:
            config: of the sweep; `config.config.clone` has the overrides of the clone.
            study: all its trials have ended, and one is complete.
            stored: whether these overrides come from the study, not from the user.
            view: of the sweep.
            claims: reads the trials for the view.
            check: raises `Interrupted` where the process was asked to end.
        """
        self._config, self._study, self._stored = config, study, stored
        self._view, self._claims, self._check = view, claims, check

    def run(self) -> LastRace:
        """Train the clone as far as it is missing, and let it race; store and return the result.

        Two sweeps of one study take turns: the second one finds the clone that the first one has made.

        Raises:
            BadInput: the best trial cannot be cloned so.
            RunFailed: the training of the clone failed.
            Interrupted: the process was asked to end; the next start of the sweep resumes here.
        """
        with self._alone():
            best = best_trial(self._study)
            race = self._raced(best, self._cloned(best))
            store_last_race(self._study, race)
        self._show("")
        return race

    def _show(self, stage: str) -> None:
        self._check()
        self._view.show(self._claims(), stage)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        lock = FileLock(self._config.folder / _LOCK, timeout=_LOOK_S)
        while not lock.is_locked:
            with contextlib.suppress(Timeout):
                lock.acquire()
            self._show("waits for the sweep that has begun the last stage" * (not lock.is_locked))
        try:
            yield
        finally:
            lock.release()

    def _cloned(self, best: FrozenTrial) -> Path:
        """Return the run of the clone, which has ended."""
        name, study = f"clone of trial {best.number}", self._config.study
        parent = StoredRun(run_of(self._study, best, self._config.runs_dir)).with_checkpoint()
        assert parent.checkpoint is not None
        checkpoint = (parent.checkpoints / parent.checkpoint).resolve().name
        of = [parent.path.name, checkpoint, *self._config.config.clone_overrides]
        plan = self._planned(parent, of)
        if isinstance(plan, Path):
            return plan
        self._view.say(f"{name}, {checkpoint_words(checkpoint)}, with {clone_words(self._config.config)}")

        def show(steps: int) -> None:  # without a check: the training hears of a Ctrl-C by itself
            self._view.show(self._claims(), f"{name}: {steps:,} steps")

        result = run_training(
            plan,
            callbacks=[_Clone(study, show)],
            report=RunReport(),
            run_name=name,
            tags={STUDY: study},
            created=lambda folder: self._study.set_user_attr(_CLONE, {"of": of, "run_dir": folder.name}),
        )
        if result.status == INTERRUPTED:
            raise Interrupted
        if result.status == FAILED:
            raise RunFailed(
                f"the {name} failed: {result.reason}; its run: {result.folder}; "
                f"`deepracer-exp sweep study={study}` resumes it"
            )
        return result.folder

    def _planned(self, parent: StoredRun, of: Sequence[str]) -> TrainPlan | ResumePlan | Path:
        """Return the plan of the clone, or its run if that has ended; `of` describes its parent and overrides."""
        begun = self._study.user_attrs.get(_CLONE, {})
        folder = self._config.folder / begun.get("run_dir", "")
        if begun.get("of") != of or not is_run(folder):
            return plan_clone(parent, self._config.config.clone_overrides, stored=self._stored)
        try:
            return plan_resume(folder, [])
        except RunEnded:
            return folder

    def _raced(self, best: FrozenTrial, clone: Path) -> LastRace:
        order = [laps.trial for laps in reranked(self._study)]
        trials = {
            trial.number: trial
            for trial in complete_trials(self._study)
            if has_runs(trial, self._config.folder)
        }
        seconds = [number for number in (*order, *trials) if number in trials and number != best.number][:1]
        runs = {number: run_of(self._study, trials[number], self._config.runs_dir) for number in seconds}
        racers = (
            self._racer(best.number, run_of(self._study, best, self._config.runs_dir)),
            *(self._racer(number, run) for number, run in runs.items()),
            self._racer(best.number, clone, is_clone=True),
        )
        laps = self._config.config.rerank_laps
        return LastRace(laps=laps, cloned_with=clone_words(self._config.config), racers=racers)

    def _racer(self, trial: int, run: Path, *, is_clone: bool = False) -> Racer:
        name, laps = "the clone" if is_clone else f"trial {trial}", self._config.config.rerank_laps
        protocol = fresh(self._config.protocol, laps, again=True)
        self._show(f"{name} drives {laps} fresh laps in the last race")
        evaluation, checkpoint = drive_fresh(run, protocol, self._check)
        usual = evaluation.on(USUAL)
        held_out = evaluation.on(HELD_OUT) if HELD_OUT in evaluation.conditions else None
        (score_s,) = objective_values(evaluation, ("race_score",), protocol.time_s)
        return Racer(
            trial=trial,
            is_clone=is_clone,
            run=run.name,
            checkpoint=checkpoint,
            race_score_s=score_s,
            interval=interval_of([evaluation], "race_score", protocol.time_s),
            lap_time_s=usual.mean_lap_time_s,
            laps_percent=100 * usual.lap_share,
            completion=usual.completion,
            held_out_laps_percent=None if held_out is None else 100 * held_out.lap_share,
            held_out_completion=None if held_out is None else held_out.completion,
        )


class _Clone(Callback):
    """Shows the progress of the clone's training, and names the study in its summary."""

    def __init__(self, study: str, show: Callable[[int], None]):
        self._study, self._show = study, show
        self._shown_s = -math.inf

    def on_iteration_end(self, trainer: Trainer) -> None:
        now_s = time.monotonic()
        if now_s - self._shown_s >= _LOOK_S:
            self._show(trainer.env_steps)
            self._shown_s = now_s

    def summary(self, trainer: Trainer) -> dict[str, Any]:
        return {"study": self._study}
