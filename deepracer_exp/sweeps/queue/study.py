"""Studies: begun with their first trials, found by name, and resumed with the overrides they were begun with."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.storages import RDBStorage
from optuna.study import Study, StudyDirection

from deepracer_exp.addresses import redact
from deepracer_exp.config.compose import Composition
from deepracer_exp.config.dimension import Choice
from deepracer_exp.config.options import groups
from deepracer_exp.config.overrides import group_of, key_of, override_line
from deepracer_exp.config.sweep import SweepRequest, compose_sweep
from deepracer_exp.errors import BadInput, nearest
from deepracer_exp.runs.lineage import read_lineage
from deepracer_exp.runs.run_files import SUMMARY, read_config, read_object
from deepracer_exp.sweeps import DEFAULT_FILE
from deepracer_exp.sweeps.search.objectives import MEASURES
from deepracer_exp.sweeps.search.space import SearchSpace, value_at
from deepracer_exp.tracking.resolve import resolve

from .claims import TABLE, TrialClaims
from .storage import open_storage, resolve_database
from .widening import complete_widening, widen

if TYPE_CHECKING:
    from .worker_config import Parent

_log = logging.getLogger("deepracer_exp")

MAY_DIFFER = (
    *("study", "debug", "sweep/executor", "sweep.trials", "sweep.workers", "sweep.storage", "sweep.lease_s"),
    *("sweep.patience_s", "sweep.rerank", "sweep.rerank_laps", "sweep.clone", "sweep.enqueue"),
    "runs_dir",
)
"""Keys that do not change the trials themselves."""
_EXECUTOR = "sweep.executor."
"""Beginning of further such keys: the settings of `sweep/executor`."""
_OF_LAST_START = ("trials", "clone")
"""Settings that a resumed study takes from its last start, because they may have changed since it began."""
_SAME = ("objectives", "seeds", "protocol", "parent")
"""Attributes that comparable trials share, beside space and base."""


def find_study(name: str, storage: RDBStorage) -> Study | None:
    """Return a study, None if none has that name.

    Raises:
        BadInput: an earlier version, which stored trials in another way, began the study.
    """
    try:
        study = optuna.load_study(study_name=name, storage=storage)
    except KeyError:
        return None
    if "space" in study.user_attrs and study.user_attrs.get("claims") != TABLE:
        raise BadInput(f"study {name}: an earlier version began it, and alone can read it; give another name")
    return study


def load_study(name: str, storage: RDBStorage) -> Study:
    """Return a study that exists.

    Raises:
        BadInput: none has that name; the message lists those that exist.
    """
    study = find_study(name, storage)
    if study is None:
        names = optuna.get_all_study_names(storage)
        there = f"studies: {', '.join(names)}" if names else "there is no study yet"
        raise BadInput(
            f"study {name}", f"not found in {redact(str(storage.engine.url))}{nearest(name, names)}; {there}"
        )
    return study


def with_stored(
    request: SweepRequest, overrides: Sequence[str]
) -> tuple[Sequence[str], SweepRequest, Study | None]:
    """Return the overrides of a sweep, the request they make, and its study if that exists.

    Overrides that only name a study are preceded by those that the study was begun with, and composed with them.

    Raises:
        BadInput: an override is not accepted, there is nothing to search, or there is no study of that name to resume.
    """
    keys = set(map(key_of, overrides))
    names_only = not {key for key in keys if not key.startswith(_EXECUTOR)} - {*MAY_DIFFER}
    study = _existing(request, names_only)
    if study is None:
        return overrides, request, None
    if names_only:
        stored = study.user_attrs
        last = [override_line(f"sweep.{key}", stored[key]) for key in _OF_LAST_START if key in stored]
        begun_with = [
            line
            for line in stored.get("overrides", ())
            if "sweep/executor" not in keys or not line.startswith(_EXECUTOR)
        ]
        overrides = [*begun_with, *last, *overrides]
        request = compose_sweep(overrides, stored=True)
    if not request.space:
        raise BadInput(
            f"study={request.study}: exists; to resume it, give only {', '.join(MAY_DIFFER)} beside its "
            "name; to widen its search give all of it again"
        )
    return overrides, request, study


def open_study(
    request: SweepRequest,
    overrides: Sequence[str],
    space: SearchSpace,
    parent: "Parent | None",
    storage: RDBStorage,
    runs_dir: Path,
) -> Study:
    """Begin a study, or open the study of that name; all trials are clones of `parent`, if there is one.

    A study that exists is widened if `space` has all values of its own.

    Raises:
        BadInput: a study of that name exists, and its trials cannot be compared with these; or one of them is running
            and the search is a wider one.
    """
    from .worker_config import plan_trial

    name, sweep = request.study, request.entry.sweep
    wanted = {
        "base": list(request.base),
        "objectives": list(sweep.objectives),
        "seeds": sweep.seeds,
        "protocol": sweep.protocol,
        "parent": request.entry.parent,
        "parent_run": None if parent is None else asdict(parent),
        "runs_dir": str(runs_dir),
        "claims": TABLE,
        # The address may contain a password, and is given again to resume; what was enqueued is among the trials.
        "overrides": [
            _expanded(line, request.space)
            for line in overrides
            if key_of(line) not in ("sweep.storage", "sweep.enqueue")
        ],
        # The last one: a study that has it has all of them.
        "space": space.as_text(),
    }
    directions = [
        StudyDirection.MINIMIZE if MEASURES[objective].minimize else StudyDirection.MAXIMIZE
        for objective in sweep.objectives
    ]
    try:
        study = optuna.create_study(study_name=name, storage=storage, directions=directions)
    except optuna.exceptions.DuplicatedStudyError:
        study = load_study(name, storage)
    stored = study.user_attrs
    if "space" not in stored:  # it is new, or the process that began it was killed right here
        TrialClaims(storage.engine, name).forget()  # those of a study of that name that was deleted
        for key, value in wanted.items():
            study.set_user_attr(key, value)
    else:
        changes = space.difference(stored["space"])
        differences = _differences(stored, wanted, {*space.as_text()} - {*stored["space"]})
        if changes and not differences and space.is_wider_than(stored["space"]):

            def composed(lines: list[str]) -> Composition:
                return plan_trial(lines, parent, stored=True).composition

            if sweep.sampler == "grid":
                raise BadInput(
                    f"study={name}: sweep.sampler=grid drives the points of the search that it began with: "
                    f"{'; '.join(changes)}; give another name"
                )
            study = widen(study, storage, space, wanted, composed)
            _log.warning(
                "study %s: a wider search from now on, with the %d trials that it has: %s",
                *(name, len(study.get_trials(deepcopy=False)), "; ".join(changes)),
            )
        elif changes or differences:
            differences = [*changes, *differences]
            raise BadInput(
                f"study={name}: exists with another search: {'; '.join(differences)}; give another name, or "
                f"resume it with `deepracer-exp sweep study={name}` alone"
            )
    for key in _OF_LAST_START:
        study.set_user_attr(key, getattr(sweep, key))
    for key in ("base", "runs_dir"):  # the runs may have moved
        study.set_user_attr(key, wanted[key])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        # Optuna Dashboard calls them "Objective 0" otherwise.
        study.set_metric_names([MEASURES[objective].label for objective in sweep.objectives])
    return study


def _expanded(override: str, space: Mapping[str, str]) -> str:
    """Return an override with the options that its `glob` found: later ones are no part of the study."""
    key, _, value = override.partition("=")
    return f"{key}={space[key]}" if value.startswith("glob(") else override


def _differences(stored: dict[str, object], wanted: dict[str, object], searched: set[str]) -> list[str]:
    """Return a line for each difference that makes trials incomparable; `searched` are keys that were not before."""
    lines = [f"{key}: {stored.get(key)} -> {wanted[key]}" for key in _SAME if stored.get(key) != wanted[key]]
    before, now = (
        [
            line
            for line in base
            if not _chooses_processes(line) and key_of(line) not in {*searched, "runs_dir"}
        ]
        if isinstance(base, list)
        else []
        for base in (stored.get("base"), wanted["base"])
    )
    if {*before} != {*now}:  # in any order: the last of a key counts
        gone, new = [line for line in before if line not in now], [line for line in now if line not in before]
        lines.append(f"every trial: {' '.join(gone) or 'nothing'} -> {' '.join(new) or 'nothing'}")
    return lines


def _chooses_processes(override: str) -> bool:
    """Return whether an override only chooses the processes of a trial's cars, which does not change the trial."""
    return group_of(override) == "collector" and key_of(override) != "collector.cars"


