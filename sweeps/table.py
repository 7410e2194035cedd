"""The live view of a sweep in the terminal, and its plain lines where there is none."""

import collections
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from deepracer_exp.training.display import sparkline

from .best import cost
from .fates import words
from .labels import duration, parameter, short_keys, shown_values
from .ledger import Slot
from .plan import Plan

NOTHING = "\N{EN DASH}"
_POINTS = 16
"""Of a sparkline."""
_LEAST_MADE = 0.05
"""Trials made here before their pace says how long the others take."""
_OUTCOMES = {"COMPLETE": "done", "PRUNED": "pruned", "FAIL": "failed"}


class SweepView:
    """Shows a sweep while it runs; a context.

    On a terminal one panel is redrawn in place and stays at the end; elsewhere, each trial that ends is a line.
    """

    def __init__(self, plan: Plan, workers: int, console: Console):
        """Show nothing yet.

        Args:
            plan: of the sweep.
            workers: that make trials here.
            console: stderr's: stdout is for results.
        """
        self._plan, self._workers, self._console = plan, workers, console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._began = time.monotonic()
        self._made_before: float | None = None
        """Trials that had been made before this start, those under way counted by their share."""
        self._told: set[int] = set()
        self._courses: dict[int, collections.deque[float]] = {}
        self._evaluated: dict[int, str] = {}
        self.stage = ""
        """What is going on when no trial is."""

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        else:
            study, trials = self._plan.study, self._plan.config.trials
            self._line(f"{study}: {trials} trials, {self._workers} workers; runs in {self._plan.folder}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, slots: Sequence[Slot]) -> None:
        """Draw what the ledger tells."""
        ended = {slot.slot for slot in slots if slot.outcome is not None}
        if self._made_before is None:
            self._made_before, self._told = _made(slots), set(ended)
        for slot in slots:
            self._follow(slot)
            if self._live is None and slot.slot in ended - self._told:
                line = _sentence(slot, self._plan.config.objectives)
                self._line(f"{line}; {len(ended)} of {self._plan.config.trials}, {self._left(slots)}")
        self._told |= ended
        if self._live is not None:
            self._live.update(self._panel(slots), refresh=True)

    def _line(self, text: str) -> None:
        self._console.print(text, highlight=False, soft_wrap=True)

    def _follow(self, slot: Slot) -> None:
        completion = slot.progress.get("completion")
        if completion is None:
            return
        course = self._courses.setdefault(slot.slot, collections.deque(maxlen=_POINTS))
        if not course or course[-1] != completion:
            course.append(float(completion))

    def _panel(self, slots: Sequence[Slot]) -> Panel:
        parts: list[Any] = [self._summary(slots)]
        running = [slot for slot in slots if slot.outcome is None]
        if running:
            parts += [Text(), self._running(running)]
        elif not slots and not self.stage:
            parts += [Text(), Text("workers start", style="dim")]
        if self.stage:
            parts += [Text(), Text(self.stage, style="dim")]
        return Panel(Group(*parts), title=self._plan.study, title_align="left", border_style="dim")

    def _summary(self, slots: Sequence[Slot]) -> Table:
        total = self._plan.config.trials
        counts = collections.Counter(slot.outcome for slot in slots)
        ended = sum(counts[one] for one in _OUTCOMES)
        told = ", ".join(f"{counts[one]} {word}" for one, word in _OUTCOMES.items())
        grid = Table.grid(padding=(0, 2))
        grid.add_column(style="dim")
        grid.add_column()
        grid.add_row("trials", ProgressBar(total, min(ended, total), width=40))
        grid.add_row("", f"{ended} of {total}: {told}")
        grid.add_row("time", f"{duration(time.monotonic() - self._began)}, {self._left(slots)}")
        grid.add_row("best", _best(slots, self._plan.config.objectives))
        return grid

    def _left(self, slots: Sequence[Slot]) -> str:
        """Return how long the rest takes at the pace of this start; trials that end early make it less."""
        made = _made(slots)
        here = made - (self._made_before or 0.0)
        if here < _LEAST_MADE:
            return "time left not known yet"
        left = max(self._plan.config.trials - made, 0.0) / here * (time.monotonic() - self._began)
        return f"about {duration(left)} left"

    def _running(self, running: Sequence[Slot]) -> Table:
        table = Table(box=None, pad_edge=False, header_style="dim")
        for name, justify in (
            ("trial", "right"), ("steps", "right"), ("completion", "right"), ("", "left"), ("entropy", "right"),
            ("evaluated", "left"),
        ):  # fmt: skip
            table.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
        table.add_column("draws", ratio=1)
        for slot in running:
            table.add_row(*self._cells(slot))
        return table

    def _cells(self, slot: Slot) -> tuple[str, ...]:
        row: Mapping[str, Any] = slot.progress
        name = f"{_number(slot)}" + (f" (attempt {slot.attempt})" if slot.attempt > 1 else "")
        if slot.expired:
            return name, NOTHING, NOTHING, "", NOTHING, "waits for a worker", _params(slot)
        if "env_steps" not in row:
            return name, NOTHING, NOTHING, "", NOTHING, "starts", _params(slot)
        lap_s, completion = row.get("eval_lap_time_s"), row.get("eval_completion")
        if completion is not None:
            lap = "no lap" if lap_s is None else f"{lap_s:.2f} s"
            self._evaluated[slot.slot] = f"{lap}, {completion:.0f} %"
        return (
            name,
            f"{row['env_steps']:,}",
            NOTHING if row["completion"] is None else f"{row['completion']:.0f} %",
            sparkline(list(self._courses.get(slot.slot, ())), _POINTS),
            f"{row['entropy']:.2f}",
            self._evaluated.get(slot.slot, NOTHING),
            _params(slot),
        )


def _made(slots: Sequence[Slot]) -> float:
    return sum(1.0 if slot.outcome is not None else slot.progress.get("share", 0.0) for slot in slots)


def _params(slot: Slot) -> str:
    """Return what a trial draws: `lr 0.0003, network mlp`."""
    params = slot.progress.get("params", {})
    return ", ".join(f"{short} {parameter(params[key])}" for key, short in short_keys(params).items())


def _number(slot: Slot) -> object:
    """Return Optuna's number of the trial, which is known from its first row on."""
    return slot.attrs.get("number", slot.progress.get("number", NOTHING))


def _best(slots: Sequence[Slot], objectives: Sequence[str]) -> str:
    done = [slot for slot in slots if slot.outcome == "COMPLETE" and slot.values]
    if not done:
        return NOTHING
    best = min(done, key=lambda slot: cost(objectives, slot.values or ()))
    return f"trial {_number(best)}, {shown_values(objectives, best.values or ())}{_drawn(best)}"


def _drawn(slot: Slot) -> str:
    lap_s, completion = slot.attrs.get("lap_time_s"), slot.attrs.get("completion")
    lap = "no lap" if lap_s is None else f"lap {lap_s:.2f} s"
    return f" ({lap}, {completion:.0f} % driven)"


def _sentence(slot: Slot, objectives: Sequence[str]) -> str:
    outcome = _OUTCOMES[slot.outcome or ""]
    fate, steps = words(slot.attrs.get("fate", "")), slot.attrs.get("env_steps", 0)
    told = (
        shown_values(objectives, slot.values) + _drawn(slot) if slot.values else slot.attrs.get("reason", "")
    )
    drew = f" with {params}" if (params := _params(slot)) else ""
    return f"trial {_number(slot)}{drew} {outcome} ({fate}) after {steps:,} steps: {told}"
