"""The best trial of a study: its values, the command that trains it, its run, and its lead over seeds."""

import contextlib
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables.evidence import Values, difference, estimate
from deepracer_exp.runs.best_run import BestOfSweep, write_best_of_sweep
from deepracer_exp.runs.run_files import is_run, read_config
from deepracer_exp.runs.run_result import FRESH_LAPS, SWEEP_LAPS
from deepracer_exp.sweeps.search.objectives import (
    MEASURES,
    NONE,
    cost,
    objectives_of,
    score_text,
    shown_values,
)
from deepracer_exp.sweeps.trial import SeedRun, Trial

from .wording import parameter

_MOST_ROWS = 20


@dataclass(frozen=True, kw_only=True)
class FreshLaps:
    """Fresh laps of the best checkpoints of a trial, one checkpoint per seed."""

    trial: int
    values: list[float]
    """Values of the objectives, means over the seeds."""
    interval: list[float]
    """Both ends of the 95 per cent interval of the first of them."""
    lap_time_s: float | None
    completion: float
    held_out_completion: float | None


def reranked(study: optuna.Study) -> list[FreshLaps]:
    """Return the results of the best trials on fresh laps, the best first; empty before that.

    Empty again once more trials are complete: others may then be the best.
    """
    objectives, count = objectives_of(study), len(complete_trials(study))
    attrs = study.user_attrs
    stored = attrs.get("reranked", []) if attrs.get("reranked_of", count) == count else []
    return sorted((FreshLaps(**laps) for laps in stored), key=lambda laps: cost(objectives, laps.values))


def complete_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the complete trials, the best first; of equals the earlier one."""
    objectives = objectives_of(study)
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return sorted(trials, key=lambda trial: (cost(objectives, trial.values), trial.number))


def best_trial(study: optuna.Study) -> FrozenTrial:
    """Return the winner: the best on fresh laps, or else the best complete trial.

    Raises:
        BadInput: no trial is complete.
    """
    complete = complete_trials(study)
    if not complete:
        raise BadInput(f"study {study.study_name}", f"none of its {len(study.trials)} trials is complete yet")
    numbers = [laps.trial for laps in reranked(study)]
    return next((trial for trial in complete if trial.number in numbers[:1]), complete[0])


def best_values(study: optuna.Study) -> list[float]:
    """Return the values of the best trial, on fresh laps if there are any."""
    trial = best_trial(study)
    on_fresh_laps = {laps.trial: laps.values for laps in reranked(study)}
    return list(on_fresh_laps.get(trial.number, trial.values))


def best_shown(study: optuna.Study) -> str:
    """Return the values of the best trial as text, with the kind of laps."""
    best = best_trial(study)
    fresh = next((laps for laps in reranked(study) if laps.trial == best.number), None)
    has_held_out = (fresh or Trial.of(best)).held_out_completion is not None
    values = shown_values(objectives_of(study), best_values(study), has_held_out)
    return f"{values} on {SWEEP_LAPS if fresh is None else FRESH_LAPS}"


def best_line(study: optuna.Study) -> str:
    """Return the command that repeats the winner's training, quoted for a shell."""
    attrs = best_trial(study).user_attrs
    overrides = [str(override) for key in ("overrides", "where") for override in attrs.get(key, ())]
    if study.user_attrs.get("seeds", 1) > 1:  # the trial's overrides are those of the first
        with contextlib.suppress(BadInput):
            seed = read_config(best_run(study))["seed"]
            overrides = [*(line for line in overrides if not line.startswith("seed=")), f"seed={seed}"]
    if parent := study.user_attrs.get("parent_run"):
        clone = ["deepracer-exp", "clone", parent["run_dir"], f"checkpoint={parent['checkpoint']}"]
        return shlex.join([*clone, *overrides])
    return shlex.join(["deepracer-exp", "train", *overrides])


def best_run(study: optuna.Study, runs_dir: Path | None = None) -> Path:
    """Return the folder of the best run, over all seeds, of the best trial; `runs_dir`: where the study says.

    Raises:
        BadInput: no trial is complete, or the folder is neither where it was nor in `runs_dir`.
    """
    return run_of(study, best_trial(study), runs_dir)


def has_runs(trial: FrozenTrial, folder: Path) -> bool:
    """Return whether the runs of a trial, in the study's `folder`, are still there."""
    return all(is_run(run.folder(folder)) for run in Trial.of(trial).runs)


def run_of(study: optuna.Study, trial: FrozenTrial, runs_dir: Path | None = None) -> Path:
    """Return the folder of the best run of a complete trial, over all seeds; `runs_dir`: where the study says.

    Raises:
        BadInput: the folder is neither where it was nor in `runs_dir`.
    """
    objectives = objectives_of(study)
    runs = [run for run in Trial.of(trial).runs if run.values]
    best = min(runs, key=lambda run: cost(objectives, run.values or ()), default=SeedRun(seed=0))
    base = runs_dir or Path(study.user_attrs.get("runs_dir", "runs"))
    folder = best.folder(base / study.study_name)
    if best.run_dir is None or not is_run(folder):
        raise BadInput(
            f"study {study.study_name}",
            f"{folder} of trial {trial.number} is gone; give runs_dir= if the runs have moved",
        )
    return folder


def write_best(study: optuna.Study, runs_dir: Path) -> Path:
    """Write best_of_sweep.json beside the study's runs, where `best:STUDY` looks its run up.

    Raises:
        BadInput: there is no best run, or it does not lie in the folder of the study's runs.
    """
    run, folder = best_run(study, runs_dir), runs_dir / study.study_name
    if run.resolve().parent != folder.resolve():
        raise BadInput(f"study {study.study_name}", f"its best run {run} does not lie in {folder}")
    values = dict(zip(objectives_of(study), best_values(study), strict=True))
    trial = best_trial(study).number
    return write_best_of_sweep(
        folder, BestOfSweep(study=study.study_name, trial=trial, run_dir=run.name, values=values)
    )


def over_seeds(study: optuna.Study, keys: dict[str, str]) -> list[dict[str, Any]]:
    """Return the best trials with several seeds, by the first objective: each as texts, beside the best trial.

    `keys` are short names of the parameters. Nothing where the study's trials have one seed each.
    """
    objective = objectives_of(study)[0]
    repeated = [(trial, values) for trial in complete_trials(study) if len(values := _values(trial)) > 1]
    if not repeated:
        return []
    best = best_trial(study)
    rows = []
    for trial, values in repeated[:_MOST_ROWS]:
        score = estimate([values])
        row = {
            "trial": trial.number,
            "seeds": score.seeds,
            "iqm": score_text(objective, score.iqm),
            "interval": " to ".join(score_text(objective, end) for end in score.interval or ()) or NONE,
            "difference": NONE,
            "probability": NONE,
            "verdict": "the best" if trial.number == best.number else NONE,
            "parameters": ", ".join(f"{keys[key]} {parameter(value)}" for key, value in trial.params.items()),
        }
        if trial.number != best.number and len(_values(best)):
            apart = difference([values], [_values(best)], MEASURES[objective].minimize)
            row |= {
                "difference": NONE if apart.iqm is None else score_text(objective, apart.iqm),
                "probability": f"{apart.probability:.0%}",
                "verdict": apart.verdict(),
            }
        rows.append(row)
    return rows


def _values(trial: FrozenTrial) -> Values:
    return np.array([run.values[0] for run in Trial.of(trial).runs if run.values], np.float64)
