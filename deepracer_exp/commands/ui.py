"""`deepracer-exp ui`: MLflow's pages of the recorded runs."""

import argparse
from collections.abc import Callable

from .arguments import add_overrides, read_stores


def add_ui(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    parser = commands.add_parser(
        "ui",
        help="open the MLflow pages of the recorded runs",
        description="Serve the MLflow pages of the project's runs on 127.0.0.1 until Ctrl-C.",
    )
    add_overrides(parser, "runs_dir=DIR | tracking.uri=URI")
    parser.add_argument("--port", type=int, default=5000)
    parser.set_defaults(command=_ui)


def _ui(args: argparse.Namespace) -> int:
    stores = read_stores(args.overrides)

    from deepracer_exp.tracking.ui import serve_ui

    announce: Callable[[str], None] = lambda line: print(line, flush=True)  # noqa: E731 - print has no such type
    serve_ui(stores.runs_dir, stores.uri, args.port, announce)
    return 0
