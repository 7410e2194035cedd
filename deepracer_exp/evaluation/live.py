"""The command `watch --live`: a page with the newest evaluation laps of a training, while it runs."""

import io
import os
import threading
import time

import numpy as np
import pandas as pd
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from deepracer_exp.analysis.charts.run_pictures import TrackLines, learning_curves, lines_figure
from deepracer_exp.analysis.next_steps import outcome
from deepracer_exp.analysis.page import Glimpse, png_uri, render
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoints import StoredPolicy, check, read_policy
from deepracer_exp.runs.files import METRICS, SUMMARY, read_head, read_metrics
from deepracer_exp.runs.resolve import StoredRun

from .evaluate import results_table, trained_on
from .evaluator import Evaluator
from .film import LapRecorder, best_attempt
from .live_server import LiveServer
from .result import USUAL, Evaluation
from .sight import glimpses

_EVERY_S = 1.0
"""Seconds between two looks into the run's folder."""
_LAST = "last"
_NICENESS = 19


class LivePage:
    """The page of a run, drawn again when its folder has a newer checkpoint or the training has ended.

    A training stores no steps of its evaluations, so the newest checkpoint drives their laps again here.

    Attributes:
        shown: a version, which changes with the page, and the page.
    """

    def __init__(self, run: StoredRun, protocol: EvaluationConfig) -> None:
        """Build the cars; `update` draws. The run need not have a checkpoint yet.

        Raises:
            BadInput: a track or a condition is unknown or malformed.
        """
        self._run, self._protocol = run, protocol
        self._evaluator = Evaluator(run.experiment, protocol, threads=1)
        self._newest: tuple[str, bool] | None = None
        self.shown = ("0", "")
        waiting = "its laps are being driven" if (run.checkpoints / _LAST).exists() else "no checkpoint yet"
        self._draw(waiting, None, [], "")

    def update(self) -> bool:
        """Draw the page again if there is something newer; return whether there was."""
        link = self._run.checkpoints / _LAST
        newest = (link.resolve().name, (self._run.path / SUMMARY).exists())
        if not link.exists() or newest == self._newest:
            return False
        try:
            stored = read_policy(self._run.experiment, check(link))
        except BadInput:
            if link.resolve().name != newest[0]:
                return False  # the training has replaced it meanwhile
            raise
        self._drive(stored)
        self._newest = newest
        return True

    def _drive(self, stored: StoredPolicy) -> None:
        policy, evaluator = stored.networks.policy, self._evaluator
        recorder = LapRecorder(evaluator)
        evaluation = evaluator(policy, recorder)
        lines = lines_figure(track_lines(evaluator, evaluation, recorder))
        camera, strip = self._run.experiment.observation.camera, list[Glimpse]()
        if camera is not None:
            again = LapRecorder(evaluator, best_attempt(evaluation))
            evaluator(policy, again)
            best = again.lap(best_attempt(evaluation))
            strip = glimpses(best, again.acted, policy, evaluator.race.setup.actions, camera)
        steps = stored.counters["env_steps"]
        self._draw(f"checkpoint {stored.path.name}, {steps:,} steps", evaluation, strip, _png_of(lines))

    def _draw(self, headline: str, evaluation: Evaluation | None, strip: list[Glimpse], lines: str) -> None:
        metrics, curves, table = self._run.path / METRICS, "", None
        if metrics.exists() and (rows := read_metrics(metrics)):
            curves = _png_of(learning_curves(pd.DataFrame(rows)))
        if evaluation is not None:
            known = trained_on(self._run.experiment, self._protocol, evaluation)
            table = results_table(evaluation, self._protocol, known, Console(width=200))
        version = str(int(self.shown[0]) + 1)
        page = render(
            __package__,
            "live.html.j2",
            [],
            is_live=True,
            version=version,
            name=self._run.path.name,
            headline=headline,
            outcome=outcome(read_head(self._run.path)),
            heads=[] if table is None else [str(column.header) for column in table.columns],
            rows=[] if table is None else list(zip(*(column.cells for column in table.columns), strict=True)),
            note="" if table is None else str(table.caption),
            lines=lines,
            curves=curves,
            strip=strip,
        )
        self.shown = (version, page)


def track_lines(evaluator: Evaluator, evaluation: Evaluation, recorder: LapRecorder) -> list[TrackLines]:
    """Return the laps on the usual conditions, by track; those that the end of the race cut off do not count."""
    shown = []
    groups = [group for group in evaluation.groups if group.condition == USUAL]
    for course, group in zip(evaluator.race.setup.courses, groups, strict=True):
        times_s = group.lap_times_s
        words = f"{len(times_s)} of {len(group.decided)} laps complete"
        words += f", the fastest in {min(times_s):.2f} s" if len(times_s) else ""
        laps = [recorder.lap(attempt) for attempt in group.attempts]
        lines = [np.column_stack([lap.x_m, lap.y_m, lap.speed_mps]) for lap in laps if len(lap) > 1]
        shown.append(TrackLines(course.tracks[0], words, lines))
    return shown


def _png_of(figure: Figure) -> str:
    file = io.BytesIO()
    figure.set_dpi(110)
    FigureCanvasAgg(figure).print_png(file)
    return png_uri(file.getvalue())


def serve_live(run: StoredRun, protocol: EvaluationConfig, server: LiveServer) -> None:
    """Serve the page of a run, which may be over, until Ctrl-C, at the lowest priority.

    Raises:
        BadInput: a file of the run or the protocol cannot be used.
        RunFailed: a car's state became NaN.
    """
    os.nice(_NICENESS)
    torch.set_num_threads(1)
    page = LivePage(run, protocol)
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
