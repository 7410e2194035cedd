"""How trials end: words, order and the colours a reader tells them apart by."""

from collections.abc import Mapping
from dataclasses import dataclass

from optuna.trial import FrozenTrial, TrialState


@dataclass(frozen=True)
class Look:
    """How a fate is drawn."""

    color: str
    symbol: str
    """Of Plotly: filled ones for complete trials, crosses for pruned, a triangle for failed."""
    dash: str
    meaning: str


FATES: Mapping[str, Look] = {
    "finished": Look("#0072B2", "square", "solid", "used its whole budget"),
    "converged": Look("#009E73", "circle", "solid", "learned to drive and grew no more"),
    "reliable": Look("#56B4E9", "hexagon", "solid", "completed enough laps"),
    "plateau": Look("#A0C0E0", "pentagon", "solid", "grew no more"),
    "overfitting": Look("#E0C0A0", "diamond", "solid", "lost held-out conditions while its return held"),
    "collapsed": Look("#D55E00", "x", "dash", "entropy fell before it could drive"),
    "not_learning": Look("#E69F00", "x", "dot", "entropy and completion stayed where they began"),
    "median": Look("#CC79A7", "cross", "dash", "worse than the median of the others at the same point"),
    "percentile": Look(
        "#882255", "cross", "dot", "worse than the given share of the others at the same point"
    ),
    "hyperband": Look("#A060E0", "cross", "dashdot", "lost its bracket"),
    "wilcoxon": Look("#332288", "cross", "longdash", "beaten by the best trial, seed by seed"),
    "pruned": Look("#A04080", "cross", "longdash", "beaten by the others"),
    "failed": Look("#000000", "triangle-up", "longdashdot", "ended by an error"),
    "running": Look("#9A9A9A", "circle-open", "dot", "goes on"),
}
"""By the word for a fate; colours after Okabe and Ito (jfly.uni-koeln.de/color), the others apart in every sight."""

_BY_STATE = {TrialState.COMPLETE: "finished", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


def fate_of(trial: FrozenTrial) -> str:
    """Return how a trial ended, one of FATES."""
    if not trial.state.is_finished():
        return "running"
    told = str(trial.user_attrs.get("fate"))
    return told if told in FATES else _BY_STATE[trial.state]


def words(fate: str) -> str:
    """Return a fate as it is written: ``not learning``."""
    return fate.replace("_", " ")
