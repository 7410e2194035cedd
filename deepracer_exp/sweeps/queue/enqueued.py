"""Known good settings, which a study tries before its sampler draws any."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optuna.study import Study

from deepracer_exp.config.dimension import Choice
from deepracer_exp.config.options import groups
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.run_files import read_config
from deepracer_exp.sweeps.search.space import SearchSpace, value_at
from deepracer_exp.tracking.resolve import resolve


def known_settings(request: SweepRequest, space: SearchSpace) -> list[dict[str, Choice]]:
    """Return the settings of `sweep.enqueue`; keys that one of them leaves open are drawn.

    Raises:
        BadInput: a run cannot be found, or a key or a value is not searched.
    """
    return [_setting(entry, space, request.runs_dir) for entry in request.entry.sweep.enqueue]


def enqueue(study: Study, settings: Sequence[Mapping[str, Choice]]) -> None:
    """Enqueue these settings for the next trials, each only once."""
    for setting in settings:
        study.enqueue_trial(dict(setting), skip_if_exists=True)


def _setting(entry: Mapping[str, Any] | str, space: SearchSpace, runs_dir: Path) -> dict[str, Choice]:
    axes = {axis.key: axis for axis in space.dimensions}
    where = f"sweep.enqueue={entry}"
    plain: Mapping[str, Any]
    if isinstance(entry, str):
        values = read_config(resolve(entry, runs_dir, None).path)
        # A run has the values of an option, not its name.
        plain = {key: value for key in axes if key not in groups() for value in value_at(values, key)}
    else:
        plain = entry
    if unknown := [key for key in plain if key not in axes]:
        raise BadInput(where, f"{unknown[0]} is not searched", ", ".join(axes))
    if not plain:
        raise BadInput(where, "has none of the keys that are searched", ", ".join(axes))
    setting: dict[str, Choice] = {}
    for key, value in plain.items():
        matching = axes[key].matching(value)
        if not matching:
            raise BadInput(where, f"{key}={value} is not searched", f"{key}={axes[key].expression}")
        setting[key] = matching[0]
    return setting
