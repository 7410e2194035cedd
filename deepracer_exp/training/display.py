"""The live view of a training in the terminal, and its plain lines where there is none."""

import itertools
import logging
import math
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

logger = logging.getLogger("deepracer_exp")

Row = Mapping[str, float | int | None]
"""One line of metrics.jsonl."""

SPARKS = "▁▂▃▄▅▆▇█"
REFRESH_S = 0.2
"""Shortest time between two drawings: more often only costs the training time."""
_MOVE_S = 5.0
"""Longest time between two drawings, so that the elapsed time advances during a long iteration."""
LINE_S = 5.0
"""Shortest time between two plain lines; from two minutes on it grows with the run, up to `_LINE_AT_MOST_S`."""
_LINE_AT_MOST_S = 60.0
_LINE_SHARE = 1 / 24
_SPACE = "  "  # between the figures of a plain line
_AT_MOST = "at most "
LINE_COLUMNS = 120
"""Columns that no plain line exceeds."""
_DISPENSABLE = ("entropy", "return", "completion")
"""Figures dropped from a plain line that would be too long, in this order."""
NOTHING = "\N{EN DASH}"

_HALVES = 60  # columns from which the figures stand in two halves side by side
_WIDE = 76  # columns from which the limit of the budget stands beside the bar
# Columns of a name, of one in the left half, of a value, between the halves, of the right half.
_LABEL, _LEFT_LABEL, _VALUE, _GAP, _RIGHT = 15, 12, 10, 2, 25
_FRAME_LINES = 10  # of the panel beside figures and table, and the terminal's last
# Columns between tracks, and of a track: 18 tracks in three columns of a terminal of 80.
_TABLE_GAP, _CELL = 2, 22
_PERCENT, _LAP = 4, 8  # columns of per cent and lap time in it

# What is shown of a row by its label: key, format and unit.
_FIGURES = {
    "completion": ("completion", ".1f", "%"),
    "return": ("mean_return", ",.2f", ""),
    "entropy": ("entropy", ".3f", ""),
    "learn rate": ("lr", ".2g", ""),
    "exploring laps": ("laps", ",.0f", ""),
    "their fastest": ("best_lap_time_s", ".2f", " s"),
    "their mean": ("mean_lap_time_s", ".2f", " s"),
    "usual lap": ("eval_lap_time_s", ".2f", " s"),
    "env steps": ("env_steps", ",.0f", ""),
    "speed": ("env_steps_per_s", ",.0f", " steps/s"),
    "iteration": ("iteration", ",.0f", ""),
    "episodes": ("episodes", ",.0f", ""),
}
_SHARE = "of last"
_CURVES: dict[str, tuple[str, tuple[float, float] | None]] = {
    "completion": ("green", (0.0, 100.0)),
    "return": ("cyan", None),
    "entropy": ("magenta", None),
}
"""Colour, and the values of the lowest and highest bar, of the figures that are drawn as curves."""
_COMPLETE = "complete"
_PAIRS = (
    *(("completion", "exploring laps"), ("return", _SHARE), ("entropy", "their fastest")),
    ("learn rate", "their mean"),
)
_PAIRS_OF_TRACKS = (("completion", "exploring laps"), ("return", _SHARE), ("entropy", "learn rate"))
_PAIRS_OF_STEPS = (("usual lap", _COMPLETE), ("env steps", "iteration"), ("speed", "episodes"))
_BY_IMPORTANCE = (
    *(
        "iteration",
        "usual lap",
        _COMPLETE,
        "completion",
        "exploring laps",
        _SHARE,
        "their fastest",
        "entropy",
    ),
    *("return", "their mean", "env steps", "speed", "episodes", "learn rate"),
)


