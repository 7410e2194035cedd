"""The live view of a sweep in a terminal, and plain lines where there is none."""

import collections
import textwrap
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from deepracer_exp.errors import count
from deepracer_exp.sweeps.queue.claims import Claim
from deepracer_exp.sweeps.queue.worker_config import WorkerConfig
from deepracer_exp.sweeps.search.objectives import NONE, cost, score_text, shown_values
from deepracer_exp.sweeps.trial import Trial
from deepracer_exp.training.display import LINE_COLUMNS, sparkline

from .wording import duration, ending_words, parameter, short_keys

_POINTS = 16
"""Characters of a sparkline."""
_LEAST_MADE = 0.05
"""Trials of this start before their pace predicts the remaining time."""
_STATES = {"COMPLETE": "done", "PRUNED": "pruned", "FAIL": "failed"}


class SweepView:
    """Shows a running sweep; use as a context manager.

    On a terminal one panel is redrawn in place and stays at the end; elsewhere, each trial that ends is a line.
    """

    def __init__(self, config: WorkerConfig, workers: int, console: Console):
        self._study, self._folder, self._sweep = config.study, config.folder, config.config
        self._workers, self._console = workers, console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._began = time.monotonic()
        self._made_before: float | None = None
        """Trials made before this start; running ones count with their completed share."""
        self._printed: set[int] = set()
        self._completions: dict[int, collections.deque[float]] = {}
        self._evaluated: dict[int, str] = {}

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        else:
            trials, workers = count(self._sweep.trials, "trial"), count(self._workers, "worker")
            self.say(f"{self._study}: {trials}, {workers}")
            self._console.print(f"runs in {self._folder}", soft_wrap=True)  # a path is not folded
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, claims: Sequence[Claim], stage: str = "") -> None:
        """Draw the present state of all claims; `stage` describes the work while no trial runs."""
        ended = {claim.trial.number for claim in claims if claim.has_ended}
        if self._made_before is None:
            self._made_before, self._printed = _made(claims), set(ended)
        for claim in claims:
            self._follow(claim)
            if self._live is None and claim.trial.number in ended - self._printed:
                left = f", {self._left(claims)}" if len(ended) < self._sweep.trials else ""
                line = _sentence(claim, self._sweep.objectives)
                self.say(f"{len(ended)} of {self._sweep.trials}{left}: {line}")
                if params := _params(claim):
                    self.say(f"  {params}")
        self._printed |= ended
        if self._live is not None:
            self._live.update(self._panel(claims, stage), refresh=True)

    def say(self, text: str) -> None:
        """Print a text, above the panel where there is one, in lines of at most `LINE_COLUMNS`."""
        lines = textwrap.wrap(text, LINE_COLUMNS, subsequent_indent="  ", break_on_hyphens=False)
        self._console.print("\n".join(lines), soft_wrap=True)

    def _follow(self, claim: Claim) -> None:
        completion = claim.progress.get("completion")
        if completion is None:
            return
        seen = self._completions.setdefault(claim.trial.number, collections.deque(maxlen=_POINTS))
        if not seen or seen[-1] != completion:
            seen.append(float(completion))

    def _panel(self, claims: Sequence[Claim], stage: str) -> Panel:
        parts: list[Any] = [self._summary(claims)]
        running = [claim for claim in claims if not claim.has_ended]
        if running:
            parts += [Text(), self._running(running)]
        if stage or not claims:
            parts += [Text(), Text(stage or "workers start", style="dim")]
        return Panel(Group(*parts), title=self._study, title_align="left", border_style="dim")

    def _summary(self, claims: Sequence[Claim]) -> Table:
        total = self._sweep.trials
        counts = collections.Counter(claim.trial.state for claim in claims if claim.has_ended)
        words = ", ".join(f"{counts[state]} {word}" for state, word in _STATES.items())
        grid = Table.grid("", "", padding=(0, 2))
        grid.add_row("trials", ProgressBar(total, min(counts.total(), total), width=40))
        grid.add_row("", f"{counts.total()} of {total}: {words}")
        grid.add_row("time", f"{duration(time.monotonic() - self._began)}, {self._left(claims)}")
        grid.add_row("best", _best(claims, self._sweep.objectives))
        return grid

    def _left(self, claims: Sequence[Claim]) -> str:
        """Return the remaining time at the pace of this start; less if trials end early."""
        made = _made(claims)
        here = made - (self._made_before or 0.0)
        if here < _LEAST_MADE:
            return "time left not known yet"
        left = max(self._sweep.trials - made, 0.0) / here * (time.monotonic() - self._began)
        return f"about {duration(left)} left"

    def _running(self, running: Sequence[Claim]) -> Table:
        table = Table(box=None, pad_edge=False, header_style="dim")
        for name in ("trial", "steps", "exploring", "", "entropy", "usual laps"):
            table.add_column(name, justify="left" if name in ("", "usual laps") else "right", no_wrap=True)
        table.add_column("values", ratio=1)
        for claim in running:
            table.add_row(*self._cells(claim), _params(claim))
        return table

    def _cells(self, claim: Claim) -> tuple[str, ...]:
        row: Mapping[str, Any] = claim.progress
        number = claim.trial.number
        name = f"{number}" + (f" (attempt {claim.attempt})" if claim.attempt > 1 else "")
        if claim.expired or "env_steps" not in row:
            return name, NONE, NONE, "", NONE, "waits for a worker" if claim.expired else "starts"
        lap_s, evaluated = row.get("eval_lap_time_s"), row.get("eval_completion")
        if evaluated is not None:
            lap = "no lap" if lap_s is None else f"{lap_s:.2f} s"
            self._evaluated[number] = f"{lap}, {evaluated:.0f}%"
        return (
            name,
            f"{row['env_steps']:,}",
            NONE if row["completion"] is None else f"{row['completion']:.0f}%",
            sparkline(list(self._completions.get(number, ())), _POINTS),
            NONE if row["entropy"] is None else f"{row['entropy']:.2f}",
            self._evaluated.get(number, NONE),
        )


