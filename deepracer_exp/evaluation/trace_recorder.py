"""The control steps of an evaluation in the service's format, with the places of boxes, bots and rivals."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from deepracer_exp.aws.logs.sim_trace import write_trace
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.others.placement import placements_table
from deepracer_exp.env.race import Race
from deepracer_exp.env.trace_columns import EPISODE_STATUS, PACKED, STATUS_CODE, to_table
from deepracer_exp.errors import RunFailed, writing
from deepracer_exp.runs.trace import write_evaluation_others

from .race_protocol import RaceProtocol


class TraceRecorder:
    """Records the control steps of all trials; each trial is an episode."""

    def __init__(self, config: EvaluationConfig) -> None:
        """Start empty; `config` is the protocol."""
        self._penalty_s = vars(config.penalty_s)
        self._steps: list[NDArray[np.float64]] = []
        self._running: NDArray[np.bool_] | None = None

    def __call__(self, race: Race, protocol: RaceProtocol, acted: TensorDict) -> None:
        """Record one control step of the trials that were running in it."""
        running = np.ones(race.n_cars, bool) if self._running is None else self._running
        row = race.trace[running].copy()
        row[:, PACKED["episode"]] = row[:, PACKED["car"]]
        self._steps.append(row)
        self._running = protocol.running.copy()

    def write(self, folder: Path, race: Race) -> list[Path]:
        """Write the trace, among others also `placement.placements_table`, and return the files.

        Args:
            folder: new or empty.
            race: that was recorded.

        Raises:
            RunFailed: a file cannot be written.
        """
        packed = np.concatenate(self._steps)
        packed = packed[np.lexsort((packed[:, PACKED["steps"]], packed[:, PACKED["episode"]]))]
        rows, extra = packed[:, : len(PACKED)], packed[:, len(PACKED) :]
        names = [course.name for course in race.setup.courses]
        table = to_table(rows, 0, names).to_pandas()
        period_s = race.setup.car.control_period_s
        table["pause_duration"] = pauses_left_s(
            rows[:, PACKED["episode_status"]], rows[:, PACKED["episode"]], self._penalty_s, period_s
        )
        with writing(folder, failure=RunFailed):
            folder.mkdir(parents=True, exist_ok=True)
            files = [folder / "evaluation-simtrace" / "0-iteration.csv"]
            write_trace(table, files[0])
            if extra.shape[1]:
                assert race.setup.others is not None
                placed = placements_table(race.setup, rows, extra)
                files.append(write_evaluation_others(folder, placed, race.setup.others, period_s))
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
