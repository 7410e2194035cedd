"""What `analyze` and `compare` share: the runs and logs they take, and the pages they write."""

import argparse
from pathlib import Path

from deepracer_exp.errors import BadInput, reading
from deepracer_exp.files import LOG_BYTES, open_user_file

from .arguments import Stores

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


def check_output(output: str | None) -> None:
    """Check where the page is to be written.

    Raises:
        BadInput: its folder does not exist.
    """
    if output is not None and not Path(output).absolute().parent.is_dir():
        raise BadInput(f"--output {output}", "its folder does not exist", "a file in a folder")


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
    from deepracer_exp.lookup.resolve import resolve

    try:
        return resolve(what, stores.runs_dir, stores.uri).path
    except BadInput as error:
        raise BadInput(what, f"no such file or folder, and no run: {error.without(what)}") from None
