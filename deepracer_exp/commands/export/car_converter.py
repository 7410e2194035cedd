"""The archive of a policy in OpenVINO, converted and run as by a physical car.

Source: deepracer-custom-car 2.1.9.9 (model_optimizer_node.py: weights are stored in half precision, and a model.xml of
OpenVINO 2022 or later that lies beside model.pb is taken as it is; intel_ov_inference_eng.cpp: one picture at a time,
height, width and channels in this order, in half precision where the processor has instructions for it).
"""

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
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.stored_run import StoredRun

from .car_export import CarArchive, export_car
from .onnx import DeployedPolicy
from .written import Written

SAME = 0.01
"""Share of the range of steering or speed up to which two commands are the same."""
NEEDED = "pip install 'deepracer-exp[car]'"
MODEL, WEIGHTS = "agent/model.xml", "agent/model.bin"
"""The graph in OpenVINO's intermediate representation, beside it: 11, its version since OpenVINO 2022."""

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Conversion:
    """Decisions of OpenVINO on n pictures, compared with the archive's policy."""

    same: NDArray[np.bool_]
    """Whether steering and speed are the same up to `SAME` of their ranges, (n,)."""
    difference: float
    """Largest difference of a probability; of a continuous policy, of steering or speed as a share of its range."""

    def words(self) -> str:
        """Return the number of equal commands: ``same action on 242 of 242 pictures``."""
        return f"same action on {self.same.sum():,} of {len(self.same):,} pictures"


def has_openvino() -> bool:
    """Return whether the car's converter is installed."""
    try:
        import openvino  # noqa: F401
    except ImportError:
        return False
    return True


def export_car_openvino(run: StoredRun, path: Path) -> Written:
    """Write the archive for a car with the graph converted; arguments, result and errors as for `export.Writer`."""
    if not has_openvino():
        raise BadInput(
            "format=car-openvino", f"needs the package openvino; install the project with its extra: {NEEDED}"
        )
    return export_car(run, path, add_converted)


def add_converted(archive: CarArchive) -> CarArchive:
    """Return an archive with `MODEL` and `WEIGHTS` in it, which the car would make of its graph."""
    import openvino

    with tempfile.TemporaryDirectory() as folder:
        graph, model, weights = (Path(folder, Path(name).name) for name in (GRAPH, MODEL, WEIGHTS))
        graph.write_bytes(archive.files[GRAPH])
        # The converter that its Python package offers does the same, but reports each conversion to its makers.
        converted = openvino.Core().read_model(graph)
        converted.reshape({each: [1, *list(each.partial_shape)[1:]] for each in converted.inputs})
        openvino.save_model(converted, model, compress_to_fp16=True)
        files = {MODEL: model.read_bytes(), WEIGHTS: weights.read_bytes()}
    note = (
        f"{MODEL} and {WEIGHTS}: a car with OpenVINO 2024 (Ubuntu 24.04) that has them beside model.pb converts "
        "nothing; an upload in its console leaves them behind"
    )
    return archive._replace(files={**archive.files, **files}, notes=[*archive.notes, note])


def run_in_openvino(archive: CarArchive, seen: Sequence[Tensor]) -> Floats:
    """Return the outputs of an archive's graph in OpenVINO, (n, outputs).

    Args:
        archive: of the policy.
        seen: the inputs of `DeployedPolicy`: pictures (n, channels, height, width), bytes, then readings of a LIDAR.
    """
    import openvino

    files = (archive if MODEL in archive.files else add_converted(archive)).files
    fed = {
        f"{INPUTS}/{sensor}/{sensor}:0": (
            values.permute(0, 2, 3, 1) if values.dtype == torch.uint8 else values
        ).numpy(force=True)
        for sensor, values in zip(archive.metadata.sensor, seen, strict=True)
    }
    core = openvino.Core()
    settings = {"INFERENCE_PRECISION_HINT": "f16", "INFERENCE_NUM_THREADS": 1}
    compiled = core.compile_model(core.read_model(files[MODEL], files[WEIGHTS]), "CPU", settings)
    rows = [
        compiled({name: values[[row]].astype(np.float32) for name, values in fed.items()})[f"{POLICY}:0"][0]
        for row in range(len(seen[0]))
    ]
    outputs: Floats = np.array(rows)
    return outputs


def compare_in_openvino(archive: CarArchive, policy: DeployedPolicy, seen: Sequence[Tensor]) -> Conversion:
    """Compare the decisions of an archive's graph in OpenVINO with its policy; arguments as for `run_in_openvino`."""
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