def _existing(request: SweepRequest, must_exist: bool) -> Study | None:
    """Return the study that the request names, if it exists; no file is created by looking."""
    if request.entry.study is None and must_exist:
        return None
    if request.entry.sweep.storage is None and not (request.runs_dir / DEFAULT_FILE).exists():
        return None
    address, runs_dir = request.entry.sweep.storage, request.runs_dir
    storage = open_storage(address, runs_dir)
    with resolve_database(address, runs_dir).creation_lock(storage.engine):
        complete_widening(request.study, storage)
    find = load_study if must_exist else find_study
    return find(request.study, storage)


def known_settings(request: SweepRequest, space: SearchSpace) -> list[dict[str, Choice]]:
    """Return the settings of `sweep.enqueue`; keys that one of them leaves open are drawn.

    Raises:
        BadInput: a run cannot be found, or a key or a value is not searched.
    """
    return [_setting(entry, space, request) for entry in request.entry.sweep.enqueue]


def enqueue(study: Study, settings: Sequence[Mapping[str, Choice]]) -> None:
    """Enqueue these settings for the next trials, each only once."""
    for setting in settings:
        study.enqueue_trial(dict(setting), skip_if_exists=True)


def _trial_of(run: Path) -> Path:
    """Return the trial whose settings, but not its learning rate, a sweep's last clone has; else the run itself."""
    lineage, summary = read_lineage(run), read_object(run / SUMMARY)
    of_last_stage = lineage is not None and "study" in summary and "trial" not in summary
    return run.with_name(lineage.parent) if lineage is not None and of_last_stage else run


def _setting(entry: Mapping[str, Any] | str, space: SearchSpace, request: SweepRequest) -> dict[str, Choice]:
    axes = {axis.key: axis for axis in space.dimensions}
    where = f"sweep.enqueue={entry}"
    plain: Mapping[str, Any]
    if isinstance(entry, str):
        values = read_config(_trial_of(resolve(entry, request.runs_dir, request.tracking_uri).path))
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
