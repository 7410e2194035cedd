"""Shared by the writers of all export formats: the policy that is exported, and the files that are written."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from deepracer_exp.errors import writing
from deepracer_exp.files import atomic_write, read_text
from deepracer_exp.runs.checkpoints import StoredPolicy
from deepracer_exp.runs.run_files import REWARD
from deepracer_exp.runs.stored_run import StoredRun

Written = tuple[Iterable[Path], list[str]]
"""Files or folders, and lines on them."""


def checkpoint_line(stored: StoredPolicy) -> str:
    """Return the line that names the exported checkpoint."""
    return f"checkpoint   {stored.counters['iteration']}"


def reward_text(run: StoredRun) -> str:
    """Return the text of the reward function that a run was trained with."""
    return read_text(run.path / REWARD, "the reward function that the run was trained with")


def write_file(path: Path, content: bytes) -> None:
    """Write a file atomically, and its folder where there is none.

    Raises:
        BadInput: it cannot be written.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, content)


def write_files(files: Mapping[str, str | bytes], folder: Path) -> None:
    """Write files into a folder, replacing those of the same names.

    Raises:
        BadInput: the folder cannot be created or written.
    """
    with writing(folder, "another folder with -o"):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
