"""Widens the search space of a study and keeps its trials.

Optuna does not let the choices of a key change within a study. So the study is rewritten, first under another name,
then under its own. If the process is killed in between, the next start of the sweep completes the work.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import optuna
from optuna.storages import RDBStorage
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from deepracer_exp.config.compose import Composition
from deepracer_exp.config.options import groups
from deepracer_exp.errors import BadInput
from deepracer_exp.sweeps.search.space import Dimension, SearchSpace, value_at

from .claims import TrialClaims, report_results

COMPLETE = "is_complete"
"""Attribute of a wider study under its first name: it has all trials, and replaces the other one."""


def aside(name: str) -> str:
    """Return the name under which a wider study is made."""
    return f"{name} (wider)"


def complete_widening(name: str, storage: RDBStorage) -> None:
    """Replace a study by the wider one beside it, if there is one with all trials; no other process does so now."""
    try:
        wider = optuna.load_study(study_name=aside(name), storage=storage)
    except KeyError:
        return
    if COMPLETE in wider.user_attrs:
        if name in optuna.get_all_study_names(storage):
            optuna.delete_study(study_name=name, storage=storage)
        optuna.copy_study(
            from_study_name=aside(name), from_storage=storage, to_storage=storage, to_study_name=name
        )
        optuna.delete_study(study_name=aside(name), storage=storage)


def widen(
    study: Study,
    storage: RDBStorage,
    space: SearchSpace,
    attributes: Mapping[str, Any],
    composed: "Callable[[list[str]], Composition]",
) -> Study:
    """Return the study with a wider space and these attributes, and with all its trials under their numbers.

    Each trial keeps its values, its result and its runs. Of a key that is searched only now it gets the value that it
    was trained with, if that is among those searched.

    Args:
        study: as it is; no other process widens it now.
        storage: its own.
        space: has all values of the study's space.
        attributes: of the wider study, beside those of the study.
        composed: composes the overrides of a trial.

    Raises:
        BadInput: a trial is running.
    """
    from .worker_config import is_gone

    name = study.study_name
    claims = TrialClaims(storage.engine, name)
    running = [
        claim.trial.number
        for claim in claims.all()
        if not claim.has_ended and not claim.expired and not is_gone(claim.owner)
    ]
    if running:
        raise BadInput(
            f"study={name}",
            f"trial {', '.join(map(str, running))} is running, and a search is widened between trials",
            "Ctrl-C in the sweep that runs it, then this command again",
        )
    report_results(claims, storage)
    if aside(name) in optuna.get_all_study_names(storage):  # of a process that was killed
        optuna.delete_study(study_name=aside(name), storage=storage)
    wider = optuna.create_study(study_name=aside(name), storage=storage, directions=study.directions)
    for trial in study.get_trials():
        wider.add_trial(_in_space(trial, space, composed))
    kept = {key: value for key, value in study.user_attrs.items() if key != COMPLETE}
    for key, value in {**kept, **attributes, COMPLETE: True}.items():  # that it is complete comes last
        wider.set_user_attr(key, value)
    complete_widening(name, storage)
    return optuna.load_study(study_name=name, storage=storage)


def _in_space(
    trial: FrozenTrial, space: SearchSpace, composed: "Callable[[list[str]], Composition]"
) -> FrozenTrial:
    """Return a trial as one of the wider space; samplers' attributes are left out."""
    moved = copy.deepcopy(trial)
    if trial.state == TrialState.WAITING:
        return moved
    params: dict[str, Any] = {}
    added: Composition | None = None
    for axis in space.dimensions:
        if axis.key in trial.params:
            params[axis.key] = _in_dimension(axis, trial.params[axis.key])
        elif "overrides" in trial.user_attrs and _counts(axis, params):
            added = added or composed(list(trial.user_attrs["overrides"]))
            for value in _trained_with(axis, added):
                params[axis.key] = value
    moved.distributions = {axis.key: axis.distribution for axis in space.dimensions if axis.key in params}
    moved.params, moved.system_attrs = params, {}
    return moved


def _in_dimension(axis: Dimension, value: Any) -> Any:
    """Return a value of a narrower dimension; a whole number may have become one of any numbers."""
    return float(value) if isinstance(axis.distribution, optuna.distributions.FloatDistribution) else value


def _counts(axis: Dimension, params: Mapping[str, Any]) -> bool:
    return axis.options is None or params.get(str(axis.group)) in axis.options


def _trained_with(axis: Dimension, composition: Composition) -> list[Any]:
    """Return the value that a trial was trained with; an empty list if it is not searched."""
    if axis.key in groups():
        plain = [composition.choices[axis.key]] if axis.key in composition.choices else []
    else:
        plain = value_at(composition.mapping, axis.key)
    return [choice for value in plain for choice in axis.matching(value)]