@dataclass(frozen=True, kw_only=True)
class RunHeader:
    """Names of what is being trained."""

    name: str
    track: str
    track_labels: tuple[str, ...]
    """Labels of several tracks in the rows; empty with one track."""
    remembered: int
    """Number of the last finished episodes that `lap_share` counts."""
    reward: str
    network: str
    actions: str
    algorithm: str
    """Name of the algorithm, and what makes its gradient steps where there is a choice."""
    budget: str
    """The limits of the run, such as `3,000,000 steps`."""
    folder: str
    """Folder of the results."""

    def __str__(self) -> str:
        """Return the choices in one line."""
        return " · ".join((self.track, self.reward, self.network, self.actions, self.algorithm))


class ProgressDisplay:
    """Shows a training while it runs; use as a context manager.

    On a terminal one panel is redrawn in place and stays at the end. Elsewhere, lines go to `console`: the
    first row, then one every now and then (see `LINE_S`), and the last. Give a console on stderr: stdout is for
    results.
    """

    def __init__(
        self, console: Console, header: RunHeader, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console, self._header, self._clock = console, header, clock
        self._started_s, self._shown_s = 0.0, -math.inf
        self._pending = False
        self._row: Row = {}
        self._evaluated: Row = {}
        self._fraction = 0.0
        self._eta_s: float | None = None
        self._history: dict[str, list[float]] = {label: [] for label in _CURVES}
        self._tracks = TrackTable(header.track_labels)
        # A terminal with TERM=dumb cannot draw in place. The view is drawn by a thread, too: what it reads is replaced
        # or added to, and needs no lock, which a signal's answer could find taken.
        self._live = (
            Live(console=console, get_renderable=self._panel, refresh_per_second=1 / _MOVE_S)
            if console.is_interactive
            else None
        )

    def __enter__(self) -> Self:
        self._started_s = self._clock()
        if self._live is not None:
            self._live.start(refresh=True)
        else:
            for line in textwrap.wrap(
                f"{self._header} · {self._header.budget}", LINE_COLUMNS, break_on_hyphens=False
            ):
                self._print(line)
            self._print(f"results in {self._header.folder}")
        return self

    def __exit__(self, *_: object) -> None:
        if self._pending:
            self._show()
        if self._live is not None:
            self._live.stop()

    def update(self, row: Row, fraction: float, eta_s: float | None) -> None:
        """Show one iteration.

        Args:
            row: as in metrics.jsonl: completion is in per cent (0 to 100), lap_share a fraction; values that
                are None, NaN or missing show as a dash.
            fraction: share of the budget used, 0 to 1.
            eta_s: seconds left, or None if unknown.
        """
        now_s = self._clock()
        self._row, self._eta_s = row, eta_s
        self._fraction = min(max(fraction, 0.0), 1.0)
        for label, values in self._history.items():
            value = _value(row, _FIGURES[label][0])
            if value is not None:
                values.append(value)
        if row.get("eval_lap_share") is not None:
            self._evaluated = row  # stays until the next evaluation
        self._tracks.add(row)
        self._pending = True
        line_s = min(max(LINE_S, _LINE_SHARE * (now_s - self._started_s)), _LINE_AT_MOST_S)
        if now_s - self._shown_s >= (line_s if self._live is None else REFRESH_S):
            self._shown_s = now_s
            self._show()

    def _show(self) -> None:
        self._pending = False
        if self._live is not None:
            self._live.refresh()
        else:
            self._print(self._line())

    def _print(self, text: str) -> None:
        # Names and paths may hold square brackets, and a log line is not folded at 80 columns.
        self._console.print(text, soft_wrap=True)

    def _line(self) -> str:
        usual = f"lap {self._figure('usual lap')} ({self._figure(_COMPLETE)})"
        parts = {
            "iteration": f"iteration {self._figure('iteration')}",
            "steps": f"{self._figure('env steps')} steps",
            "speed": self._figure("speed").replace(" steps/s", "/s"),
            "completion": f"completion {self._figure('completion', '.0f')}",
            # The policy's laps are those of its evaluations; until the first, those of exploration show what it does.
            "laps": usual if self._evaluated else f"exploring laps {self._figure('exploring laps')}",
            "return": f"return {self._figure('return', ',.1f')}",
            "entropy": f"entropy {self._figure('entropy', '.2f')}",
            "left": _left(self._eta_s).removeprefix(_AT_MOST),
        }
        for label in _DISPENSABLE:
            if len(_SPACE.join(parts.values())) > LINE_COLUMNS:
                del parts[label]
        return _SPACE.join(parts.values())

    def _panel(self) -> Panel:
        # On a wider terminal the halves would be too far apart to be read together.
        width, height = min(self._console.width, 100), self._console.height
        inner = width - 6  # less the border and two columns of padding on each side
        if width < _HALVES:
            figures = self._column(inner)[: max(1, height - _FRAME_LINES + 1)]
        else:
            figures = self._halves(inner)
            if self._tracks:
                room = height - len(figures) - _FRAME_LINES
                figures += [Text(""), *self._tracks.lines(inner, room)]
        content: list[RenderableType] = [
            Text(str(self._header), style="dim", overflow="ellipsis", no_wrap=True),
            Text(""),
            self._bar(inner),
            Text(""),
            *figures,
        ]
        folder = self._header.folder
        return Panel(
            Group(*content),
            title=Text(self._header.name, style="bold"),
            title_align="left",
            # The end of a path distinguishes runs.
            subtitle=Text(folder if len(folder) <= inner - 2 else f"…{folder[3 - inner :]}", style="dim"),
            subtitle_align="left",
            border_style="bright_black",
            padding=(1, 2),
            width=width,
        )

    def _bar(self, width: int) -> Table:
        spent = Text.assemble((f"{100 * self._fraction:.0f}%", "bold"))
        left = _left(self._eta_s)
        if width >= _HALVES - 6:
            limit = self._header.budget if width >= _WIDE - 6 else "budget"
            spent.append(f" of {limit}", style="dim")
            left = f"{_clock(self._clock() - self._started_s)} · {left}"
        row = Table.grid(padding=(0, 2), expand=True)
        row.width = width
        row.add_column(ratio=1, min_width=4)
        row.add_column(justify="right", no_wrap=True)
        row.add_column(justify="right", no_wrap=True)
        bar = ProgressBar(total=1.0, completed=self._fraction, style="grey23", complete_style="cyan")
        bar.finished_style = "cyan"
        row.add_row(bar, spent, left)
        return row

    def _halves(self, width: int) -> list[Text]:
        pairs = _PAIRS_OF_TRACKS if self._tracks else _PAIRS  # lap times are in the table
        left = width - _GAP - _RIGHT
        both = [
            Text(" " * _GAP).join((self._cell(first, left, _LEFT_LABEL), self._cell(other, _RIGHT)))
            for first, other in (*pairs, *_PAIRS_OF_STEPS)
        ]
        return [*both[: len(pairs)], Text(""), *both[len(pairs) :]]

    def _column(self, width: int) -> list[Text]:
        hidden = ("their fastest", "their mean") if self._tracks else ()
        return [self._cell(label, width) for label in _BY_IMPORTANCE if label not in hidden]

    def _cell(self, label: str, width: int, room: int = _LABEL) -> Text:
        name = f"{label} {self._header.remembered}" if label == _SHARE else label
        cell = Text.assemble((name.ljust(room), "dim"), (self._figure(label).ljust(_VALUE), "bold"))
        if label in _CURVES:
            style, bounds = _CURVES[label]
            cell.append(sparkline(self._history[label], width - room - _VALUE, bounds), style=style)
        cell.truncate(width, overflow="ellipsis", pad=True)
        return cell

    def _figure(self, label: str, form: str | None = None) -> str:
        if label == _SHARE:
            share = _value(self._row, "lap_share")
            return NOTHING if share is None else f"{100 * share:.0f}%"
        if label == _COMPLETE:
            laps, tried = (self._evaluated.get(key) for key in ("eval_laps", "eval_laps_tried"))
            return NOTHING if tried is None else f"{laps} of {tried}"
        key, spec, unit = _FIGURES[label]
        value = _value(self._evaluated if key.startswith("eval_") else self._row, key)
        return NOTHING if value is None else format(value, form or spec) + unit


class TrackTable:
    """Completion and fastest exploring lap of each track."""

    def __init__(self, labels: Sequence[str]):
        """Start empty.

        `labels` are those of the rows of metrics.jsonl; empty for a run on one track.
        """
        self._labels = labels
        # An iteration need not end an episode on every track: what was known last stays.
        self._completion: dict[str, float] = {}
        self._best_s: dict[str, float] = {}

    def __bool__(self) -> bool:
        return bool(self._labels)

    def add(self, row: Row) -> None:
        """Add the figures of an iteration."""
        for metric, series in (("completion", self._completion), ("best_lap_time_s", self._best_s)):
            for label in self._labels:
                value = _value(row, f"{metric}/{label}")
                if value is not None:
                    series[label] = value

    def lines(self, width: int, room: int) -> list[Text]:
        """Return the table, tracks running down its columns.

        Tracks that do not fit into `room`, the free lines, are counted at the end.
        """
        columns = max(1, (width + _TABLE_GAP) // (_CELL + _TABLE_GAP))
        cell = (width + _TABLE_GAP) // columns - _TABLE_GAP
        places = columns * max(1, room - 1)  # less the head
        labels = self._labels if len(self._labels) <= places else self._labels[: places - 1]
        cells = [Text(self._track(label, cell)) for label in labels]
        if len(labels) < len(self._labels):
            cells.append(Text(f"and {len(self._labels) - len(labels)} more".ljust(cell), style="dim"))
        rows = -(-len(cells) // columns)
        used = -(-len(cells) // rows)
        cells += [Text(" " * cell)] * (rows * used - len(cells))
        head = Text(_columns("track", "%", "fastest", cell), style="dim")
        grid = [[head] * used, *(cells[row::rows] for row in range(rows))]
        return [Text(" " * _TABLE_GAP).join(row) for row in grid]

    def _track(self, label: str, cell: int) -> str:
        done, best_s = self._completion.get(label), self._best_s.get(label)
        done_text = NOTHING if done is None else f"{done:.0f}"
        return _columns(label, done_text, NOTHING if best_s is None else f"{best_s:.2f}", cell)


def _columns(name: str, done: str, best: str, cell: int) -> str:
    """Set a name to the left and figures to the right; a long name loses its middle, since both ends distinguish it."""
    room = cell - _PERCENT - _LAP
    if len(name) > room:
        name = f"{name[: room // 2]}…{name[len(name) - (room - 1) // 2 :]}"
    return f"{name:<{room}}{done:>{_PERCENT}}{best:>{_LAP}}"


def sparkline(values: list[float], width: int, bounds: tuple[float, float] | None = None) -> str:
    """Draw values as at most `width` bars, each the mean of its share of them.

    The values are finite, the oldest first. `bounds` are those of the lowest and the highest bar; without them, the
    bars' own.
    """
    count = min(width, len(values))
    edges = [place * len(values) // count for place in range(count + 1)] if count else []
    means = [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(edges)]
    if not means:
        return ""
    low, high = bounds or (min(means), max(means))
    span = (high - low) or 1.0
    top = len(SPARKS) - 1
    return "".join(SPARKS[min(max(round((mean - low) / span * top), 0), top)] for mean in means)


def _value(row: Row, key: str) -> float | None:
    value = row.get(key)
    return float(value) if value is not None and math.isfinite(value) else None


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _left(eta_s: float | None) -> str:
    if eta_s is None or not math.isfinite(eta_s):
        return f"{NOTHING} left"
    return f"{_AT_MOST}{_clock(max(eta_s, 0.0))} left"  # the last iteration may end past the budget


def printing(console: Console) -> Callable[[str], None]:
    """Return a function that prints a line as it is, above the progress view if there is one."""
    return lambda line: console.print(line, soft_wrap=True)


def print_lines(lines: Sequence[str], console: Console) -> None:
    """Print lines above the progress view, and log them."""
    for line in lines:
        logger.info(line)
        printing(console)(line)
