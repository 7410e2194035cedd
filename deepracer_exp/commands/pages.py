"""What `analyze`, `compare` and `watch` share: the runs and logs they take, and the pages they write."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, reading, writing
from deepracer_exp.files import LOG_BYTES, open_user_file

from .arguments import Stores

if TYPE_CHECKING:
    from deepracer_exp.reports.lap_replay import ReplayedLap

_ACCEPTED = "logs of the service, or a run"


def add_page(parser: argparse.ArgumentParser, default: str) -> None:
    """Give a command the flags of its page; `default` says in the help where it is written."""
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument(
        "--track",
        metavar="NAME | ROUTE",
        help="one of several tracks; or, of a track that the log does not name, its name or file (.npy, .yaml)",
    )
    parser.add_argument("-o", "--output", metavar="FILE", help=f"page to write (default: {default})")


def add_replay(parser: argparse.ArgumentParser, which: str) -> None:
    """Give a command the flag; `which` says in its help which laps are replayed."""
    parser.add_argument(
        "--replay", metavar="PAGE.html", help=f"write a page on which two laps drive side by side: {which}"
    )


def write_laps(page: str, laps: "Sequence[ReplayedLap]") -> None:
    """Write the page of two laps.

    Raises:
        BadInput: they are not on the same track, or it cannot be written.
    """
    from deepracer_exp.reports.lap_replay import write_replay

    with writing(f"--replay {page}"):
        write_replay(Path(page), laps)


def page_name(kind: str, name: str) -> Path:
    """Return the name of a page in the current folder: `NAME-KIND.html`."""
    safe = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name).strip("-.")
    return Path(f"{safe[:80] or 'log'}-{kind}.html")


def end_with_page(page: Path, is_opened: bool) -> None:
    """Print where the page is, and open it."""
    print(f"\n  page  {page}")
    if is_opened:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


def existing_logs(what: str) -> Path | None:
    """Return an existing file or folder, None if there is none.

    Raises:
        BadInput: it is "", or cannot be read.
    """
    if not what.strip():
        raise BadInput(f"{what!r}", "names nothing", _ACCEPTED)
    with reading(what, _ACCEPTED):
        path = Path(what).expanduser()
        if not path.exists():
            return None
        if not path.is_dir():
            open_user_file(path, _ACCEPTED, LOG_BYTES).close()
        return path


def run_or_logs(what: str, stores: Stores) -> Path:
    """Return the file or folder of logs, or the folder of a run.

    Raises:
        BadInput: there is none, or the name of a run is ambiguous.
    """
    path = existing_logs(what)
    if path is not None:
        return path

    try:
        return stores.find(what).path
    except BadInput as error:
        raise BadInput(what, f"no such file or folder, and no run: {error.without(what)}") from None
