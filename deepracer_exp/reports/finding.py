"""A finding of a log with its cost, and the order of findings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

LEAST_LOSS_S = 0.05
"""Seconds a lap below which a loss is not mentioned."""
LEAST_LOSS_PERCENT = 1.0
"""Loss below which it is not mentioned, in per cent of completion, of laps that fail, or of the lap time."""
FIGURES = {
    "converged": "training_progress",
    "submit": "lap_time_percentile",
    "chance": "lap_time_histogram",
    "time_lost": "sector_times",
    "crashes": "episode_ends_map",
    "costs_most": "crashes_by_object",
    "runs_off": "off_track_risk",
    "steering": "slide_map",
    "zigzag": "zigzag",
    "entropy_rises": "training_progress",
    "overfits": "training_progress",
    "laps_slower": "training_progress",
}
"""The chart of each rule's finding."""
Numbers = dict[str, float | int | str]


@dataclass(frozen=True)
class Finding:
    """A finding of a log."""

    rule: str
    sentence: str
    """The finding in plain words, one to three sentences."""
    values: Mapping[str, float | int | str] = field(default_factory=dict)
    """The numbers that were compared."""
    thresholds: Mapping[str, float | int] = field(default_factory=dict)
    cost_percent: float = 0.0
    """Cost in per cent of completion, of failed laps, or of the lap time; 0: it is no loss."""
    to_do: str = ""
    """The finding with advice on the training as a whole, which the first of all findings shows in place of `sentence`;
    empty: no advice."""

    @property
    def figure(self) -> str:
        """Name of the chart that shows it."""
        return FIGURES[self.rule]


def in_order(of_training: Sequence[Finding], of_driving: Sequence[Finding]) -> list[Finding]:
    """Return findings in the order of a page: advice first, then by cost.

    The advice is that of the costliest finding of the training, or of the first of these where none costs anything. The
    others keep theirs back: a racer can do one thing at a time, and it may be the opposite. A finding that costs
    something, but less than `LEAST_LOSS_PERCENT`, is left out.
    """
    to_do = [finding for finding in of_training if finding.to_do]
    first = max(to_do, key=lambda finding: finding.cost_percent, default=None)
    others = [
        finding
        for finding in (*of_training, *of_driving)
        if finding is not first and not 0 < finding.cost_percent < LEAST_LOSS_PERCENT
    ]
    others.sort(key=lambda finding: -finding.cost_percent)
    return others if first is None else [replace(first, sentence=first.to_do), *others]
