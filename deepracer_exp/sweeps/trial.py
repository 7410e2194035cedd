"""Trials and their runs, in the form that the queue stores and Optuna, MLflow, the page and the live view show."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from optuna.trial import FrozenTrial


class Interrupted(Exception):  # noqa: N818 - reads as what it is at the raise site
    """This process was asked to end; the trial, or the sweep, resumes another time."""


@dataclass(frozen=True, kw_only=True)
class SeedRun:
    """The run of a trial with one of its seeds."""

    seed: int
    """Index of the seed, from 0."""
    run_dir: str | None = None
    """Folder of the run; None if the trial failed before it was begun."""
    status: str | None = None
    """Status in the run's summary; None while the run is under way."""
    ending: str = ""
    """Ending of the run, a key of `ENDINGS`."""
    reason: str = ""
    """One line."""
    traceback: str = ""
    values: list[float] | None = None
    """One value per objective; None unless the run was evaluated."""
    env_steps: int = 0
    wall_clock_s: float = 0.0
    took_s: float | None = None
    """Seconds that the last worker needed, with the evaluation."""
    lap_time_s: float | None = None
    """Mean usual lap."""
    completion: float | None = None
    """Usual completion, per cent of the lap."""
    held_out_completion: float | None = None
    mlflow_run_id: str | None = None
    tries: int = 1
    """Number of starts or resumes of the run at the same checkpoint."""
    tried_at: int = 0
    """Iteration of that checkpoint, 0 without any."""

    def folder(self, study_dir: Path) -> Path:
        """Return the run's folder: by its name in the study's folder, or else where the run was made."""
        stored = Path(self.run_dir or "")
        folder = study_dir / stored.name
        return folder if folder.is_dir() else stored


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A trial of a study."""

    number: int
    """Number of the trial in the study, from 0: that of Optuna, and of the queue."""
    state: str = "RUNNING"
    """Name of Optuna's state: RUNNING, COMPLETE, PRUNED or FAIL."""
    values: list[float] | None = None
    """One value per objective; None unless the trial is complete."""
    runs: tuple[SeedRun, ...] = ()
    """The runs that have begun, one per seed."""

    @classmethod
    def of(cls, trial: FrozenTrial) -> Self:
        """Return a trial of Optuna, with the runs that `attributes` have stored there."""
        runs = as_runs(trial.user_attrs.get("runs", ()))
        return cls(number=trial.number, state=trial.state.name, values=trial.values, runs=runs)

    @property
    def ending(self) -> str:
        """Ending of the last run, a key of `ENDINGS`."""
        return self.runs[-1].ending if self.runs else ""

    @property
    def reason(self) -> str:
        """Why the last run ended, in one line."""
        return self.runs[-1].reason if self.runs else ""

    @property
    def traceback(self) -> str:
        """The traceback of a failed trial."""
        return self.runs[-1].traceback if self.runs else ""

    @property
    def env_steps(self) -> int:
        """Control steps of all runs."""
        return sum(run.env_steps for run in self.runs)

    @property
    def wall_clock_s(self) -> float:
        """Seconds of training of all runs."""
        return sum(run.wall_clock_s for run in self.runs)

    @property
    def lap_time_s(self) -> float | None:
        """Mean usual lap, mean over the runs that have one."""
        return self._mean(lambda run: run.lap_time_s)

    @property
    def completion(self) -> float | None:
        """Usual completion, mean over the evaluated runs, per cent."""
        return self._mean(lambda run: run.completion)

    @property
    def held_out_completion(self) -> float | None:
        """Held-out completion, mean over the evaluated runs, per cent."""
        return self._mean(lambda run: run.held_out_completion)

    def attributes(self) -> dict[str, Any]:
        """Return the attributes of an ended trial for Optuna: its runs and their summary."""
        names = ("ending", "reason", "env_steps", "wall_clock_s", "lap_time_s", "completion")
        together = {name: getattr(self, name) for name in (*names, "held_out_completion")}
        return {"runs": runs_as_json(self.runs), **together}

    def _mean(self, value: Callable[[SeedRun], float | None]) -> float | None:
        values = [figure for run in self.runs if (figure := value(run)) is not None]
        return sum(values) / len(values) if values else None


def as_runs(stored: Iterable[Mapping[str, Any]]) -> tuple[SeedRun, ...]:
    """Return the runs from the plain values of `runs_as_json`."""
    return tuple(SeedRun(**run) for run in stored)


def runs_as_json(runs: Iterable[SeedRun]) -> list[dict[str, Any]]:
    """Return runs as plain Python, for a database."""
    return [asdict(run) for run in runs]
