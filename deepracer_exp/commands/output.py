"""Output of commands: consoles, warnings, and the result of a run."""

import functools
import logging
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepracer_exp.cache import compiled_folder
from deepracer_exp.errors import BadInput, count
from deepracer_exp.runs.run_files import (
    BEST_LAP,
    CHECKPOINTS,
    LEARNING,
    METRICS,
    REPORT,
    full_name,
    read_metrics,
)
from deepracer_exp.runs.run_result import FAILED, RELIABLE, fastest_reliable, why_not_fastest

if TYPE_CHECKING:
    from rich.console import Console

    from deepracer_exp.config.running import TrackingConfig
    from deepracer_exp.reports.tables.log_tables import Table
    from deepracer_exp.training.train_result import TrainResult

_FILES = {
    REPORT: "findings and figures",
    BEST_LAP: "the fastest exploring lap, or the longest attempt",
    LEARNING: "the learning curves",
}


_WRITTEN = {
    "": "a file in a folder",
    ".mp4": "an .mp4 in an existing folder",
    ".png": "a .png in an existing folder",
    ".html": "the name of a page (.html) in a folder",
}
"""What is accepted as a file to write, by the ending that it must have."""


def check_file(flag: str, file: str | None, ending: str = "") -> None:
    """Check where a file is to be written, if anywhere.

    Raises:
        BadInput: its name has not the ending, or its folder does not exist.
    """
    if file is None or (file.endswith(ending) and Path(file).absolute().parent.is_dir()):
        return
    raise BadInput(f"{flag} {file}", "" if ending else "its folder does not exist", _WRITTEN[ending])


def plain_console(**options: Any) -> "Console":
    """Return a console that prints texts as they are: brackets are no markup, `:car:` is no emoji.

    All consoles come from here. Past its console, Rich reads markup in the title of a panel, in a status and beside a
    progress bar: what stands there, names of studies and checkpoints, can have no brackets.
    """
    from .terminal import Terminal

    return Terminal(markup=False, emoji=False, highlight=False, **options)


def table_console(piped_width: int = 200) -> "Console":
    """Return a console for tables on standard output; a pipe has no width of its own."""
    return plain_console(width=None if sys.stdout.isatty() else piped_width)


def print_table(console: "Console", title: str | None, table: "Table") -> None:
    """Print a table of a page, with a title before and an empty line after it."""
    from rich.table import Table as RichTable

    drawn = RichTable(box=None, pad_edge=False, header_style="dim")
    for number, head in enumerate(table.heads):
        drawn.add_column(head, justify="left" if number < max(table.words, 1) else "right", overflow="fold")
    for row in table.rows:
        drawn.add_row(*row)
    if title is not None:
        console.print(title, style="bold")
    console.print(drawn)
    console.print()


@contextmanager
def warnings_on_stderr() -> Iterator[None]:
    """Write the project's warnings to standard error within the block, one line each."""
    warn_of_compiling()
    handler = logging.StreamHandler(sys.stderr)
    # Errors are the command's own to print, in one line; here they would come with a traceback.
    handler.addFilter(lambda record: record.levelno == logging.WARNING)
    handler.setFormatter(logging.Formatter("warning: %(message)s"))
    logger = logging.getLogger("deepracer_exp")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def print_notes(notes: Iterable[str]) -> None:
    """Print each note once, on standard error."""
    for note in dict.fromkeys(notes):
        print(note, file=sys.stderr)


def print_start() -> None:
    """Announce the wait before the first car drives, with its reason."""
    warn_of_compiling()
    what = "starting: loading PyTorch and MuJoCo"
    if is_compiled_first("tyres"):
        what += ", and compiling the physics, once after an installation (about 20 s)"
    print(what, file=sys.stderr, flush=True)


def is_compiled_first(module: str) -> bool:
    """Return whether the functions of a module, by its file's name, are compiled once and have not been yet."""
    folder = compiled_folder()
    # Where numba keeps what it has compiled; numba itself is not imported yet.
    return folder is not None and not any(folder.glob(f"*/{module}.*.nbi"))


