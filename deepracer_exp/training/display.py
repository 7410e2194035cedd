"""The live view of a training in the terminal, and its plain lines where there is none."""

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.runs.folder import RunFolder
from deepracer_exp.tracking.metadata import joined
from deepracer_exp.tracking.metrics import track_metric

from .budget import Budget
from .metrics import RunMetrics

Row = Mapping[str, float | int | None]
"""One line of metrics.jsonl."""

SPARKS = "▁▂▃▄▅▆▇█"
REFRESH_S = 0.2
"""Shortest time between two drawings: more often only costs the training time."""
LINE_S = 5.0
"""Shortest time between two plain lines; from two minutes on it grows with the run, up to `_LINE_AT_MOST_S`."""
_LINE_AT_MOST_S = 60.0
_LINE_SHARE = 1 / 24
HALVES = 60
"""Columns from which the figures stand in two halves side by side."""
WIDE = 76
"""Columns from which the limit of the budget stands beside the bar."""
LABEL, VALUE, GAP, RIGHT = 12, 10, 3, 24
"""Columns of a figure's name, of its value, between the halves, and of the right half."""
NOTHING = "\N{EN DASH}"
_TABLE_GAP = 2
_CELL = 22  # columns of a track's figures, at least: 18 tracks in three columns of a terminal of 80
_FIGURES = (4, 7)  # columns of per cent and lap time in it
_FRAME_LINES = 10  # of the panel beside figures and table, and the terminal's last


@dataclass(frozen=True, kw_only=True)
class RunHeader:
    """What is being trained, by the names of its options."""

    name: str
    track: str
    track_labels: tuple[str, ...]
    """What each of several tracks is called in the rows; empty with one track."""
    remembered: int
    """How many of the last finished episodes `lap_share` looks at."""
    reward: str
    network: str
    actions: str
    budget: str
    """The limits of the run, such as `3,000,000 steps`."""
    folder: str
    """Where the results go."""

    @classmethod
    def of(
        cls,
        folder: RunFolder,
        setup: RaceSetup,
        names: Mapping[str, str],
        metrics: RunMetrics,
        budget: Budget,
    ) -> "RunHeader":
        """Return the header of a run; `names` are what a racer calls its choices."""
        return cls(
            name=folder.name,
            track=joined([course.tracks[0].title for course in setup.courses], " + "),
            track_labels=tuple(metrics.labels),
            remembered=metrics.remembered,
            reward=names["reward"],
            network=names["network"],
            actions=names["action_space"],
            budget=str(budget),
            folder=str(folder.path),
        )


