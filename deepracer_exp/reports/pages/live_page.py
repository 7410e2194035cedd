"""The command `watch --live`: a page with the newest evaluation laps of a training, while it runs."""

import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.film import LapRecorder, best_attempt
from deepracer_exp.evaluation.results import USUAL, Evaluation
from deepracer_exp.evaluation.run_evaluation import results_table, trained_on
from deepracer_exp.reports.charts.run_pictures import TrackLines
from deepracer_exp.reports.charts.training_charts import curves_so_far, newest_laps
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.checkpoints import StoredPolicy, check, read_policy
from deepracer_exp.runs.folder import is_held
from deepracer_exp.runs.next_steps import outcome, state
from deepracer_exp.runs.run_files import METRICS, SUMMARY, read_head, read_metrics
from deepracer_exp.runs.stored_run import StoredRun

from .live_server import LiveServer
from .page import Glimpse, Plot, plot_of, render
from .sight import glimpses

_EVERY_S = 1.0
"""Seconds between two checks of the run's folder."""
_CURVES_EVERY_S = 10.0
"""Seconds between two drawings of the curves of a run in progress: each loads the page again."""
_LAST = "last"
_NICENESS = 19

Used: TypeAlias = Callable[[int, int, float], tuple[str, float]]
"""Returns the used share of a budget after control steps, iterations and seconds: `Budget.used`."""


@dataclass(frozen=True, kw_only=True)
class _Laps:
    """The laps of a checkpoint for the page."""

    words: str
    plot: Plot
    caption: str
    table: Table
    strip: Sequence[Glimpse]


class LivePage:
    """The page of a run, drawn again when its folder has newer iterations, a newer checkpoint or the end.

    A training stores no steps of its evaluations, so the newest checkpoint drives their laps again here.

    Attributes:
        shown: a version, which changes with the page, and the page.
    """

    def __init__(self, run: StoredRun, protocol: EvaluationConfig, used: Used) -> None:
        """Build the cars and draw the curves. The run need not have an iteration or a checkpoint yet.

        Raises:
            BadInput: a track or a condition is unknown or malformed.
        """
        self._run, self._protocol, self._used = run, protocol, used
        self._evaluator = Evaluator(run.experiment, protocol, threads=1)
        self._driven = ""
        self._laps: _Laps | None = None
        self.shown = ("0", "")
        self._draw()

    def update(self) -> bool:
        """Draw the page again if there is newer data; return whether there was."""
        written, ended = _seen(self._run.path)
        if ended != self._seen[1] or (
            written != self._seen[0] and time.monotonic() - self._drawn_s >= _CURVES_EVERY_S
        ):
            self._draw()
            return True
        link = self._run.checkpoints / _LAST
        newest = link.resolve().name
        if not link.exists() or newest == self._driven:
            return False
        try:
            stored = read_policy(self._run.experiment, check(link))
        except BadInput:
            if link.resolve().name != newest:
                return False  # the training has replaced it meanwhile
            raise
        self._laps, self._driven = self._drive(stored), newest
        self._draw()
        return True

    def _drive(self, stored: StoredPolicy) -> _Laps:
        policy, evaluator = stored.networks.policy, self._evaluator
        recorder = LapRecorder(evaluator)
        evaluation = evaluator(policy, recorder)
        camera, strip = self._run.experiment.observation.camera, list[Glimpse]()
        if camera is not None:
            again = LapRecorder(evaluator, best_attempt(evaluation))
            evaluator(policy, again)
            best = again.lap(best_attempt(evaluation))
            strip = glimpses(best, again.acted, policy, evaluator.race.setup.actions, camera)
        trained = trained_on(self._run.experiment, self._protocol, evaluation)
        chart = newest_laps(track_lines(evaluator, evaluation, recorder))
        return _Laps(
            words=f"{checkpoint_words(stored.path.name)}, {stored.counters['env_steps']:,} steps",
            plot=plot_of(chart),
            caption=chart.caption,
            table=results_table(evaluation, self._protocol, trained, Console(quiet=True, width=200)),
            strip=strip,
        )

    def _draw(self) -> None:
        self._seen, self._drawn_s = _seen(self._run.path), time.monotonic()
        head, metrics = read_head(self._run.path), self._run.path / METRICS
        rows = read_metrics(metrics) if metrics.exists() else []
        curves = plot_of(curves_so_far(rows)) if rows else None
        laps = self._laps
        version = str(int(self.shown[0]) + 1)
        page = render(
            __package__,
            "live.html.j2",
            [plot for plot in (curves, None if laps is None else laps.plot) if plot is not None],
            is_live=True,
            scripts=["live.js"],
            version=version,
            title=self._run.experiment.name,
            name=self._run.path.name,
            state=state(head),
            clock=self._clock(rows[-1], self._seen[1] != "running") if rows else None,
            outcome=[pair for pair in outcome(head) if pair[0] != "State"],
            curves=curves,
            laps=laps,
            heads=[] if laps is None else [str(column.header) for column in laps.table.columns],
            rows=[]
            if laps is None
            else list(zip(*(column.cells for column in laps.table.columns), strict=True)),
            note="" if laps is None or laps.table.caption is None else str(laps.table.caption),
            waiting="its laps are being driven"
            if (self._run.checkpoints / _LAST).exists()
            else "no checkpoint yet",
        )
        self.shown = (version, page)

    def _clock(self, row: Mapping[str, Any], ended: bool) -> dict[str, Any]:
        """Return the values from which the page computes elapsed and remaining time, by this machine's clock, in ms."""
        used_s = float(row["wall_clock_s"])
        _, share = self._used(int(row["env_steps"]), int(row["iteration"]), used_s)
        now_ms = 1000 * (self._run.path / METRICS).stat().st_mtime
        left_s = used_s * (1 / share - 1) if share else math.nan
        return {
            "percent": min(100, int(100 * share)),
            "iteration": row["iteration"],
            "env_steps": f"{row['env_steps']:,}",
            "elapsed": round(1000 * used_s),
            "since": "" if ended else round(now_ms - 1000 * used_s),
            "until": "" if ended or not math.isfinite(left_s) else round(now_ms + 1000 * max(left_s, 0.0)),
        }


