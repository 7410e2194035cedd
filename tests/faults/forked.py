"""What is killed in the tests of `faults`: targets of processes forked from one that has imported what they need."""

import contextlib
import multiprocessing
import tempfile
import time
from pathlib import Path

from deepracer_exp.cli import main
from deepracer_exp.scratch import own_scratch


def run_command(cwd: Path, *arguments: str) -> None:
    """Run `deepracer-exp ARGUMENTS` in a folder; what it says is written to `said.txt` there."""
    with (
        contextlib.chdir(cwd),
        open("said.txt", "w", encoding="utf-8") as said,
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        main(arguments)


def hold(base: Path) -> None:
    """Keep temporary files in a folder of this process, and a semaphore, until it is killed; `base` has their names."""
    begin(base)
    lock = multiprocessing.get_context("spawn").Lock()
    semaphore = f"/dev/shm/sem.{lock._semlock.name.removeprefix('/')}"
    aside = base / ".held"
    aside.write_text(f"{tempfile.gettempdir()}\n{semaphore}\n", encoding="utf-8")
    aside.rename(base / "held")
    time.sleep(3600)


def begin(base: Path) -> None:
    """Do with temporary files what every command begins with."""
    tempfile.tempdir = str(base)
    own_scratch()
