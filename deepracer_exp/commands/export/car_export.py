"""A policy of ours as the archive for a physical car."""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.agents.actor_critic import PolicyNetworks
from deepracer_exp.agents.service_weights import to_service
from deepracer_exp.agents.soft_actor_critic import BoundedGaussian
from deepracer_exp.aws.models.car_archive import (
    ENDING,
    GRAPH,
    METADATA,
    Tensors,
    check_weights,
    describe_commands,
    name_on_car,
    sensor_notes,
    tar_gz,
)
from deepracer_exp.aws.models.car_controls import full_scale
from deepracer_exp.aws.models.graph_def import HEAD, policy_graph
from deepracer_exp.aws.models.model_metadata import Action, ModelMetadata, model_metadata_text
from deepracer_exp.config.driving import LidarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig
from deepracer_exp.env.action_space import ActionSpace, ContinuousActions, build_action_space, metadata_of
from deepracer_exp.env.real_car import check_car
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.next_steps import own_word
from deepracer_exp.runs.stored_run import StoredRun

from .aws_files import sensor_keys, services_kind
from .written import Written, checkpoint_line, write_file


class Rescaling(NamedTuple):
    """Rescaling of the outputs [steering, speed], clipped to -1..1: factor * output + shift; (2,) each."""

    factor: NDArray[np.float64]
    shift: NDArray[np.float64]


class CarArchive(NamedTuple):
    """The archive to upload to a car."""

    files: Mapping[str, bytes]
    """Content by name, in the order in which they are packed."""
    metadata: ModelMetadata
    notes: list[str]
    """One for each change and each deviation of the car."""

    def content(self) -> bytes:
        """Return the .tar.gz."""
        return tar_gz(self.files)


def export_car(
    run: StoredRun, path: Path, add: Callable[[CarArchive], CarArchive] = lambda archive: archive
) -> Written:
    """Write the archive of a policy for a physical car, with the additions of `add`.

    Arguments, result and errors as for `export.Writer`.
    """
    if not path.name.endswith(ENDING) or path.is_dir():
        raise BadInput(
            f"--output {path}", "", f"a file whose name ends in {ENDING}, as the car's console wants it"
        )
    stored = run.read_policy()
    archive = add(car_archive(stored.networks, run.experiment))
    content = archive.content()
    write_file(path, content)
    return [path], [
        checkpoint_line(stored),
        f"model        {name_on_car(path.name)} on the car, {len(content) / 1e6:.1f} MB",
        f"reads        {', '.join(archive.metadata.sensor)}",
        *archive.notes,
        "What the car makes of the actions, with its maximum speed at 100%:",
        *describe_commands(archive.metadata),
        f"check it before the drive: deepracer-exp check {shlex.quote(own_word(run.path))} --car",
    ]


def name_in_exports(run: StoredRun) -> str:
    """Return the name of the archive in a run's folder of exports."""
    return name_on_car(run.path.name) + ENDING


def car_archive(networks: PolicyNetworks, experiment: Experiment) -> CarArchive:
    """Return the archive of a policy; the same policy gives the same bytes.

    Raises:
        BadInput: the car would refuse or misread it.
        RunFailed: the graph does not hold the network's weights.
    """
    observation, network = experiment.observation, experiment.network
    check_car(experiment)
    actions = build_action_space(experiment.action_space)
    metadata, rescaling = car_actions(actions)
    metadata = replace(metadata, **sensor_keys(observation))
    notes = sensor_notes(metadata.sensor)
    tensors: Tensors = to_service(networks, metadata.sensor)
    bounds = tangent = None
    if isinstance(networks.policy_head[0].module, BoundedGaussian):
        # The car takes the output of PPO's head for the mean, so the tangent of ours is part of the graph.
        factor, shift = rescaling or Rescaling(np.ones(2), np.zeros(2))
        tangent = factor.astype(np.float32), shift.astype(np.float32)
    elif rescaling is not None:
        factor, shift = rescaling
        tensors = _rescaled(tensors, rescaling)
        bounds = (shift - factor).astype(np.float32), (shift + factor).astype(np.float32)
    if rescaling is not None:
        lock_deg = full_scale(metadata).steering_deg
        notes.append(
            f"steering from {actions.low[0]:g} to {actions.high[0]:g} degrees is written as -{lock_deg:g} to "
            f"{lock_deg:g}, and the outputs are rescaled to give the same angles: the car divides by the high end alone"
        )
    # Anything else was refused by `check_car` or `to_service`.
    assert observation.camera is not None
    assert isinstance(network, CNNConfig)
    channels, height, width = observation.camera.shape
    shapes: list[tuple[int, ...]] = [(height, width, channels)]
    if observation.lidar is not None:
        shapes.append((observation.lidar.size,))
    inputs = dict(zip(metadata.sensor, shapes, strict=True))
    graph = policy_graph(tensors, inputs, network.strides, bounds, tangent)
    check_weights(graph, tensors)
    values = json.loads(model_metadata_text(metadata))
    if (kind := services_kind(experiment, metadata)) is None:  # the car does not ask
        del values["neural_network"]
    else:
        values["neural_network"] = kind
    if observation.lidar is not None:
        values["lidar_config"] = _lidar_config(observation.lidar)
    text = json.dumps(values, indent=2) + "\n"
    return CarArchive({METADATA: text.encode(), GRAPH: graph}, metadata, notes)


def car_actions(actions: ActionSpace) -> tuple[ModelMetadata, Rescaling | None]:
    """Return an action space in a form that the car scales correctly, and the rescaling of the outputs that it needs.

    The car divides steering by the high end alone, so that only a range from -x to x comes out right.
    """
    metadata = metadata_of(actions)
    if not isinstance(actions, ContinuousActions) or actions.low[0] == -actions.high[0]:
        return metadata, None
    lock_deg = max(abs(actions.low[0]), abs(actions.high[0]))
    low, high = np.array([-lock_deg, actions.low[1]]), np.array([lock_deg, actions.high[1]])
    factor = (actions.high - actions.low) / (high - low)
    shift = (actions.high + actions.low - high - low) / (high - low)
    return replace(metadata, low=Action(*low.tolist()), high=Action(*high.tolist())), Rescaling(factor, shift)


def _rescaled(tensors: Tensors, rescaling: Rescaling) -> Tensors:
    """Return the tensors with factor and shift applied in the last layer."""
    kernel, bias = (tensors[f"{HEAD}/policy_mean/{name}"] for name in ("kernel", "bias"))
    return {
        **tensors,
        f"{HEAD}/policy_mean/kernel": (kernel * rescaling.factor).astype(np.float32),
        f"{HEAD}/policy_mean/bias": (bias * rescaling.factor + rescaling.shift).astype(np.float32),
    }


def _lidar_config(lidar: LidarConfig) -> dict[str, float]:
    """Return the keys of the car's own `lidar_config`, all of which it needs; they differ from the simulator's."""
    from deepracer_exp.sim.lidar_rays import ANGLES_RAD, NEAREST_M, RAYS

    angle_deg = round(float(np.degrees(ANGLES_RAD[-1])), 1)
    return {
        "num_values": RAYS,
        "min_angle": -angle_deg,
        "max_angle": angle_deg,
        "min_distance": NEAREST_M,
        "max_distance": float(lidar.furthest_m),  # the car refuses whole numbers
        "clipping_distance": float(lidar.furthest_m),
        "num_sectors": lidar.size,
    }
