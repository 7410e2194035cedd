"""lineage.json, which a clone's run folder has: what it was cloned from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter

from .typed_file import read_typed

LINEAGE = "lineage.json"


@dataclass(frozen=True, kw_only=True)
class Lineage:
    """Where a clone comes from."""

    parent: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    """Name of the parent's folder."""
    parent_dir: str
    """That folder as it was then, absolute."""
    parent_run_id: str | None
    """MLflow's id of the parent."""
    checkpoint: Annotated[str, Field(pattern=r"^\d{6,9}$")]
    """The parent's checkpoint."""
    sha256: str
    """Hash of the checkpoint."""
    generation: Annotated[int, Field(ge=1)]
    """1: cloned from a run that is no clone."""
    registered: str | None
    """MODEL@ALIAS, if the parent was given so."""


_ADAPTER = TypeAdapter(Lineage)


def read_lineage(run: Path) -> Lineage | None:
    """Return what a run was cloned from, None if it was not cloned.

    Raises:
        BadInput: the file cannot be read or holds something else.
    """
    return read_typed(run / LINEAGE, _ADAPTER, "a clone")