class ProgressDisplay:
    """Shows a training while it runs; use as a context manager.

    On a terminal one panel is redrawn in place and stays at the end. Elsewhere, lines go to `console`: the
    first row, then one every now and then (see `LINE_S`), and the last. Give a console on stderr: stdout is for
    results.
    """

    def __init__(
        self, console: Console, header: RunHeader, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console = console
        self._clock = clock
        self._view = _View(header)
        # A terminal that is called dumb cannot draw in place.
        self._live = Live(console=console, auto_refresh=False) if console.is_interactive else None
        self._started_s = 0.0
        self._shown_s = -math.inf
        self._pending = False

    def __enter__(self) -> Self:
        self._started_s = self._clock()
        if self._live is not None:
            self._live.start()
            self._live.update(self._view, refresh=True)
        else:
            header = self._view.header
            self._line(f"{header.name}: {_join(header)} · {header.budget}")
            self._line(f"results in {header.folder}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
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
        elapsed_s = now_s - self._started_s
        self._view.add(row, fraction, eta_s, elapsed_s)
        self._pending = True
        line_s = min(max(LINE_S, _LINE_SHARE * elapsed_s), _LINE_AT_MOST_S)
        if now_s - self._shown_s >= (line_s if self._live is None else REFRESH_S):
            self._shown_s = now_s
            self._show()

    def message(self, text: str) -> None:
        """Print a line above the view."""
        self._line(text)

    def _show(self) -> None:
        self._pending = False
        if self._live is not None:
            self._live.update(self._view, refresh=True)
        else:
            self._line(self._view.line())

    def _line(self, text: str) -> None:
        # Names and paths may hold square brackets, and a log line is not folded at 80 columns.
        self._console.print(text, markup=False, highlight=False, emoji=False, soft_wrap=True)


class _View:
    """The panel: state on one side, rich's protocol to draw it at any width on the other."""

    def __init__(self, header: RunHeader) -> None:
        self.header = header
        self._row: Row = {}
        self._fraction = 0.0
        self._eta_s: float | None = None
        self._elapsed_s = 0.0
        self._history: dict[str, list[float]] = {"completion": [], "mean_return": [], "entropy": []}
        self._tracks = TrackTable(header.track_labels)

    def add(self, row: Row, fraction: float, eta_s: float | None, elapsed_s: float) -> None:
        self._row, self._eta_s, self._elapsed_s = row, eta_s, elapsed_s
        self._fraction = min(max(fraction, 0.0), 1.0)
        for key, values in self._history.items():
            value = _value(row, key)
            if value is not None:
                values.append(value)
        self._tracks.add(row)

    def line(self) -> str:
        row = self._row
        parts = [
            f"{100 * self._fraction:3.0f} %",
            f"iteration {_format(row, 'iteration', ',.0f')}",
            _format(row, "env_steps", ",.0f", " steps"),
            _format(row, "env_steps_per_s", ",.0f", "/s"),
            f"return {_format(row, 'mean_return', ',.2f')}",
            f"completion {_format(row, 'completion', '.1f', ' %')}",
            f"laps {_format(row, 'laps', ',.0f')} ({_share(row)} of last {self.header.remembered})",
            self._tracks.least()
            if self._tracks
            else f"best lap {_format(row, 'best_lap_time_s', '.2f', ' s')}",
            f"entropy {_format(row, 'entropy', '.3f')}",
            f"lr {_format(row, 'lr', '.2g')}",
            _left(self._eta_s),
        ]
        return " · ".join(parts)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        # On a very wide terminal the eye would have to travel between the halves.
        width = min(options.max_width, 100)
        # Less the border and two columns of padding on each side.
        inner = width - 6
        figures = self._figures(inner, width >= HALVES)
        if width < HALVES:  # the first ones matter most
            figures = figures[: max(1, console.height - _FRAME_LINES + 1)]
        elif self._tracks:
            room = console.height - len(figures) - _FRAME_LINES
            figures += [Text(""), *self._tracks.lines(inner, room)]
        yield Panel(
            Group(
                Text(_join(self.header), style="dim", overflow="ellipsis", no_wrap=True),
                Text(""),
                self._bar(inner, width >= WIDE),
                Text(""),
                *figures,
            ),
            title=Text(self.header.name, style="bold"),
            title_align="left",
            subtitle=Text(_tail(self.header.folder, inner - 2), style="dim"),
            subtitle_align="left",
            border_style="bright_black",
            padding=(1, 2),
            width=width,
        )

    def _bar(self, width: int, wide: bool) -> Table:
        spent = Text.assemble((f"{100 * self._fraction:.0f} %", "bold"))
        left = _left(self._eta_s)
        if width >= HALVES - 6:
            spent.append(f" of {self.header.budget if wide else 'budget'}", style="dim")
            left = f"{_clock(self._elapsed_s)} · {left}"
        row = Table.grid(padding=(0, 2), expand=True)
        row.width = width
        row.add_column(ratio=1, min_width=4)
        row.add_column(justify="right", no_wrap=True)
        row.add_column(justify="right", no_wrap=True)
        row.add_row(
            ProgressBar(
                total=1.0,
                completed=self._fraction,
                style="grey23",
                complete_style="cyan",
                finished_style="cyan",
            ),
            spent,
            left,
        )
        return row

    def _figures(self, width: int, halves: bool) -> list[Text]:
        row = self._row
        left = width - GAP - RIGHT if halves else width
        right = RIGHT if halves else width

        def curve(key: str, style: str, bounds: tuple[float, float] | None = None) -> Text:
            return Text(sparkline(self._history[key], left - LABEL - VALUE, bounds), style=style)

        def cell(label: str, value: str, note: Text | str = "", room: int = left) -> Text:
            text = Text.assemble((label.ljust(LABEL), "dim"), (value.ljust(VALUE), "bold"), note)
            text.truncate(room, overflow="ellipsis", pad=True)
            return text

        completion = cell(
            "completion", _format(row, "completion", ".1f", " %"), curve("completion", "green", (0, 100))
        )
        returns = cell("return", _format(row, "mean_return", ",.2f"), curve("mean_return", "cyan"))
        entropy = cell("entropy", _format(row, "entropy", ".3f"), curve("entropy", "magenta"))
        rate = _format(row, "lr", ".2g")
        laps = cell("laps", _format(row, "laps", ",.0f"), room=right)
        share = cell(f"of last {self.header.remembered}", _share(row), room=right)
        best = cell("best lap", _format(row, "best_lap_time_s", ".2f", " s"), room=right)
        mean = cell("mean lap", _format(row, "mean_lap_time_s", ".2f", " s"), room=right)
        steps = cell("env steps", _format(row, "env_steps", ",.0f"))
        speed = cell("speed", _format(row, "env_steps_per_s", ",.0f", " steps/s"))
        iteration = cell("iteration", _format(row, "iteration", ",.0f"), room=right)
        episodes = cell("episodes", _format(row, "episodes", ",.0f"), room=right)
        if not halves:
            lap_times = () if self._tracks else (best, mean)
            learn_rate = cell("learn rate", rate)
            return [
                *(iteration, completion, laps, share, *lap_times[:1], entropy, returns),
                *(*lap_times[1:], steps, speed, episodes, learn_rate),
            ]
        if self._tracks:  # lap times stand at each track
            rows = [(completion, laps), (returns, share), (entropy, cell("learn rate", rate, room=right))]
        else:
            rows = [(completion, laps), (returns, share), (entropy, best), (cell("learn rate", rate), mean)]
        rows += [(Text(""), Text("")), (steps, iteration), (speed, episodes)]
        return [one + " " * GAP + other for one, other in rows]


class TrackTable:
    """Completion and best lap of each track."""

    def __init__(self, labels: Sequence[str]):
        """Begin empty.

        Args:
            labels: of the tracks, as in the rows of metrics.jsonl; empty for a run on one track.
        """
        self._labels = labels
        # An iteration need not end an episode on every track: what was known last stays.
        self._completion: dict[str, float] = {}
        self._best_s: dict[str, float] = {}

    def __bool__(self) -> bool:
        return bool(self._labels)

    def add(self, row: Mapping[str, float | int | None]) -> None:
        """Add the figures of an iteration."""
        for metric, known in (("completion", self._completion), ("best_lap_time_s", self._best_s)):
            for label in self._labels:
                value = row.get(track_metric(metric, label))
                if value is not None and math.isfinite(value):
                    known[label] = value

    def least(self) -> str:
        """Name the track on which the car comes least far."""
        if not self._completion:
            return f"least {NOTHING}"
        label = min(self._completion, key=self._completion.__getitem__)
        return f"least {self._completion[label]:.1f} % on {label}"

    def lines(self, width: int, room: int) -> list[Text]:
        """Return the table, tracks running down its columns.

        Args:
            width: columns of the terminal to fill.
            room: lines that are free; tracks that find none are counted at the end.
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
        head = Text(_columns("track", "%", "lap s", cell), style="dim")
        grid = [[head] * used, *(cells[row::rows] for row in range(rows))]
        return [Text(" " * _TABLE_GAP).join(row) for row in grid]

    def _track(self, label: str, cell: int) -> str:
        done, best_s = self._completion.get(label), self._best_s.get(label)
        done_text = NOTHING if done is None else f"{done:.0f}"
        return _columns(label, done_text, NOTHING if best_s is None else f"{best_s:.2f}", cell)


def _columns(name: str, done: str, best: str, cell: int) -> str:
    """Set a name to the left and figures to the right; a long name loses its middle, since both ends distinguish it."""
    done_room, best_room = _FIGURES
    room = cell - done_room - best_room
    if len(name) > room:
        name = f"{name[: room // 2]}…{name[len(name) - (room - 1) // 2 :]}"
    return f"{name:<{room}}{done:>{done_room}}{best:>{best_room}}"


def sparkline(values: list[float], width: int, bounds: tuple[float, float] | None = None) -> str:
    """Draw values as at most `width` bars, each the mean of its share of them.

    Args:
        values: finite numbers, oldest first.
        width: most characters.
        bounds: values of the lowest and the highest bar; without them, those of the bars themselves.
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


def _format(row: Row, key: str, spec: str, unit: str = "") -> str:
    value = _value(row, key)
    return NOTHING if value is None else format(value, spec) + unit


def _share(row: Row) -> str:
    share = _value(row, "lap_share")
    return NOTHING if share is None else f"{100 * share:.0f} %"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _left(eta_s: float | None) -> str:
    if eta_s is None or not math.isfinite(eta_s):
        return f"{NOTHING} left"
    return f"at most {_clock(max(eta_s, 0.0))} left"  # the last iteration may end past the budget


def _join(header: RunHeader) -> str:
    return " · ".join((header.track, header.reward, header.network, header.actions))


def _tail(text: str, width: int) -> str:
    """Keep the end of a path: it distinguishes runs."""
    return text if len(text) <= width else "…" + text[len(text) - width + 1 :]
