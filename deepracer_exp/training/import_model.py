"""A model that was trained with the service, as a run of our own."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.agents.build import build_networks
from deepracer_exp.agents.service_weights import (
    SAC_HIDDEN,
    VALUE,
    from_service,
    match_service,
    policy_of_sac,
)
from deepracer_exp.aws.models.archive import StoredModel, Tensors, read_model
from deepracer_exp.aws.models.job_settings import read_training_params
from deepracer_exp.aws.models.model_metadata import NEURAL_NETWORKS, ModelMetadata
from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.custom_files import (
    KEY,
    PLACES,
    SAC_DIFFERS,
    CustomFiles,
    read_custom_files,
    sensor_overrides,
)
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.file_overrides import car_override
from deepracer_exp.config.imported_options import import_files, remove_options
from deepracer_exp.config.job_overrides import job_overrides
from deepracer_exp.config.learning import CNNConfig, SACConfig
from deepracer_exp.config.named import network_overrides, services_layers
from deepracer_exp.config.overrides import key_of, override_line
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import load_reward_source

from .plan import plan_training
from .run import store_run

_CHECKPOINT = "checkpoint="
_PARAMS = "training_params.yaml"
"""The file of a trained model that says on which track and against whom the service trained it."""
_CHOSEN_HERE = ("sensor", "neural_network", "lidar_config")
"""Keys of model_metadata.json that have no effect where only options are made of the files."""


@dataclass(frozen=True)
class Imported:
    """The run that a model became, and remarks on it."""

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
    experiment, composition, networks, network, absent = _fit(model, files, [*job, *seen], name, changes)
    load_reward_source(experiment.reward)
    options = import_files(files, name, composition.mapping, [*job, *network, *seen], path)
    try:
        experiment, composition = compose_experiment([f"experiment={name}", *changes])
        result = store_run(plan_training(experiment, composition), networks, f"imported from {model.source}")
    except BaseException:
        remove_options(options)
        raise
    notes = [f"{model.source}: {', '.join([*seen, *network])}", *model.notes]
    if params is None or params.world is None:
        notes.append(
            "the track of the training is not known: the default is used; track=NAME chooses another"
        )
    notes += [*_remarks(files, model, absent), *car_override(files, typed)[1], *applied]
    return Imported(result.folder, options, list(dict.fromkeys(notes)), model.has_logs)


def _fit(
    model: StoredModel, files: CustomFiles, lines: Sequence[str], name: str, changes: Sequence[str]
) -> tuple[Experiment, Composition, PolicyNetworks, list[str], list[str]]:
    """Return the experiment with that network of the service that the weights belong to, and what is absent."""
    metadata, refused = files.metadata, None
    assert metadata is not None
    tensors = policy_of_sac(model.tensors, model.source) if files.is_sac else model.tensors
    for kind in _kinds(metadata, tensors):
        network = network_overrides(replace(metadata, neural_network=kind))
        if files.is_sac:
            hidden = [*services_layers(replace(metadata, neural_network=kind))["hidden"], SAC_HIDDEN]
            network.append(override_line("network.hidden", hidden))
        described = [override_line(KEY, files.folder), *lines, *network, override_line("name", name)]
        experiment, composition = compose_experiment([*described, *changes])
        if not isinstance(experiment.network, CNNConfig):
            raise BadInput("network", "the weights are of a network of the service; leave network= off")
        if isinstance(experiment.algorithm, SACConfig) != files.is_sac:
            trained = "SAC" if files.is_sac else "PPO"
            raise BadInput("algorithm", f"the weights are of {trained}; leave algorithm= off")
        shapes = observation_shape(experiment.observation), build_action_space(experiment.action_space).n
        try:
            with torch.device("meta"):  # shapes only: the weights of a model may take gigabytes
                networks = build_networks(experiment.network, experiment.algorithm, *shapes, None)
            absent = match_service(tensors, networks, metadata.sensor, model.source)[1]
        except BadInput as error:
            refused = refused or error
            continue
        if absent:
            generator = torch.Generator().manual_seed(experiment.seed)
            networks = build_networks(experiment.network, experiment.algorithm, *shapes, generator)
        else:
            networks.to_empty(device="cpu")
        from_service(tensors, networks, metadata.sensor, model.source)
        return experiment, composition, networks, network, absent
    assert refused is not None
    raise refused


def _kinds(metadata: ModelMetadata, tensors: Tensors) -> Iterator[str]:
    """Yield the network that the metadata names, then those with the model's convolutions."""
    yield metadata.neural_network
    held = sorted(value.shape for name, value in tensors.items() if value.ndim == 4 and "/network_1/" in name)
    for kind in NEURAL_NETWORKS:
        if kind == metadata.neural_network:
            continue
        layers = services_layers(replace(metadata, neural_network=kind))
        inputs = [2 if "STEREO_CAMERAS" in metadata.sensor else 1, *layers["filters"]]
        built = zip(layers["kernels"], layers["kernels"], inputs, layers["filters"], strict=False)
        if sorted(shape for shape in built if shape[0] > 1) == held:
            yield kind


def _remarks(files: CustomFiles, model: StoredModel, absent: Sequence[str]) -> list[str]:
    notes = []
    if files.is_sac:
        notes.append(
            "of SAC the policy is used: the service's critics see actions in degrees and m/s, so that ours start "
            "fresh, and a clone has to learn them first"
        )
        notes.append(SAC_DIFFERS)
    elif VALUE in absent:
        notes.append(
            "a frozen graph holds only the policy: the value network starts fresh, and a clone has to learn it first"
        )
    if any(name != VALUE for name in absent):
        notes.append(
            "a frozen graph holds no standard deviation of the actions: it starts at network.initial_std"
        )
    notes += files.remarks(besides=_CHOSEN_HERE)
    if "reward_function.py" not in model.files:
        notes.append(
            "reward_function.py: not among the files; clones learn from the default reward unless given reward="
        )
    return notes
