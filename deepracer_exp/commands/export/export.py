"""The command `export`: a policy as ONNX, for a car or as a model of the service; a run's files for AWS."""

from collections.abc import Callable, Mapping
from pathlib import Path

from rich.console import Console

from deepracer_exp.runs.run_files import EXPORTS
from deepracer_exp.runs.stored_run import StoredRun

from .aws_files import export_files
from .aws_model import export_model
from .car_converter import export_car_openvino
from .car_export import export_car, name_in_exports
from .onnx import export_onnx
from .written import Written

Writer = Callable[[StoredRun, Path], Written]
"""Writes a run to a file or a folder.

Raises BadInput where the checkpoint or the output cannot be used, or a package is missing; RunFailed where the written
file differs from the network.
"""
WRITERS: Mapping[str, tuple[Writer, Callable[[StoredRun], str]]] = {
    "onnx": (export_onnx, lambda run: "policy.onnx"),
    "car": (export_car, name_in_exports),
    "car-openvino": (export_car_openvino, name_in_exports),
    "aws": (export_files, lambda run: "aws"),
    "aws-model": (export_model, lambda run: "aws-model"),
}
"""The writer of each format, and its default file in the run's folder of exports."""


def export(run: StoredRun, format: str, output: str | None, out: Console) -> Path:
    """Export a run in a format and print the result; errors as for `Writer`."""
    write, name = WRITERS[format]
    path = Path(output or run.path / EXPORTS / name(run))
    files, lines = write(run, path)
    for line in (*map(str, files), *(f"  {line}" for line in lines)):
        out.print(line, soft_wrap=True)
    return path
