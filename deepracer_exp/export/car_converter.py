"""The archive of a policy in OpenVINO, as the software of a physical car converts and runs it.

Source: deepracer-custom-car 2.1.9.9 (model_optimizer_node.py: weights are stored in half precision;
intel_ov_inference_eng.cpp: one picture at a time, in half precision where the processor has instructions for it).
"""

import io
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deepracer_exp.aws.models.car_archive import GRAPH
from deepracer_exp.aws.models.graph_def import INPUTS, POLICY
from deepracer_exp.aws.models.model_metadata import ModelMetadata

from .car_archive import CarArchive
from .onnx import DeployedPolicy

SAME = 0.01
"""Share of the range of steering or speed up to which two commands are the same."""
NEEDED = "pip install 'deepracer-exp[car]'"

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Conversion:
    """What OpenVINO decides on n pictures beside the policy of the archive."""

    same: NDArray[np.bool_]
    """Whether steering and speed are the same up to `SAME` of their ranges, (n,)."""
    difference: float
    """Largest difference of a probability; of a continuous policy, of steering or speed as a share of its range."""

    def words(self) -> str:
        """Return how often the commands are the same: ``same action on 242 of 242 pictures``."""
        return f"same action on {self.same.sum():,} of {len(self.same):,} pictures"


def has_openvino() -> bool:
    """Return whether the car's converter is installed."""
    try:
        import openvino  # noqa: F401
    except ImportError:
        return False
    return True


def run_in_openvino(archive: CarArchive, seen: Sequence[Tensor]) -> Floats:
    """Return what the graph in an archive gives in OpenVINO, (n, outputs).

    Args:
        archive: of the policy.
        seen: what `DeployedPolicy` reads: pictures (n, channels, height, width), bytes, then readings of a LIDAR.
    """
    import openvino

    with tarfile.open(fileobj=io.BytesIO(archive.content)) as packed:
        file = packed.extractfile(GRAPH)
        assert file is not None
        graph = file.read()
    fed = {
        f"{INPUTS}/{sensor}/{sensor}:0": (
            values.permute(0, 2, 3, 1) if values.dtype == torch.uint8 else values
        ).numpy(force=True)
        for sensor, values in zip(archive.metadata.sensor, seen, strict=True)
    }
    core = openvino.Core()
    with tempfile.TemporaryDirectory() as folder:
        frozen, converted = Path(folder, "model.pb"), Path(folder, "model.xml")
        frozen.write_bytes(graph)
        # The converter that its Python package offers does the same, but reports each conversion to its makers.
        model = core.read_model(frozen)
        model.reshape({name: [1, *values.shape[1:]] for name, values in fed.items()})
        openvino.save_model(model, converted, compress_to_fp16=True)
        settings = {"INFERENCE_PRECISION_HINT": "f16", "INFERENCE_NUM_THREADS": 1}
        compiled = core.compile_model(converted, "CPU", settings)
    rows = [
        compiled({name: values[[row]].astype(np.float32) for name, values in fed.items()})[f"{POLICY}:0"][0]
        for row in range(len(seen[0]))
    ]
    outputs: Floats = np.array(rows)
    return outputs


def compare_in_openvino(archive: CarArchive, policy: DeployedPolicy, seen: Sequence[Tensor]) -> Conversion:
    """Compare what an archive's graph decides in OpenVINO with its policy; arguments as for `run_in_openvino`."""
    outputs = run_in_openvino(archive, seen)
    with torch.no_grad():
        ours, commands = (values.numpy() for values in policy(*seen))
    theirs = _commands(archive.metadata, outputs)
    apart = np.abs(theirs - commands) / _reach(archive.metadata)
    is_discrete = archive.metadata.high is None
    return Conversion(
        (apart <= SAME).all(axis=1), float(np.abs(outputs - ours).max() if is_discrete else apart.max())
    )


def _commands(metadata: ModelMetadata, outputs: Floats) -> Floats:
    """Return the steering in degrees and the speed in m/s that the car takes from a graph's outputs, (n, 2)."""
    if metadata.low is None or metadata.high is None:
        return np.array(metadata.actions)[outputs.argmax(axis=1)]
    share = (np.clip(outputs, -1, 1) + 1) / 2
    return np.array(metadata.low) * (1 - share) + np.array(metadata.high) * share


def _reach(metadata: ModelMetadata) -> Floats:
    """Return the ranges of steering and speed, (2,)."""
    if metadata.low is None or metadata.high is None:
        # Of a single speed, one that is not 0.
        return np.maximum(np.ptp(np.array(metadata.actions), axis=0), 1e-6)
    reach: Floats = np.array(metadata.high) - np.array(metadata.low)
    return reach
