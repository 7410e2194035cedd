"""A model that was trained with the service, as a run of our own (`deepracer-exp import`)."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.aws.models.archive import StoredModel, read_model
from deepracer_exp.aws.models.job_settings import read_training_params
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.custom_files.file_overrides import car_override
from deepracer_exp.config.custom_files.imported_options import import_files, remove_options
from deepracer_exp.config.custom_files.job_overrides import job_overrides
from deepracer_exp.config.custom_files.model_files import (
    KEY,
    PLACES,
    CustomFiles,
    read_custom_files,
    sensor_overrides,
)
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.overrides import key_of, override_line
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.training.imported_weights import fit_weights, networks_to_try, remarks_on_weights
from deepracer_exp.training.plan import plan_training
from deepracer_exp.training.run import store_run

_CHECKPOINT = "checkpoint="
_PARAMS = "training_params.yaml"
"""The file of a trained model with the track and the opponents of its training."""
_CHOSEN_HERE = ("sensor", "neural_network", "lidar_config")
"""Keys of model_metadata.json without effect if the files become options only."""


@dataclass(frozen=True)
class Imported:
    """The run made from a model, with notes."""

    folder: Path
    """Folder of the run."""
    options: list[Path]
    """Files written to `./conf`."""
    notes: list[str]
    has_logs: bool


def import_model(path: str, name: str, overrides: Sequence[str]) -> Imported:
    """Make a run and options of a model of the service; nothing of it is run.

    `overrides` are those of the experiment, and `checkpoint=best` or `last`, as the service marks its checkpoints.

    Raises:
        BadInput: there is no model, it cannot be used here, or the run cannot be written; nothing is left.
    """
    checkpoints = [
        override.removeprefix(_CHECKPOINT) for override in overrides if override.startswith(_CHECKPOINT)
    ]
    changes = [override for override in overrides if not override.startswith(_CHECKPOINT)]
    wanted = checkpoints[-1] if checkpoints else "best"
    if wanted not in ("best", "last"):
        raise BadInput(f"checkpoint={wanted}", "", "best, last (of the service's deepracer_checkpoints.json)")
    model = read_model(path, wanted)
    with tempfile.TemporaryDirectory() as aside:
        for file in (*PLACES, _PARAMS):
            if file in model.files:
                Path(aside, file).write_bytes(model.files[file])
        try:
            return _import(model, path, aside, name, changes)
        except BadInput as error:
            raise BadInput(str(error).replace(f"{KEY} {aside}", path).replace(aside, path)) from error


def _import(model: StoredModel, path: str, aside: str, name: str, changes: Sequence[str]) -> Imported:
    if "model_metadata.json" not in model.files:
        raise BadInput(
            f"{path}: holds no model_metadata.json, which says what the policy sees and does; put it beside the weights"
        )
    files = read_custom_files(aside)
    assert files.metadata is not None
    seen = sensor_overrides(files.metadata)
    params = read_training_params(str(Path(aside, _PARAMS))) if _PARAMS in model.files else None
    typed = {key_of(line): line for line in (*seen, *changes)}
    job, applied = job_overrides(params, typed) if params else ([], [])
    described = [override_line(KEY, files.folder), *job, *seen, override_line("name", name)]
    fitted = _fit(model, files, described, changes)
    load_reward_source(fitted.experiment.reward)
    lines = [*job, *fitted.lines, *seen]
    options = import_files(files, name, fitted.composition.mapping, lines, path)
    try:
        experiment, composition = compose_experiment([f"experiment={name}", *changes])
        plan = plan_training(experiment, composition)
        result = store_run(plan, fitted.networks, f"imported from {model.source}")
    except BaseException:
        remove_options(options)
        raise
    notes = [f"{model.source}: {', '.join([*seen, *fitted.lines])}", *model.notes]
    if params is None or params.world is None:
        notes.append(
            "the track of the training is not known: the default is used; track=NAME chooses another"
        )
    notes += [*remarks_on_weights(files, fitted.absent), *files.remarks(besides=_CHOSEN_HERE)]
    if "reward_function.py" not in model.files:
        notes.append(
            "reward_function.py: not among the files; clones learn from the default reward unless given reward="
        )
    notes += [*car_override(files, typed)[1], *applied]
    return Imported(result.folder, options, list(dict.fromkeys(notes)), model.has_logs)


@dataclass(frozen=True)
class _Fitted:
    """The experiment whose networks have a model's weights."""

    experiment: Experiment
    composition: Composition
    lines: list[str]
    """The overrides for its network."""
    networks: PolicyNetworks
    absent: list[str]
    """Names of the weights that the model lacks."""


def _fit(model: StoredModel, files: CustomFiles, described: Sequence[str], changes: Sequence[str]) -> _Fitted:
    """Return the experiment with that network of the service that the weights belong to."""
    refused = None
    for lines in networks_to_try(model, files):
        experiment, composition = compose_experiment([*described, *lines, *changes])
        try:
            return _Fitted(experiment, composition, lines, *fit_weights(model, files, experiment))
        except BadInput as error:
            refused = refused or error
    assert refused is not None
    raise refused
