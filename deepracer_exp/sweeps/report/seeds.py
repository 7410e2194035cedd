"""Trials that are repeated over seeds: how certain their values are, and whether the best one's lead is."""

from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from deepracer_exp.analysis.evidence import Interval, difference, estimate
from deepracer_exp.analysis.statistics import Values
from deepracer_exp.sweeps.search.objectives import MEASURES, NONE, objectives_of, shown
from deepracer_exp.sweeps.trial import Trial

from .best import best_trial, complete_trials
from .labels import parameter

_MOST_ROWS = 20


def over_seeds(study: optuna.Study, keys: dict[str, str]) -> list[dict[str, Any]]:
    """Return the best trials with several seeds, by the first objective: each as texts, beside the best trial.

    Args:
        study: empty where its trials have one seed each.
        keys: short names of the parameters.
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
            "iqm": shown(objective, score.iqm),
            "interval": _ends(objective, score.interval),
            "difference": NONE,
            "probability": NONE,
            "verdict": "the best" if trial.number == best.number else NONE,
            "parameters": ", ".join(f"{keys[key]} {parameter(value)}" for key, value in trial.params.items()),
        }
        if trial.number != best.number and len(_values(best)):
            apart = difference([values], [_values(best)], MEASURES[objective].minimize)
            row |= {
                "difference": NONE if apart.iqm is None else shown(objective, apart.iqm),
                "probability": f"{apart.probability:.0%}",
                "verdict": apart.verdict(),
            }
        rows.append(row)
    return rows


def _values(trial: FrozenTrial) -> Values:
    return np.array([run.values[0] for run in Trial.of(trial).runs if run.values], np.float64)


def _ends(objective: str, interval: Interval | None) -> str:
    return NONE if interval is None else " to ".join(shown(objective, end) for end in interval)
