"""`deepracer-exp runs list`: the runs of a folder or an MLflow server, filtered and sorted, as a table, JSON or CSV."""

import argparse
import contextlib
import csv
import datetime
import json
import math
import operator
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.errors import BadInput, nearest

from .arguments import STORES_METAVAR, add_command, add_overrides, read_stores
from .output import table_console

if TYPE_CHECKING:
    from deepracer_exp.runs.listing import Row

LIST = "list"
_NONE = "\N{EN DASH}"
_EPILOG = """\
  deepracer-exp runs                                        the runs of runs/, newest first; a study is one line
  deepracer-exp runs list --trials                          also the runs of studies, a line each
  deepracer-exp runs tracking.uri=http://HOST:5000          those that a server has, of everyone
  deepracer-exp runs list --where state=finished --where 'score_s<12' --sort score_s
  deepracer-exp runs list --where user=anna --where tag.car=blue --format csv > season.csv

What --where and --sort accept:
  columns: run name state lap_s score_s exploring_laps exploring_lap_s began user host study trial note id tag.KEY
  conditions: COLUMN=VALUE  COLUMN!=VALUE  COLUMN<NUMBER  <=  >  >=  COLUMN~TEXT (contains it)

With --where, --sort and the other formats each run of a study has its line, too.
"""
_CONDITION = re.compile(r"([a-z_]+|tag\.[\w.-]+)\s*(!=|<=|>=|=|<|>|~)\s*(.*)", re.DOTALL)
_ORDERS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


