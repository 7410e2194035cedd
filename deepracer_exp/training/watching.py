"""What somebody who has many runs made tells and asks a single one."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from deepracer_exp.tracking import tracking_file


class TakenOver(Exception):  # noqa: N818 - reads as what it is at the raise site
    """Somebody else goes on with this run: nothing more may be written of it."""


class Watch(Protocol):
    """Looks on while a run is made."""

    @property
    def title(self) -> str:
        """What the run is called in MLflow, in front of the time."""

    @property
    def tags(self) -> Mapping[str, str]:
        """Tags of the run in MLflow, beside its own."""

    def begins(self, run_dir: Path) -> None:
        """Hear where the run lies, before it is recorded anywhere.

        Raises:
            TakenOver: it may not begin.
        """

    def sees(self, row: Mapping[str, Any]) -> str | None:
        """Return why the run is to end as hopeless after this row of metrics.jsonl, None to go on.

        Raises:
            TakenOver: the row may not be recorded.
        """


def copied(run_dir: Path, attempt: int) -> Path:
    """Copy a run whose process does not let go of its folder, to go on with the copy; return the copy's folder.

    What MLflow has stays the original's: the copy gets a run of its own there.

    Raises:
        OSError: it cannot be copied.
    """
    base = run_dir.name.partition("-attempt")[0]
    target = run_dir.with_name(f"{base}-attempt{attempt}")
    # Files and checkpoints are written under a name with a dot first.
    left_out = shutil.ignore_patterns("summary.json", ".*")
    aside = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.copytree(run_dir, aside, symlinks=True, ignore=left_out)
    if (aside / tracking_file.NAME).exists():
        tracking_file.begin_again(aside / tracking_file.NAME, target)
    aside.replace(target)
    return target
