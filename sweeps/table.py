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
from .labels import duration, shown_values
from .ledger import Slot
from .plan import Plan

NOTHING = "\N{EN DASH}"
_POINTS = 16
"""Of a sparkline."""
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
        self._before: set[int] | None = None
        """Slots that had ended before this start."""
        self._begun_before = 0
        """Trials that were under way then: the rest of one says nothing of how long a trial takes."""
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
        if self._before is None:
            self._before, self._told = set(ended), set(ended)
            self._begun_before = sum(bool(slot.progress) for slot in slots if slot.outcome is None)
        for slot in slots:
            self._follow(slot)
            if self._live is None and slot.slot in ended - self._told:
                self._line(_sentence(slot, self._plan.config.objectives))
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
        here = ended - len(self._before or ())
        hours = (time.monotonic() - self._began) / 3600
        rate = here / hours if here > self._begun_before else None
        grid = Table.grid(padding=(0, 2))
        grid.add_column(style="dim")
        grid.add_column()
        grid.add_row("trials", ProgressBar(total, min(ended, total), width=40))
        grid.add_row("", f"{ended} of {total}: {told}")
        left = NOTHING if rate is None else duration(max(total - ended, 0) / rate * 3600)
        grid.add_row("speed", NOTHING if rate is None else f"{rate:.0f} an hour, {left} left")
        grid.add_row("best", _best(slots, self._plan.config.objectives))
        return grid

    def _running(self, running: Sequence[Slot]) -> Table:
        table = Table(box=None, pad_edge=False, header_style="dim")
        for name, justify in (
            ("trial", "right"), ("steps", "right"), ("completion", "right"), ("", "left"), ("entropy", "right"),
            ("evaluated", "left"),
        ):  # fmt: skip
            table.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
        for slot in running:
            table.add_row(*self._cells(slot))
        return table

    def _cells(self, slot: Slot) -> tuple[str, ...]:
        row: Mapping[str, Any] = slot.progress
        name = f"{_number(slot)}" + (f" (attempt {slot.attempt})" if slot.attempt > 1 else "")
        if slot.expired:
            return name, NOTHING, NOTHING, "", NOTHING, "waits for a worker"
        if not row:
            return name, NOTHING, NOTHING, "", NOTHING, "starts"
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
        )


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
    return f"trial {_number(slot)} {outcome} ({fate}) after {steps:,} steps: {told}"