def add_list(actions: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command."""
    listing = add_command(
        actions,
        LIST,
        _list,
        entry=None,
        help="list runs, newest first (the default)",
        description="List the runs of a folder or, with tracking.uri=URI, of an MLflow store, newest first.",
        epilog=_EPILOG,
    )
    add_overrides(listing, STORES_METAVAR)
    listing.add_argument(
        "--where",
        action="append",
        default=[],
        metavar="CONDITION",
        help="only runs that meet the condition; of several conditions, all",
    )
    listing.add_argument(
        "--trials", action="store_true", help="a line for each run of a study, not one for all of them"
    )
    listing.add_argument("--sort", metavar="COLUMN", help="sort by this column, the smallest value first")
    listing.add_argument("--reverse", action="store_true", help="reverse the order")
    listing.add_argument(
        "--format", choices=("table", "json", "csv"), default="table", help="format of the output"
    )


def _list(args: argparse.Namespace) -> int:
    from deepracer_exp.runs.listing import rows_of_folder

    stores = read_stores(args.overrides)
    if stores.uri is not None:
        from deepracer_exp.tracking.store_listing import rows_of_store

        rows = rows_of_store(stores.uri, stores.runs_dir)
    elif not stores.runs_dir.is_dir():
        raise BadInput(f"runs_dir={stores.runs_dir}: is not a folder; `deepracer-exp train` creates it")
    else:
        rows = rows_of_folder(stores.runs_dir)
    columns = _columns(rows)
    for condition in args.where:
        holds = _condition(condition, columns)
        rows = [row for row in rows if holds(row)]
    if args.sort is not None:
        _check_column(f"--sort {args.sort}", args.sort, columns)
        valued = [row for row in rows if row.get(args.sort) is not None]
        valued.sort(key=lambda row: row[args.sort], reverse=args.reverse)
        rows = [*valued, *(row for row in rows if row.get(args.sort) is None)]
    elif args.reverse:
        rows.reverse()
    if args.format == "json":
        print(json.dumps([{key: _json(row.get(key)) for key in columns} for row in rows], indent=1))
    elif args.format == "csv":
        writer = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    elif rows:
        _print_table(rows if args.trials or args.where or args.sort else _folded(rows, stores.runs_dir))
    else:
        where = stores.runs_dir if stores.uri is None else stores.uri
        print(f"no runs in {where}" + " that meet the conditions" * bool(args.where))
    return 0


def _folded(rows: "Sequence[Row]", runs_dir: Path) -> "Sequence[Row]":
    """Return rows in which a study has one, with the figures of the run that `best:STUDY` means."""
    from deepracer_exp.runs.listing import fold_studies

    studies = {row["study"] for row in rows if row["study"] is not None}
    if not studies:
        return rows

    from deepracer_exp.runs.best_run import read_best_of_sweep

    best_runs = {}
    for study in studies:
        with contextlib.suppress(BadInput):  # a damaged file hides no run
            if (best := read_best_of_sweep(runs_dir / study)) is not None:
                best_runs[study] = best.run_dir
    return fold_studies(rows, best_runs)


def _columns(rows: "Sequence[Row]") -> list[str]:
    from deepracer_exp.runs.listing import COLUMNS

    return [*COLUMNS, *sorted({key for row in rows for key in row} - set(COLUMNS))]


def _check_column(what: str, column: str, columns: Sequence[str]) -> None:
    from deepracer_exp.runs.labels import USER_TAG

    if column not in columns and not column.startswith(USER_TAG):
        raise BadInput(f"{what}: no such column{nearest(column, columns)}; accepted: {', '.join(columns)}")


def _condition(text: str, columns: Sequence[str]) -> "Callable[[Row], bool]":
    match = _CONDITION.fullmatch(text)
    if match is None:
        raise BadInput(f"--where {text}: accepted: COLUMN=VALUE, also with !=, <, <=, >, >= and ~ (contains)")
    column, sign, wanted = match.groups()
    _check_column(f"--where {text}", column, columns)
    if sign in _ORDERS and column != "began":
        try:
            limit = float(wanted)
        except ValueError:
            raise BadInput(f"--where {text}: {wanted!r} is no number") from None
        return lambda row: _is_number(row.get(column)) and _ORDERS[sign](float(row[column]), limit)
    if sign in _ORDERS:  # ISO times sort as texts
        return lambda row: _ORDERS[sign](row[column], wanted)  # type: ignore[arg-type]
    if sign == "~":
        return lambda row: wanted.casefold() in str(row.get(column) or "").casefold()
    return lambda row: _equals(row.get(column), wanted) == (sign == "=")


def _equals(value: Any, wanted: str) -> bool:
    try:
        return float(value) == float(wanted)
    except (TypeError, ValueError):
        return str("" if value is None else value) == wanted


def _is_number(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def _json(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _print_table(rows: "Sequence[Row]") -> None:
    from rich.table import Table

    from deepracer_exp.runs.labels import USER_TAG
    from deepracer_exp.runs.run_result import TRAINING_LAPS

    console = table_console()
    table = Table("run", "state", box=None, pad_edge=False, header_style="dim")
    table.columns[0].overflow = "fold"
    for name in ("lap (s)", "race score (s)", "exploring laps", "fastest of them (s)", "age"):
        # With heads of two lines the names of runs fit a terminal of 120 columns.
        table.add_column(name.replace(" ", "\n", 1) if console.is_terminal else name, justify="right")
    several = len({row["user"] for row in rows}) > 1
    labelled = [key for key in _columns(rows) if key in ("name", "note") or key.startswith(USER_TAG)]
    shown = [*["user"] * several, *(key for key in labelled if any(row.get(key) for row in rows))]
    for name in shown:
        table.add_column(name.removeprefix(USER_TAG), overflow="fold")
    now = datetime.datetime.now(datetime.UTC)
    for row in rows:
        began = datetime.datetime.fromisoformat(row["began"])
        table.add_row(
            row["run"],
            row["state"],
            _number(row["lap_s"], ".2f"),
            _number(row["score_s"], ".2f"),
            _number(row["exploring_laps"], ",.0f"),
            _number(row["exploring_lap_s"], ".2f"),
            _age((now - began).total_seconds()),
            *(str(row.get(key) or "") for key in shown),
        )
    console.print(table)
    if any(row["lap_s"] is not None for row in rows):
        console.print(
            f"lap, race score: of the best checkpoint in {TRAINING_LAPS}; lap: usual, race score: usual and held-out",
            style="dim",
            soft_wrap=not console.is_terminal,
        )


def _number(value: Any, form: str) -> str:
    return format(float(value), form) if _is_number(value) else _NONE


def _age(seconds: float) -> str:
    """Return an age in its largest unit: ``40 s``, ``12 min``, ``5 h``, ``3 d``."""
    for unit, length_s in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= length_s:
            return f"{seconds // length_s:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
