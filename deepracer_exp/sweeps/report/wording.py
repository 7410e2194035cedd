"""Labels for people: endings of trials with colours, short keys, numbers, steps and durations."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.sweeps.trial import Trial


class EndingStyle(NamedTuple):
    """Colour of trials with the same ending."""

    color: str
    meaning: str


ENDINGS: Mapping[str, EndingStyle] = {
    "finished": EndingStyle("#0072B2", "used its whole budget"),
    "converged": EndingStyle("#009E73", "learned to drive and stopped improving"),
    "reliable": EndingStyle("#56B4E9", "completed enough laps"),
    "plateau": EndingStyle("#A0C0E0", "stopped improving"),
    "overfitting": EndingStyle("#E0C0A0", "lost held-out conditions while its return held"),
    "laps_slower": EndingStyle("#999933", "its laps became slower while its return held"),
    "collapsed": EndingStyle("#D55E00", "entropy fell before it could drive"),
    "not_learning": EndingStyle("#E69F00", "entropy and completion stayed where they began"),
    "other_rule": EndingStyle("#663300", "ended by another stopping rule"),
    "median": EndingStyle("#CC79A7", "worse than the median of the others at the same point"),
    "percentile": EndingStyle("#882255", "not among the best share of the others at the same point"),
    "hyperband": EndingStyle("#A060E0", "lost its bracket"),
    "pruned": EndingStyle("#A04080", "worse than the others"),
    "failed": EndingStyle("#000000", "ended by an error"),
    "running": EndingStyle("#9A9A9A", "still running"),
}
"""Styles by `Trial.ending`. Colours after Okabe and Ito (jfly.uni-koeln.de/color); the others differ from
them for colour-blind readers, too."""

_BY_STATE = {TrialState.COMPLETE: "finished", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


def ending_of(trial: FrozenTrial) -> str:
    """Return a trial's ending, a key of ENDINGS."""
    if not trial.state.is_finished():
        return "running"
    stored = Trial.of(trial).ending
    is_another_rule = stored and trial.state == TrialState.COMPLETE
    return stored if stored in ENDINGS else "other_rule" if is_another_rule else _BY_STATE[trial.state]


def ending_words(ending: str) -> str:
    """Return an ending as people write it: ``not learning``."""
    return ending.replace("_", " ")


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Return the shortest unique suffix of each dotted key: its last part, or several."""
    parts = {key: key.split(".") for key in keys}
    short: dict[str, str] = {}
    for key, words in parts.items():
        others = [other for name, other in parts.items() if name != key]
        length = next(
            (n for n in range(1, len(words)) if all(o[-n:] != words[-n:] for o in others)), len(words)
        )
        short[key] = ".".join(words[-length:])
    return short


def parameter(value: Any) -> str:
    """Return a parameter's value for a table, short: ``0.00031``, ``3.1e-5``, ``1200``, ``mlp``."""
    if not isinstance(value, float):
        return str(value)
    return (f"{value:.3g}" if abs(value) < 1000 else f"{value:.4g}").replace("e-0", "e-")


def steps(count: float) -> str:
    """Return a number of control steps: ``950``, ``81.9 k``, ``12.3 M``."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= size:
            return f"{count / size:.1f}{letter}"
    return f"{count:.0f}"


def duration(seconds: float) -> str:
    """Return a time: ``45 s``, ``12 min``, ``3.4 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
