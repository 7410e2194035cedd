"""The control steps of an evaluation in the service's format, with the places of boxes, bots and rivals."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from tensordict import TensorDict

from deepracer_exp.aws.logs.sim_trace import write_trace
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.others.placement import placements_table
from deepracer_exp.env.race import Race
from deepracer_exp.env.trace_columns import EPISODE_STATUS, PACKED, STATUS_CODE, to_table
from deepracer_exp.errors import RunFailed, writing
from deepracer_exp.runs.trace import write_evaluation_others

from .evaluator import Evaluator
from .race_protocol import RaceProtocol


class TraceRecorder:
    """Records the control steps of all trials; each lap is an episode, and continues the steps of the lap before it."""

    def __init__(self, config: EvaluationConfig) -> None:
        """Start empty; `config` is the protocol."""
        self._penalty_s = vars(config.penalty_s)
        self._steps: list[NDArray[np.float64]] = []
        self._laps: list[NDArray[np.int64]] = []
        """Number of the trial's lap of each step."""
        self._running: NDArray[np.bool_] | None = None
        self._lap: NDArray[np.int64] | None = None

    def __call__(self, race: Race, protocol: RaceProtocol, acted: TensorDict) -> None:
        """Record one control step of the trials that were running in it."""
        if self._running is None or self._lap is None:
            self._running, self._lap = np.ones(race.n_cars, bool), np.zeros(race.n_cars, np.int64)
        self._steps.append(race.trace[self._running].copy())
        self._laps.append(self._lap[self._running])
        self._running = protocol.running.copy()
        self._lap = np.bincount([lap.trial for lap in protocol.attempts], minlength=race.n_cars)

    def write(self, folder: Path, evaluator: Evaluator) -> list[Path]:
        """Write a trace of each track and condition, and return the files.

        Args:
            folder: new or empty; it gets a folder for each of them, unless there is only one.
            evaluator: whose race was recorded.

        Raises:
            RunFailed: a file cannot be written.
        """
        packed, laps = np.concatenate(self._steps), np.concatenate(self._laps)
        order = np.lexsort((packed[:, PACKED["steps"]], packed[:, PACKED["car"]]))
        packed, laps = packed[order], laps[order]
        groups, files = evaluator.groups, list[Path]()
        tracks = {track for track, _ in groups}
        with writing(folder, failure=RunFailed):
            for (track, condition), trials in groups.items():
                name = f"{track}-{condition}" if len(tracks) > 1 else condition
                of_group = folder / re.sub(r"[^\w.-]", "_", name) if len(groups) > 1 else folder
                here = np.isin(packed[:, PACKED["car"]], trials)
                files += self._write(of_group, evaluator.race, packed[here], laps[here])
        return files

    def _write(
        self, folder: Path, race: Race, packed: NDArray[np.float64], laps: NDArray[np.int64]
    ) -> list[Path]:
        """Write the trace of some trials, by trial and step; among others also `placement.placements_table`."""
        rows, extra = packed[:, : len(PACKED)], packed[:, len(PACKED) :]
        trial = rows[:, PACKED["car"]].astype(np.int64)
        begins = (np.diff(trial, prepend=-1) != 0) | (np.diff(laps, prepend=-1) != 0)
        rows[:, PACKED["episode"]] = np.cumsum(begins) - 1
        period_s = race.setup.car.control_period_s
        table = to_table(rows, 0, [course.name for course in race.setup.courses]).to_pandas()
        table["pause_duration"] = pauses_left_s(
            rows[:, PACKED["episode_status"]], rows[:, PACKED["car"]], self._penalty_s, period_s
        )
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / "evaluation-simtrace" / "0-iteration.csv"]
        write_trace(table, files[0])
        if extra.shape[1]:
            assert race.setup.others is not None
            rows[:, PACKED["episode"]] = trial
            placed = placements_table(race.setup, rows, extra)
            # The others of a trial are those of each of its laps.
            of_laps = placed.take(np.searchsorted(np.unique(trial), trial[begins]))
            numbered = of_laps.set_column(
                0, placed.schema.field(0), pa.array(np.arange(begins.sum()), pa.int32())
            )
            files.append(write_evaluation_others(folder, numbered, race.setup.others, period_s))
        return files


def pauses_left_s(
    status: NDArray[np.float64],
    episode: NDArray[np.float64],
    penalty_s: Mapping[str, float],
    period_s: float,
) -> NDArray[np.float64]:
    """Return the remaining seconds of the penalty at each row, (n,); 0 where the car serves none.

    The row in which a car has left the road or crashed has the whole penalty, as on the service, and the rows in which
    it is held have what is left of it.

    Args:
        status: codes of `env.trace_columns.STATUS_CODE`, (n,), by episode and step.
        episode: of each row, (n,).
        penalty_s: by status.
        period_s: simulated seconds of a control step.
    """
    pause = status == STATUS_CODE["pause"]
    left = np.zeros(len(status))
    for row in np.flatnonzero(pause).tolist():
        if row and episode[row - 1] == episode[row]:
            if not pause[row - 1]:
                left[row - 1] = penalty_s[EPISODE_STATUS[int(status[row - 1])]]
            left[row] = max(left[row - 1] - period_s, 0.0)
    return left
