"""Studies begun and found again."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.study import Study, StudyDirection

from deepracer_exp.config.overrides import group_of
from deepracer_exp.config.sweep import SweepRequest
from deepracer_exp.errors import BadInput, nearest

from .labels import MEASURES
from .space import SearchSpace
from .storage import Storage

MAY_DIFFER = (
    *("study", "debug", "sweep/executor", "sweep.trials", "sweep.workers", "sweep.storage", "sweep.lease_s"),
    *("sweep.patience_s", "sweep.rerank", "sweep.rerank_laps", "runs_dir"),
)
"""Keys that change nothing of what the trials are."""
_SAME = ("objectives", "seeds", "protocol", "parent")
"""What trials that are to be compared have in common, beside space and base."""


def find_study(name: str, storage: Storage) -> Study | None:
    """Return a study, None if there is none of that name."""
    try:
        return optuna.load_study(study_name=name, storage=storage.optuna)
    except KeyError:
        return None


def load_study(name: str, storage: Storage) -> Study:
    """Return a study that is there.

    Raises:
        BadInput: there is none of that name; the message says which there are.
    """
    study = find_study(name, storage)
    if study is None:
        known = optuna.get_all_study_names(storage.optuna)
        there = f"studies: {', '.join(known)}" if known else "there is no study yet"
        raise BadInput(f"study {name}: not found in {storage.url}{nearest(name, known)}; {there}")
    return study


def goes_on(overrides: Sequence[str]) -> bool:
    """Tell whether overrides say nothing of what the trials are: they name a study to go on with."""
    return not {override.partition("=")[0].strip().lstrip("+~") for override in overrides} - {*MAY_DIFFER}


def completed(overrides: Sequence[str], study: Study) -> list[str]:
    """Return the overrides that go on with a study, for which no more than its name need be given.

    Args:
        overrides: as given.
        study: which they name.

    Returns:
        Those it was begun with and the given ones; only the given ones if they say themselves what the trials are.
    """
    if not goes_on(overrides):
        return list(overrides)
    # The total of the start before this one: it may have been raised since the study was begun.
    total = [f"sweep.trials={study.user_attrs['trials']}"] if "trials" in study.user_attrs else []
    return [*study.user_attrs.get("overrides", ()), *total, *overrides]


def open_study(
    request: SweepRequest,
    overrides: Sequence[str],
    space: SearchSpace,
    parent: Sequence[str],
    storage: Storage,
    runs_dir: Path,
) -> Study:
    """Begin a study, or go on with the one of that name.

    Args:
        request: what is asked for.
        overrides: that it was composed from.
        space: of the request.
        parent: as `Plan.parent`.
        storage: where studies are.
        runs_dir: where its runs are.

    Raises:
        BadInput: there is a study of that name whose trials could not be compared with these.
    """
    name, sweep = request.study, request.entry.sweep
    asked = {
        "base": list(request.base),
        "objectives": list(sweep.objectives),
        "seeds": sweep.seeds,
        "protocol": sweep.protocol,
        "parent": request.entry.parent,
        "parent_run": list(parent),
        "runs_dir": str(runs_dir),
        # The address may have a password in it, and whoever goes on knows it.
        "overrides": [line for line in overrides if not line.lstrip("+").startswith("sweep.storage=")],
        # The last: a study that has it has all of them.
        "space": space.as_text(),
    }
    directions = [
        StudyDirection.MINIMIZE if MEASURES[one].minimize else StudyDirection.MAXIMIZE
        for one in sweep.objectives
    ]
    try:
        study = optuna.create_study(study_name=name, storage=storage.optuna, directions=directions)
    except optuna.exceptions.DuplicatedStudyError:
        study = load_study(name, storage)
    stored = study.user_attrs
    if "space" not in stored:  # it is new, or whoever began it was killed at this very place
        for key, value in asked.items():
            study.set_user_attr(key, value)
    else:
        found = [*space.difference(stored["space"]), *_differences(stored, asked)]
        if found:
            raise BadInput(
                f"study={name}: exists with another search: {'; '.join(found)}; give another name, or "
                f"`deepracer-exp sweep study={name}` alone to go on with it"
            )
    study.set_user_attr("trials", sweep.trials)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        # Optuna Dashboard calls them "Objective 0" otherwise.
        study.set_metric_names([MEASURES[objective].label for objective in sweep.objectives])
    return study


def _differences(stored: dict[str, object], asked: dict[str, object]) -> list[str]:
    found = [f"{key}: {stored.get(key)} -> {asked[key]}" for key in _SAME if stored.get(key) != asked[key]]
    # With which collector a worker runs a trial does not make it another one.
    before, now = (
        [line for line in one if group_of(line) != "collector"] if isinstance(one, list) else []
        for one in (stored.get("base"), asked["base"])
    )
    if before != now:
        gone, new = [one for one in before if one not in now], [one for one in now if one not in before]
        found.append(f"every trial: {' '.join(gone) or 'nothing'} -> {' '.join(new) or 'nothing'}")
    return found