@functools.cache
def warn_of_compiling() -> None:
    """Warn once if compiled code cannot be cached."""
    if compiled_folder() is None:
        why = "NUMBA_CACHE_DIR, XDG_CACHE_HOME or HOME names no folder that can be written"
        print(f"warning: each command compiles the physics again, for about 20 s: {why}", file=sys.stderr)


def print_result(outcome: "TrainResult", tracking: "TrackingConfig") -> None:
    """Print a run's ending, the place of its results, and next steps."""
    from deepracer_exp.config.running import MLflowTracking
    from deepracer_exp.runs.next_steps import COMMAND, next_steps, open_report
    from deepracer_exp.runs.run_result import result_of

    summary = outcome.summary
    if outcome.status == FAILED:
        print(f"deepracer-exp: run failed: {outcome.reason}", file=sys.stderr)
        print(f"  details: {outcome.folder}", file=sys.stderr)
        _print_unrecorded([outcome], tracking)
        return
    print(f"\n{outcome.ending}")
    print(
        f"  {count(summary['iteration'], 'iteration')}, {count(summary['env_steps'], 'step')} in "
        f"{summary['wall_clock_s']:.0f} s; exploring: {count(summary['episodes'], 'episode')}, {_laps(summary)}"
    )
    result = result_of(summary)
    if result is not None and result.evaluated:
        several = ", mean of the laps on all tracks" * ("tracks" in summary)
        print(f"\n  best by {result.criterion}: checkpoint {result.iteration}")
        print(f"    {result.words()}")
        print(f"  fastest reliable lap: {_reliable_lap(outcome.folder)}{several}")
        if (why := why_not_fastest(result, read_metrics(outcome.folder / METRICS))) is not None:
            print(f"    {why}")
    print(f"\n  results       {outcome.folder}")
    for name, what in _FILES.items():
        if (outcome.folder / name).exists():
            print(f"    {name:12}  {what}")
    if outcome.note is not None:
        print(f"warning: {outcome.note}", file=sys.stderr)
    if isinstance(tracking, MLflowTracking) and outcome.unrecorded is None:
        print(f"  compare runs  {_command()} ui{store_word(outcome.folder.parent.parent, tracking.uri)}")
    steps = next_steps(outcome.folder, summary)
    if (outcome.folder / REPORT).exists():
        steps.insert(1, open_report(outcome.folder))
    print_steps([(line.replace(COMMAND, _command(), 1), what) for line, what in steps])
    _print_unrecorded([outcome], tracking)


def _reliable_lap(run: Path) -> str:
    """Return the fastest reliable lap of a run's evaluated policies in words, and whether its checkpoint is there."""
    rows = read_metrics(run / METRICS)
    lap = fastest_reliable(rows)
    if lap is None:
        share = max((row.get("eval_lap_share") or 0.0 for row in rows), default=0.0)
        return f"none yet; {RELIABLE:.0%} of the usual laps must be complete, at best {share:.0%} were"
    kept = (run / CHECKPOINTS / f"{lap.iteration:06d}").is_dir()
    return f"{lap}" if kept else f"{lap} (not kept)"


def print_steps(steps: Sequence[tuple[str, str]]) -> None:
    """Print commands with their purposes: beside them, or above them on a narrow terminal."""
    if not steps:
        return
    print("\n  next")
    width = max(len(line) for line, _ in steps)
    beside = all(
        4 + width + 4 + len(what) <= shutil.get_terminal_size((200, 24)).columns for _, what in steps
    )
    for line, what in steps:
        print(f"    {line:{width}}  # {what}" if beside else f"    # {what}\n    {line}")


def print_results(outcomes: "Sequence[TrainResult]", tracking: "TrackingConfig") -> None:
    """Print one line per run, and the scores of groups of runs that differ only in seed and track."""
    print(f"\n{count(len(outcomes), 'run')}:")
    for outcome in outcomes:
        print(f"  {full_name(outcome.folder)}  {outcome.status}  {_lap(outcome)}  {outcome.reason}")
    _print_groups([outcome.folder for outcome in outcomes if outcome.status != FAILED])
    _print_unrecorded(outcomes, tracking)


