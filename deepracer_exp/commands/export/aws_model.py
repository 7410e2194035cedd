"""A policy as a pretrained model that deepracer-for-cloud clones and deepracer-on-aws imports."""

from dataclasses import replace
from pathlib import Path

import torch
import yaml

from deepracer_exp.agents.actor_critic import ActorCritic, SensorNet, build_actor_critic
from deepracer_exp.agents.service_weights import to_service
from deepracer_exp.aws.models.archive import checkpoint_files
from deepracer_exp.aws.models.model_metadata import (
    LIDARS,
    NEURAL_NETWORKS,
    ModelMetadata,
)
from deepracer_exp.aws.worlds.catalogue import find_world
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig
from deepracer_exp.config.named import network_overrides
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoints import StoredPolicy
from deepracer_exp.runs.run_result import read_result
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.tracks.track import Track

from .aws_files import aws_files, network_layers, services_kind, services_metadata
from .written import Written, reward_text, write_files

_PIXELS = 160, 120


def export_model(run: StoredRun, folder: Path) -> Written:
    """Write a pretrained model of the service; arguments, result and errors as for `export.Writer`."""
    stored = run.read_policy()
    result = read_result(run.path)
    score = result.completion if result and result.iteration == stored.counters["iteration"] else None
    files, notes = aws_model(run.experiment, stored, reward_text(run), score)
    write_files(files, folder)
    return (folder / name for name in sorted(files)), notes


def aws_model(
    experiment: Experiment, stored: StoredPolicy, reward: str, score: float | None
) -> tuple[dict[str, bytes], list[str]]:
    """Return the contents of a model's files by name, and notes.

    `reward` is the text of the reward function, with its constants filled in, `score` the mean progress of the
    checkpoint's evaluation in per cent.

    Raises:
        BadInput: the service has no such network or sensors.
    """
    texts, notes = aws_files(experiment, reward)
    metadata = services_metadata(experiment)
    if not isinstance(stored.networks, ActorCritic):
        raise BadInput(
            "algorithm",
            "is SAC, whose critics the service has in degrees and metres per second",
            "a run with algorithm=ppo, or format=car, onnx or aws",
        )
    _refuse_other_sensors(experiment, metadata)
    networks, note = _with_value(experiment, stored.networks)
    tensors = to_service(networks, metadata.sensor)
    _refuse_other_network(experiment, metadata)
    texts["training_params.yaml"], unknown = _training_params(experiment)
    # Where deepracer-for-cloud looks for it.
    texts["model/model_metadata.json"] = texts["model_metadata.json"]
    files = {file: text.encode() for file, text in texts.items()}
    files |= checkpoint_files(tensors, stored.counters["iteration"], stored.counters["env_steps"], score)
    return files, [*note, *unknown, *notes]


def _refuse_other_sensors(experiment: Experiment, metadata: ModelMetadata) -> None:
    camera, lidar = experiment.observation.camera, experiment.observation.lidar
    if camera is None:
        raise BadInput(
            "observation: has no camera, and every model of the service has one; accepted: a run with "
            "observation=camera, stereo or camera_lidar"
        )
    if (camera.width, camera.height) != _PIXELS:
        raise BadInput(
            f"observation.camera: {camera.width}x{camera.height}; accepted: {_PIXELS[0]}x{_PIXELS[1]}, which the "
            "service's models see (observation=camera)"
        )
    if lidar is None:
        return
    services = replace(lidar, reach_m=None).furthest_m
    if LIDARS[2] not in metadata.sensor and lidar.furthest_m != services:
        raise BadInput(
            f"observation.lidar.reach_m={lidar.furthest_m:g}: accepted: {services:g}, which the service's LIDAR "
            "of this kind sees"
        )
    if abs(lidar.yaw_deg) != 180:
        raise BadInput(f"observation.lidar.yaw_deg={lidar.yaw_deg:g}", "", "180, as the service mounts it")


def _refuse_other_network(experiment: Experiment, metadata: ModelMetadata) -> None:
    if services_kind(experiment, metadata) is None:
        options = [
            " ".join(network_overrides(replace(metadata, neural_network=kind))) for kind in NEURAL_NETWORKS
        ]
        shown = ", ".join(f"{key}={list(value)}" for key, value in network_layers(experiment).items())
        raise BadInput("network", f"{shown}: the service builds no such network", "; or ".join(options))


def _with_value(experiment: Experiment, networks: ActorCritic) -> tuple[ActorCritic, list[str]]:
    """Return networks that both see pictures, and a note if the value network is a new one."""
    network = experiment.network
    if not isinstance(network, CNNConfig) or network.critic == "pictures":
        return networks, []
    fresh = build_actor_critic(
        replace(network, critic="pictures"),
        observation_shape(experiment.observation),
        build_action_space(experiment.action_space).n,
        torch.Generator().manual_seed(experiment.seed),
    )
    assert isinstance(fresh.value_head.module, SensorNet)
    return ActorCritic(networks.policy_head, fresh.value_head), [
        "value network: the run's sees features, which the service does not have, so a new one is written: the policy "
        "races as it does here, but a training on the service has to learn the values first"
    ]


def _training_params(experiment: Experiment) -> tuple[str, list[str]]:
    """Return the training parameters that deepracer-on-aws reads, and a note if the track is not the service's."""
    name, config = next(iter(experiment.tracks.items()))
    world, notes = None if config.file else find_world(name), list[str]()
    if world is None:
        world = "reinvent_base"
        notes = [f"training_params.yaml: WORLD_NAME={world}, because {name} is no track of the service"]
    values = {
        "WORLD_NAME": world,
        "RACE_TYPE": "TIME_TRIAL",
        "TRACK_DIRECTION_CLOCKWISE": Track.from_config(config).is_clockwise,
        "BODY_SHELL_TYPE": "deepracer",
        "CAR_COLOR": "White",
    }
    return yaml.safe_dump(values, sort_keys=False), notes
