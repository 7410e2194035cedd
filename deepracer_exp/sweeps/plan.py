"""What a sweep was asked, with the answers: request, study, files; nothing here imports PyTorch."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deepracer_exp.config import custom_files
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.options import groups
from deepracer_exp.config.overrides import key_of
from deepracer_exp.config.sweep import SweepRequest, compose_sweep
from deepracer_exp.training.plan import plan_training

if TYPE_CHECKING:
    from optuna.study import Study


@dataclass(frozen=True)
class SweepPlan:
    """A study that is begun or continued."""

    request: SweepRequest
    overrides: Sequence[str]
    """Overrides of the request: what the study was begun with comes before what only names it."""
    study: "Study | None"
    """The study that is continued; None: it is begun."""
    remarks: tuple[str, ...]
    """A line for each thing about the action space that a racer may not have meant."""


def plan_sweep(overrides: Sequence[str], *, is_only_shown: bool = False) -> SweepPlan:
    """Compose a sweep, read the files that all its trials share and find its study.

    With `is_only_shown` there may be nothing to search, and no study is looked up if there is.

    Raises:
        BadInput: as for `compose_sweep`, `with_stored` and `plan_training`, or there is nothing to search.
    """
    request, study = compose_sweep(overrides), None
    # Files and options that all trials share; the values of the search are checked with its space, which needs Optuna.
    shared = (*groups(), custom_files.KEY, "runs_dir")
    named = [line for line in request.base if (key := key_of(line)) in shared or key.endswith(".file")]
    remarks = plan_training(*compose_experiment(named)).files.remarks
    if not (is_only_shown and request.space):
        from .queue.study import with_stored  # imports Optuna

        overrides, request, study = with_stored(request, overrides)
    if not is_only_shown:
        request.refuse_empty()
    return SweepPlan(request, overrides, study, remarks)