def _made(claims: Sequence[Claim]) -> float:
    return sum(1.0 if claim.has_ended else claim.progress.get("share", 0.0) for claim in claims)


def _params(claim: Claim) -> str:
    """Return the values of a trial: `lr 0.0003, network mlp`."""
    params = claim.progress.get("params", {})
    return ", ".join(f"{short} {parameter(params[key])}" for key, short in short_keys(params).items())


def _best(claims: Sequence[Claim], objectives: Sequence[str]) -> str:
    done = [claim.trial for claim in claims if claim.trial.values]
    best = min(done, key=lambda trial: (cost(objectives, trial.values or ()), trial.number), default=None)
    return NONE if best is None else f"trial {best.number}, {_values(best, objectives)}"


def _values(trial: Trial, objectives: Sequence[str]) -> str:
    """Return the values of a trial, and lap and completion where they are no objectives."""
    parts = [shown_values(objectives, trial.values or (), trial.held_out_completion is not None)]
    if "lap_time" not in objectives:
        parts.append(
            "no lap"
            if trial.lap_time_s is None
            else f"mean usual lap {score_text('lap_time', trial.lap_time_s)}"
        )
    if "completion" not in objectives:
        parts.append(f"{trial.completion:.0f}% driven")
    return ", ".join(parts)


def _sentence(claim: Claim, objectives: Sequence[str]) -> str:
    trial = claim.trial
    state, ending = _STATES[trial.state], ending_words(trial.ending)
    end = _values(trial, objectives) if trial.values else trial.reason
    # "done (finished)" and "pruned (collapsed) ...: collapsed: ..." say one thing twice.
    how = "" if ending in ("finished", state) or end.startswith(ending) else f" ({ending})"
    return f"trial {trial.number} {state}{how} after {trial.env_steps:,} steps: {end}"
