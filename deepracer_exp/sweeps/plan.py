"""The plan of a sweep: request, study and files, resolved before PyTorch is imported."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.custom_files import model_files
from deepracer_exp.config.dimension import Choices, dimension
from deepracer_exp.config.options import groups
from deepracer_exp.config.overrides import group_of, key_of
from deepracer_exp.config.sweep import SweepRequest, compose_sweep
from deepracer_exp.errors import BadInput
from deepracer_exp.training.plan import plan_training

if TYPE_CHECKING:
    from optuna.study import Study

_ACTIONS = "action_space"
_USUAL = ("deepracer", "forward")
"""The car and the direction that a list's name omits."""


@dataclass(frozen=True)
class LapActions:
    """Lists of actions from the fastest lap of a car on a track (`sweep.lap_actions`)."""

    overrides: tuple[str, ...]
    """The overrides that choose the car and the track."""
    counts: Mapping[str, int]
    """The number of actions by the name of the option, as which `deepracer-exp actions` writes a list."""


@dataclass(frozen=True)
class SweepPlan:
    """A study that is begun or continued."""

    request: SweepRequest
    overrides: Sequence[str]
    """Overrides of the request: those that began the study, then those that only name it."""
    study: "Study | None"
    """The study that is continued; None: it is begun."""
    lap_actions: LapActions | None
    """Action lists of `request` that may have to be made; None: it has none."""
    remarks: tuple[str, ...]
    """Warnings about an action space that a racer may not have meant, a line each."""


def plan_sweep(overrides: Sequence[str], *, is_only_shown: bool = False) -> SweepPlan:
    """Compose a sweep, read the files that all its trials share and find its study.

    With `is_only_shown` there may be nothing to search, and no study is looked up if there is.

    Raises:
        BadInput: as for `compose_sweep`, `with_stored` and `plan_training`, or there is nothing to search.
    """
    request, study = compose_sweep(overrides), None
    # Files and options that all trials share; the values of the search are checked with its space, which needs Optuna.
    shared = (*groups(), model_files.KEY, "runs_dir")
    named = [line for line in request.base if (key := key_of(line)) in shared or key.endswith(".file")]
    remarks = plan_training(*compose_experiment(named)).files.remarks
    if not (is_only_shown and request.space):
        from .queue.study import with_stored  # imports Optuna

        overrides, request, study = with_stored(request, overrides)
    if not is_only_shown:
        request.refuse_empty()
    request, lap_actions = _with_lap_actions(request)
    return SweepPlan(request, overrides, study, lap_actions, remarks)


def _with_lap_actions(request: SweepRequest) -> tuple[SweepRequest, LapActions | None]:
    """Add action lists from the fastest lap to an unchanged ready-made search over `action_space`.

    Raises:
        BadInput: there is no single track, or no single car.
    """
    sweep, searched = request.entry.sweep, request.space.get(_ACTIONS)
    if not sweep.lap_actions or searched is None or searched != sweep.space.get(_ACTIONS):
        return request, None
    what = f"sweep.lap_actions={[*sweep.lap_actions]}"
    if several := {"track", "car", "experiment"} & set(map(group_of, request.space)):
        raise BadInput(what, f"{min(several)} is searched", "one track and one car, or sweep.lap_actions=[]")
    lines = [
        line for line in request.base if group_of(line) in ("track", "car", "experiment", model_files.KEY)
    ]
    experiment, composition = compose_experiment(lines, stored=request.stored)
    if len(experiment.tracks) > 1:
        raise BadInput(what, f"{len(experiment.tracks)} tracks", "one track, or sweep.lap_actions=[]")
    ((_, track),) = experiment.tracks.items()
    parts = [track.name, composition.choices["car"]]
    parts = [part for part in (*parts, track.direction) if part not in _USUAL]
    if further := sorted(line for line in lines if key_of(line) not in ("track", "car", "track.direction")):
        parts.append(hashlib.sha256("\0".join(further).encode()).hexdigest()[:6])
    place = re.sub(r"[^A-Za-z0-9_]+", "-", "-".join(parts))
    counts = {f"lap{number}-{place}": number for number in sweep.lap_actions}
    options = dimension(_ACTIONS, searched)
    assert isinstance(options, Choices)
    both = ",".join(map(str, dict.fromkeys((*options.values, *counts))))
    return replace(request, space={**request.space, _ACTIONS: both}), LapActions(tuple(lines), counts)
