"""What keys and values of a study are called where somebody reads them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import optuna

from deepracer_exp.errors import BadInput

NONE = "\N{EN DASH}"
"""Stands where there is no value."""


@dataclass(frozen=True)
class Measure:
    """What an objective is measured in."""

    title: str
    unit: str
    minimize: bool

    @property
    def label(self) -> str:
        """Title and unit, for an axis."""
        return f"{self.title}, {self.unit}"

    @property
    def words(self) -> str:
        """The title within a sentence."""
        return self.title[0].lower() + self.title[1:]


MEASURES: Mapping[str, Measure] = {
    "race_score": Measure("Race score", "s", minimize=True),
    "lap_time": Measure("Lap time", "s", minimize=True),
    "completion": Measure("Completion", "%", minimize=False),
}
"""By the name of the objective. Race score: seconds per complete lap, failed laps included."""


def objectives_of(study: optuna.Study) -> tuple[str, ...]:
    """Return the names of a study's objectives.

    Raises:
        BadInput: it was not made by a sweep.
    """
    told = study.user_attrs.get("objectives")
    if (
        not isinstance(told, list | tuple)
        or len(told) != len(study.directions)
        or not set(told) <= set(MEASURES)
    ):
        raise BadInput(
            f"study {study.study_name}: has no objectives that a sweep writes ({', '.join(MEASURES)}); "
            "it was not made by `deepracer-exp sweep`"
        )
    return tuple(told)


def shown(objective: str, value: float) -> str:
    """Return a value with its unit: ``9.84 s``, ``97.3 %``."""
    digits = 2 if MEASURES[objective].minimize else 1
    return f"{value:.{digits}f} {MEASURES[objective].unit}"


def described(objective: str, value: float | None) -> str:
    """Return a value for a table: with its unit, or a dash."""
    return NONE if value is None else shown(objective, value)


def shown_values(objectives: Sequence[str], values: Sequence[float]) -> str:
    """Return all values of a trial in words: ``lap time 9.84 s, completion 97.3 %``."""
    pairs = zip(objectives, values, strict=True)
    return ", ".join(f"{MEASURES[name].words} {shown(name, value)}" for name, value in pairs)


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Return for each dotted key its last part, or as many of its last parts as tell it from the others."""
    parts = {key: key.split(".") for key in keys}
    found: dict[str, str] = {}
    for key, own in parts.items():
        others = [other for name, other in parts.items() if name != key]
        length = next((n for n in range(1, len(own)) if all(o[-n:] != own[-n:] for o in others)), len(own))
        found[key] = ".".join(own[-length:])
    return found


def number(value: float) -> str:
    """Return a number short enough for a table or a tick: ``0.00031``, ``3.1e-5``, ``1200``."""
    text = f"{value:.3g}" if abs(value) < 1000 else f"{value:.4g}"
    return text.replace("e-0", "e-")


def parameter(value: Any) -> str:
    """Return a parameter's value for a table."""
    return number(value) if isinstance(value, float) else str(value)


def steps(count: float) -> str:
    """Return a number of control steps in words: ``950``, ``81.9 k``, ``12.3 M``."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= size:
            return f"{count / size:.1f}{letter}"
    return f"{count:.0f}"


def duration(seconds: float) -> str:
    """Return a time in words: ``45 s``, ``12 min``, ``3.4 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
