"""`--replay PAGE.html` of `analyze`, `compare` and `watch`: two laps that drive beside each other."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, writing

if TYPE_CHECKING:
    from deepracer_exp.reports.lap_replay import ReplayedLap


def add_replay(parser: argparse.ArgumentParser, which: str) -> None:
    """Give a command the flag; `which` says in its help which laps are replayed."""
    parser.add_argument(
        "--replay", metavar="PAGE.html", help=f"write a page on which two laps drive side by side: {which}"
    )


def check_replay(page: str | None) -> None:
    """Check where the page is to be written.

    Raises:
        BadInput: it is no .html, or its folder does not exist.
    """
    if page is not None and (Path(page).suffix != ".html" or not Path(page).absolute().parent.is_dir()):
        raise BadInput(f"--replay {page}: accepted: the name of a page (.html) in a folder")


def write_laps(page: str, laps: "Sequence[ReplayedLap]") -> None:
    """Write the page of two laps.

    Raises:
        BadInput: they are not on the same track, or it cannot be written.
    """
    from deepracer_exp.reports.lap_replay import write_replay

    with writing(f"--replay {page}"):
        write_replay(Path(page), laps)
