"""Arguments and pages shared by `analyze`, `compare` and `watch`."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from deepracer_exp.errors import BadInput, reading, writing
from deepracer_exp.files import LOG_BYTES, open_user_file
from deepracer_exp.runs.run_files import is_run

from .arguments import Stores

if TYPE_CHECKING:
    from deepracer_exp.reports.charts.figure import Chart
    from deepracer_exp.reports.pages.lap_replay import ReplayedLap
    from deepracer_exp.reports.tables.log_tables import Table
    from deepracer_exp.reports.tables.log_view import LogView
    from deepracer_exp.runs.stored_run import StoredRun

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
    from deepracer_exp.reports.pages.lap_replay import write_replay

    with writing(f"--replay {page}"):
        write_replay(Path(page), laps)


def page_name(kind: str, name: str) -> Path:
    """Return the name of a page in the current folder: `NAME-KIND.html`."""
    safe = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name).strip("-.")
    return Path(f"{safe[:80] or 'log'}-{kind}.html")


def end_with_page(page: Path, is_opened: bool) -> None:
    """Print the page's place, and open it."""
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
    return existing_logs(what) or find_run(what, stores).path


def find_run(what: str, stores: Stores) -> "StoredRun":
    """Return the run that a word names, which is no file or folder.

    Raises:
        BadInput: there is none, or its name is ambiguous.
    """
    try:
        return stores.find(what)
    except BadInput as error:
        raise BadInput(what, f"no such file or folder, and no run: {error.without(what)}") from None


@dataclass(frozen=True)
class Item:
    """A resolved word of the command line."""

    word: str
    group: str | None
    """Name of its group."""
    paths: tuple[Path, ...]
    """Folders of runs, or one file or folder of logs."""
    is_experiment: bool = False

    @property
    def is_logs(self) -> bool:
        """Whether it is a log of the service."""
        return not is_run(self.paths[0])


def write_comparison_page(
    output: str | None,
    items: Sequence[Item],
    sentences: Sequence[str],
    tables: "Sequence[tuple[str, Table, str]]",
    charts: "Sequence[Chart | None]",
) -> Path:
    """Write the page of a comparison, by default named after the compared runs and logs; return where it is.

    Raises:
        BadInput: it cannot be written.
    """
    from deepracer_exp.reports.pages.comparison_page import write_comparison

    words = list(dict.fromkeys(item.group or Path(item.word).name for item in items))
    out = Path(output or page_name("comparison", "-".join(words[:3])))
    title = f"{', '.join(words[:4])}{' and more' * (len(words) > 4)} compared"
    with writing(f"--output {out}", "a file in a folder"):
        write_comparison(out, title, sentences, tables, [chart for chart in charts if chart is not None])
    return out


def light(view: "LogView") -> "LogView":
    """Return a view without the steps of its training: a comparison shows iterations and races only."""
    steps = view.recording.steps
    recording = replace(view.recording, steps=steps[steps["stream"] != "training"].copy())
    return replace(view, steps=view.steps.iloc[:0].copy(), recording=recording)
