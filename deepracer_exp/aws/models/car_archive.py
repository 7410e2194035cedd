"""A policy as the archive for a physical car: model_metadata.json and a frozen graph.

Source of the car's behaviour: deepracer-custom-car 2.1.9.9, which in these points is AWS's own (model_loader_node.py,
model_optimizer_node.py, deepracer_navigation_node.py, sensor_fusion_node.cpp, and models.py of its web server).
"""

import gzip
import io
import tarfile
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import RunFailed

from .car_controls import full_scale, steering_share, throttle
from .graph_def import POLICY_NETWORK, read_weights
from .model_metadata import ModelMetadata

ENDING = ".tar.gz"
"""The car's console takes no file with another ending."""
METADATA, GRAPH = "model_metadata.json", "agent/model.pb"

Tensors = Mapping[str, NDArray[np.float32]]


def tar_gz(files: Mapping[str, bytes]) -> bytes:
    """Return a reproducible .tar.gz."""
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


def check_weights(graph: bytes, tensors: Tensors) -> None:
    """Compare the weights in a graph with those of the policy.

    Raises:
        RunFailed: they differ.
    """
    written = read_weights(GRAPH, graph, has_tangent=True)
    policy = {
        name: value
        for name, value in tensors.items()
        if name.startswith(f"{POLICY_NETWORK}/") and name.endswith(("/kernel", "/bias"))
    }
    if policy.keys() != written.keys() or not all(
        np.array_equal(policy[name], written[name]) for name in policy
    ):
        raise RunFailed(f"{GRAPH}: its weights are not the network's")


def sensor_notes(sensors: tuple[str, ...]) -> list[str]:
    """Return a line on each deviation of the car with these sensors."""
    notes = []
    if "STEREO_CAMERAS" in sensors:
        notes.append(
            "STEREO_CAMERAS: with OpenVINO 2021, as in AWS's own software, the car reads the two pictures correctly; "
            "with TensorFlow Lite or OpenVINO 2024 (deepracer-custom-car) it mixes up their pixels"
        )
    if len(sensors) > 1:
        notes.append(
            f"{' and '.join(sensors)}: deepracer-custom-car with OpenVINO 2024 takes the two in random order "
            "when it converts the model, and fails in one of the two; a restart draws again"
        )
    if "LIDAR" in sensors:
        notes.append(
            "lidar_config: with it, the car's distances reach as far as in the training; the service's archives have "
            "none, and there they end at 0.5 m"
        )
    return notes


def describe_commands(metadata: ModelMetadata) -> list[str]:
    """Return a line with the car's response to each action; for a continuous space, to its ends and middle."""
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
