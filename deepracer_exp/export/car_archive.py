"""A policy as the archive that the software of a physical car loads: model_metadata.json and a frozen graph.

Source of what the car reads, refuses and misreads: deepracer-custom-car 2.1.9.9, which in these points is AWS's own
(model_loader_node.py, model_optimizer_node.py, deepracer_navigation_node.py, sensor_fusion_node.cpp, and models.py of
its web server).
"""

import gzip
import io
import json
import tarfile
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.aws.models.car_controls import full_scale, steering_share, throttle
from deepracer_exp.aws.models.graph_def import HEAD, POLICY_NETWORK, policy_graph, read_weights
from deepracer_exp.aws.models.model_metadata import Action, ModelMetadata, model_metadata_text
from deepracer_exp.config.driving import LidarConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import CNNConfig
from deepracer_exp.env.action_space import ActionSpace, ContinuousActions, build_action_space, metadata_of
from deepracer_exp.env.real_car import car_refusals
from deepracer_exp.errors import BadInput, RunFailed

from .aws_files import sensor_keys

if TYPE_CHECKING:
    from deepracer_exp.agents.actor_critic import ActorCritic

ENDING = ".tar.gz"
"""The car's console takes no file with another ending."""
METADATA, GRAPH = "model_metadata.json", "agent/model.pb"

Tensors = Mapping[str, NDArray[np.float32]]


class Rescaling(NamedTuple):
    """How to rescale the outputs [steering, speed], clipped to -1..1: factor * output + shift; (2,) each."""

    factor: NDArray[np.float64]
    shift: NDArray[np.float64]


class CarArchive(NamedTuple):
    """What is uploaded to a car."""

    content: bytes
    metadata: ModelMetadata
    notes: list[str]
    """One for each change, and for each thing that the car does differently."""


def check_car(experiment: Experiment) -> None:
    """Refuse a policy that the car could not load, or to which it would show something else.

    Raises:
        BadInput: naming the key and what would be accepted.
    """
    for refusal in car_refusals(experiment):
        raise BadInput(refusal)
    if experiment.observation.camera is None:
        raise BadInput(
            "observation.camera: null; a model of the service has a camera; accepted: observation=camera, stereo, "
            "camera_lidar"
        )


def car_archive(networks: "ActorCritic", experiment: Experiment) -> CarArchive:
    """Return the archive of a policy; the same policy gives the same bytes.

    Raises:
        BadInput: the car would refuse or misread it.
        RunFailed: the graph does not hold the network's weights.
    """
    from deepracer_exp.agents.service_weights import to_service

    from .aws_model import services_kind

    observation, network = experiment.observation, experiment.network
    check_car(experiment)
    actions = build_action_space(experiment.action_space)
    metadata, rescaling = car_actions(actions)
    metadata = replace(metadata, **sensor_keys(observation))
    notes = _notes(metadata.sensor)
    tensors: Tensors = to_service(networks, metadata.sensor)
    bounds = None
    if rescaling is not None:
        factor, shift = rescaling
        tensors = _rescaled(tensors, rescaling)
        bounds = (shift - factor).astype(np.float32), (shift + factor).astype(np.float32)
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
    graph = policy_graph(tensors, inputs, network.strides, bounds)
    check_weights(graph, tensors)
    values = json.loads(model_metadata_text(metadata))
    try:
        values["neural_network"] = services_kind(experiment, metadata)
    except BadInput:  # the service has no such network; the car does not ask
        del values["neural_network"]
    if observation.lidar is not None:
        values["lidar_config"] = _lidar_config(observation.lidar)
    text = json.dumps(values, indent=2) + "\n"
    return CarArchive(_packed({METADATA: text.encode(), GRAPH: graph}), metadata, notes)


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


def check_weights(graph: bytes, tensors: Tensors) -> None:
    """Compare the weights in a graph with those of the policy.

    Raises:
        RunFailed: they differ.
    """
    written = read_weights(GRAPH, graph)
    policy = {
        name: value
        for name, value in tensors.items()
        if name.startswith(f"{POLICY_NETWORK}/") and name.endswith(("/kernel", "/bias"))
    }
    if policy.keys() != written.keys() or not all(
        np.array_equal(policy[name], written[name]) for name in policy
    ):
        raise RunFailed(f"{GRAPH}: its weights are not the network's")


def _lidar_config(lidar: LidarConfig) -> dict[str, float]:
    """Return the keys of the car's own `lidar_config`, all of which it needs; they differ from the simulator's."""
    from deepracer_exp.sim.lidar import ANGLES_RAD, NEAREST_M, RAYS

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


def _packed(files: Mapping[str, bytes]) -> bytes:
    """Return a .tar.gz with nothing in it that differs between two exports."""
    out = io.BytesIO()
    with (
        # Weights hardly compress, at any level.
        gzip.GzipFile(filename="", mode="wb", fileobj=out, mtime=0, compresslevel=1) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return out.getvalue()


def _notes(sensors: tuple[str, ...]) -> list[str]:
    notes = []
    if "STEREO_CAMERAS" in sensors:
        notes.append(
            "STEREO_CAMERAS: with OpenVINO 2021, as in AWS's own software, the car reads the two pictures correctly; "
            "with TensorFlow Lite or OpenVINO 2024 (deepracer-custom-car) it mixes up their pixels"
        )
    if len(sensors) > 1:
        notes.append(
            f"{' and '.join(sensors)}: deepracer-custom-car with OpenVINO 2024 takes the two in random order, "
            "and in one of the two orders fails to load the model; a restart draws again"
        )
    if "LIDAR" in sensors:
        notes.append(
            "lidar_config: with it, the car's distances reach as far as in the training; the service's archives have "
            "none, and there they end at 0.5 m"
        )
    return notes


def describe_commands(metadata: ModelMetadata) -> list[str]:
    """Return a line on what the car makes of each action; for a continuous space, of its ends and middle."""
    scale = full_scale(metadata)
    if metadata.low is not None and metadata.high is not None:
        ends = np.array([metadata.low, metadata.high])
        rows, names = np.stack([ends[0], ends.mean(axis=0), ends[1]]), ["lowest", "middle", "highest"]
    else:
        rows, names = np.array(metadata.actions), [str(number) for number in range(len(metadata.actions))]
    locks = steering_share(rows[:, 0], scale.steering_deg)
    throttles = throttle(rows[:, 1], scale.speed_mps)
    return [
        f"{name:>8} {steering_deg:+7.1f} deg {lock:+7.0%} of full lock {speed_mps:7.2f} m/s {power:5.0%} throttle"
        for name, (steering_deg, speed_mps), lock, power in zip(names, rows, locks, throttles, strict=True)
    ]


def name_on_car(file_name: str) -> str:
    """Return the name that the car gives to the model in an archive."""
    return file_name.split(".")[0].replace(" ", "_")