def _seen(run: Path) -> tuple[int, str]:
    """Return a version that changes with the page: the size of the metrics, and the ending or state of the run."""
    metrics, summary = run / METRICS, run / SUMMARY
    ended = "ended" if summary.exists() else "running" if is_held(run) else "killed"
    return metrics.stat().st_size if metrics.exists() else 0, ended


def track_lines(evaluator: Evaluator, evaluation: Evaluation, recorder: LapRecorder) -> list[TrackLines]:
    """Return the laps on the usual conditions, by track; those interrupted by the end of the race do not count."""
    shown = []
    groups = [group for group in evaluation.groups if group.condition == USUAL]
    for course, group in zip(evaluator.race.setup.courses, groups, strict=True):
        times_s = group.lap_times_s
        words = f"{len(times_s)} of {len(group.decided)} usual laps complete"
        words += f", the fastest in {min(times_s):.2f} s" if len(times_s) else ""
        laps = [recorder.lap(attempt) for attempt in group.attempts]
        lines = [np.column_stack([lap.x_m, lap.y_m, lap.speed_mps]) for lap in laps if len(lap) > 1]
        boxes = np.concatenate([np.zeros((0, 4, 2)), *(lap.boxes for lap in laps)])
        shown.append(TrackLines(course.tracks[0], words, lines, boxes))
    return shown


def serve_live(run: StoredRun, protocol: EvaluationConfig, server: LiveServer, used: Used) -> None:
    """Serve the page of a run, which may be over, until Ctrl-C, at the lowest priority.

    Raises:
        BadInput: a file of the run or the protocol cannot be used.
        RunFailed: a car's state became NaN.
    """
    os.nice(_NICENESS)
    torch.set_num_threads(1)
    page = LivePage(run, protocol, used)
    server.shown = page.shown
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        while True:
            if page.update():
                server.shown = page.shown
            time.sleep(_EVERY_S)
    except KeyboardInterrupt:
        return
    finally:
        server.shutdown()
