"""The entry point that takes a trained policy out of the house."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from .evaluation import checkpoint_name


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """What `deepracer-exp export` is asked for."""

    run: Annotated[str, Field(min_length=1)]
    """Folder, its name under `runs_dir` or the beginning of it, MLflow's id, `best:EXPERIMENT`, or the alias of a
    registered model."""
    format: Literal["onnx", "aws", "aws-logs"]
    """The network as a file, what another training begins with on AWS, or the run's logs as AWS writes them."""
    layout: Literal["console", "deepracer-for-cloud"]
    """Whose folders `aws-logs` are written in."""
    checkpoint: Annotated[str, AfterValidator(checkpoint_name)] | None
    """`best`, `last` or an iteration; null: what the alias names that the run is given by, else `best`. Of the network
    alone."""
    runs_dir: Annotated[str, Field(min_length=1)]
    tracking_uri: str | None
    """MLflow store in which ids and aliases are looked up; null: the one in `runs_dir`."""
    debug: bool