def _print_groups(runs: "Sequence[Path]") -> None:
    """Print the tables of groups, where one of them has several runs."""
    from deepracer_exp.reports.tables.group_tables import differences_table, scored, sentences, title_of
    from deepracer_exp.reports.tables.groups import compared, group_runs
    from deepracer_exp.runs.next_steps import own_word
    from deepracer_exp.runs.run_files import read_head

    groups = group_runs((None, read_head(run)) for run in runs) if len(runs) > 1 else []
    if len(groups) in (0, len(runs)):
        return
    console, differences = table_console(), compared(groups)
    console.print()
    print_table(console, "Groups", scored(groups))
    if differences:
        print_table(console, title_of(differences), differences_table(differences))
    for sentence in sentences(groups, differences):
        console.print(sentence, soft_wrap=True)
    words = shlex.join(own_word(run) for run in runs)
    print_steps([(f"{_command()} compare {words}", "learning curves over seeds")])


def _print_unrecorded(outcomes: "Sequence[TrainResult]", tracking: "TrackingConfig") -> None:
    """Report last, on standard error, the missing records and the command that sends them."""
    from deepracer_exp.config.running import MLflowTracking
    from deepracer_exp.runs.next_steps import own_word

    lacking = [outcome for outcome in outcomes if outcome.unrecorded is not None]
    for reason in dict.fromkeys(outcome.unrecorded for outcome in lacking):
        print(f"\nwarning: {reason}", file=sys.stderr)
    if lacking and isinstance(tracking, MLflowTracking):
        words = shlex.join(own_word(outcome.folder) for outcome in lacking)
        store = store_word(lacking[0].folder.parent.parent, tracking.uri)
        print(
            f"  the run folder has everything; send it later: {_command()} runs send {words}{store}",
            file=sys.stderr,
        )


def print_unsent(study: "Path") -> None:
    """Report on standard error how many runs of a study are incomplete in MLflow, and the command that sends them."""
    from deepracer_exp.runs.run_files import CONFIG
    from deepracer_exp.tracking.delivery import undelivered
    from deepracer_exp.tracking.store import resolve_store

    runs_dir = study.parent
    stores = list(undelivered(sorted(file.parent for file in study.glob(f"*/{CONFIG}"))).values())
    usual = resolve_store(None, runs_dir).shown
    for store in dict.fromkeys(stores):
        words = [f"runs_dir={runs_dir}"] * (str(runs_dir) != "runs") + [f"tracking.uri={store}"] * (
            store != usual
        )
        command = shlex.join([_command(), "runs", "send", *words])
        print(
            f"\nwarning: MLflow ({store}): something of {count(stores.count(store), 'run')} was not recorded\n"
            f"  the run folders have everything; send it later: {command}",
            file=sys.stderr,
        )


def store_word(runs_dir: "Path", uri: str | None) -> str:
    """Return the override for the place where runs are recorded; empty for the default."""
    store = f"runs_dir={runs_dir}" if uri is None else f"tracking.uri={uri}"
    return "" if store == "runs_dir=runs" else f" {shlex.quote(store)}"


def _command() -> str:
    # `make race` calls us by a path that a newcomer's shell does not know.
    return "deepracer-exp" if shutil.which("deepracer-exp") else shlex.quote(sys.argv[0])


def _lap(outcome: "TrainResult") -> str:
    """Return the fastest reliable lap of a run's evaluated policies, or else a summary of the exploring laps."""
    # A run that failed in its first iteration has no metrics.
    file = outcome.folder / METRICS
    lap = fastest_reliable(read_metrics(file)) if file.is_file() else None
    return f"exploring: {_laps(outcome.summary)}" if lap is None else f"fastest reliable lap: {lap}"


def _laps(summary: Mapping[str, Any]) -> str:
    tracks = summary.get("tracks")
    if tracks is not None:
        return f"laps on {sum(track['laps'] > 0 for track in tracks.values())} of {len(tracks)} tracks"
    best, laps = summary["best_lap_time_s"], count(summary["laps"], "lap") if summary["laps"] else "no lap"
    return laps if best is None else f"{laps}, the fastest in {best:.2f} s"
