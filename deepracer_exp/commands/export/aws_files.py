"""The files that the AWS console and deepracer-for-cloud train from: reward function, action space, hyperparameters."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from deepracer_exp.aws.models.hyperparameters import CONSOLE_RANGES, Hyperparameters, hyperparameters_text
from deepracer_exp.aws.models.model_metadata import (
    LIDARS,
    NEURAL_NETWORKS,
    LidarSectors,
    ModelMetadata,
    beyond_console,
    model_metadata_text,
)
from deepracer_exp.commands.validation.aws_rules import text_findings
from deepracer_exp.config.custom_files.model_files import CARS, SAC_TAKEN, TAKEN
from deepracer_exp.config.driving import ObservationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig, SACConfig
from deepracer_exp.config.named import services_layers
from deepracer_exp.env.action_space import build_action_space, metadata_of
from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.stored_run import StoredRun

from .written import Written, reward_text, write_files


def export_files(run: StoredRun, folder: Path) -> Written:
    """Write the files that a training on AWS starts from; arguments, result and errors as for `export.Writer`."""
    reward = reward_text(run)
    texts, notes = aws_files(run.experiment, reward)
    write_files(texts, folder)
    refused = [
        f"reward_function.py: deepracer-on-aws would refuse it: {finding}"
        for finding in text_findings(reward)
    ]
    return (folder / name for name in texts), notes + refused


def aws_files(experiment: Experiment, reward: str) -> tuple[dict[str, str], list[str]]:
    """Return the texts of an experiment's files by name, and a note on each value changed or beyond the console.

    Hyperparameters are clipped to the console's ranges. The action space is kept, because a policy only fits its own.
    `reward` is the text of the reward function, with its constants filled in.
    """
    metadata = services_metadata(experiment)
    if isinstance(experiment.algorithm, SACConfig) and metadata.training_algorithm != "sac":
        raise BadInput(
            "algorithm",
            f"SAC with a list of {count(len(metadata.actions), 'action')}, which the service's SAC cannot have",
            "a run with action_space=continuous or algorithm=ppo, or format=onnx or car",
        )
    learning, changed = _hyperparameters(experiment)
    texts = {
        "reward_function.py": reward,
        "model_metadata.json": model_metadata_text(metadata),
        "hyperparameters.json": hyperparameters_text(learning),
    }
    notes = []
    if isinstance(experiment.network, CNNConfig) and services_kind(experiment, metadata) is None:
        notes.append(
            f"model_metadata.json: neural_network={metadata.neural_network}: the service has no network like this run's"
        )
    return texts, [*notes, *beyond_console(metadata), *changed]


def services_metadata(experiment: Experiment) -> ModelMetadata:
    """Return the action space, the sensors and the car's simulation version of an experiment in the service's terms."""
    actions = metadata_of(build_action_space(experiment.action_space))
    version = next((number for number, car in CARS.items() if car == experiment.car.name), actions.version)
    # The service's SAC has no lists of actions.
    algorithm = "sac" if isinstance(experiment.algorithm, SACConfig) and actions.low else "clipped_ppo"
    sensors = sensor_keys(experiment.observation)
    metadata = replace(actions, version=version, training_algorithm=algorithm, **sensors)
    return replace(metadata, neural_network=services_kind(experiment, metadata) or NEURAL_NETWORKS[0])


def services_kind(experiment: Experiment, metadata: ModelMetadata) -> str | None:
    """Return the service's name of the network that an experiment trains; None: it builds no such network.

    `metadata` has the sensors.
    """
    if not isinstance(experiment.network, CNNConfig):
        return None
    layers = network_layers(experiment)
    for kind in NEURAL_NETWORKS:
        services = services_layers(replace(metadata, neural_network=kind))
        if all(list(value) == list(services[key]) for key, value in layers.items()):
            return kind
    return None


def network_layers(experiment: Experiment) -> dict[str, Sequence[int]]:
    """Return the layers of a network for pictures that the service's networks may differ in, by key."""
    keys = ["filters", "kernels", "strides", "hidden", *["lidar_hidden"] * bool(experiment.observation.lidar)]
    return {key: getattr(experiment.network, key) for key in keys}


def sensor_keys(observation: ObservationConfig) -> dict[str, Any]:
    """Return the keys of a model's metadata for the observation; the service's models all have a camera."""
    stereo = observation.camera is not None and observation.camera.stereo_m > 0
    camera, lidar = "STEREO_CAMERAS" if stereo else "FRONT_FACING_CAMERA", observation.lidar
    if lidar is None:
        return {"sensor": (camera,)}
    name = LIDARS[("plain", "sectors", "discretized").index(lidar.kind)]
    return {
        "sensor": (camera, name),
        "lidar_config": LidarSectors(lidar.sectors, lidar.values_per_sector, lidar.furthest_m),
    }


def hyperparameters_of(experiment: Experiment) -> Hyperparameters:
    """Return an experiment's hyperparameters in the service's terms, with the service's default where it has none."""
    is_sac = isinstance(experiment.algorithm, SACConfig)
    values: dict[str, Any] = {"exploration_type": "additive_noise"} if is_sac else {}
    for key, target in (SAC_TAKEN if is_sac else TAKEN).items():
        group, name = target.split(".")
        values[key] = getattr(getattr(experiment, group), name)
    return replace(Hyperparameters(), **{key: value for key, value in values.items() if value is not None})


def _hyperparameters(experiment: Experiment) -> tuple[Hyperparameters, list[str]]:
    notes = []
    learning = hyperparameters_of(experiment)
    is_sac = isinstance(experiment.algorithm, SACConfig)
    if is_sac:
        notes.append(
            "hyperparameters.json: the service's SAC learns after each episode, with sac_alpha fixed and one gradient "
            "step for each step; its replay, targets and temperature cannot be set"
        )
    elif experiment.algorithm.episodes_per_iteration is None:
        notes.append(
            f"hyperparameters.json: num_episodes_between_training={learning.num_episodes_between_training}, the "
            f"service's default; this run used {experiment.algorithm.frames_per_iteration} control steps per iteration"
        )
    for key in learning.beyond_console():
        value = getattr(learning, key)
        low, high = CONSOLE_RANGES[key]
        nearest = min(max(value, low), high)
        if key == "batch_size":
            nearest = min((1 << power for power in range(5, 10)), key=lambda size: abs(size - value))
        learning = replace(learning, **{key: nearest})
        notes.append(
            f"hyperparameters.json: {key}={nearest}, the nearest to {value:g} that the AWS console accepts"
        )
    return learning, notes
