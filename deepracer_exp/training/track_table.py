"""The small table of the tracks under the live view, where a run has several."""

import math
from collections.abc import Mapping, Sequence

from rich.text import Text

from deepracer_exp.tracking.names import track_metric

NOTHING = "\N{EN DASH}"
_GAP = 2
_CELL = 22  # columns of a track's figures, at least: 18 tracks in three columns of a terminal of 80
_FIGURES = (4, 7)  # columns of per cent and lap time in it


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
        """Take what an iteration's row tells of the tracks."""
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
        columns = max(1, (width + _GAP) // (_CELL + _GAP))
        cell = (width + _GAP) // columns - _GAP
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
        return [Text(" " * _GAP).join(row) for row in grid]

    def _track(self, label: str, cell: int) -> str:
        done, best_s = self._completion.get(label), self._best_s.get(label)
        done_text = NOTHING if done is None else f"{done:.0f}"
        return _columns(label, done_text, NOTHING if best_s is None else f"{best_s:.2f}", cell)


def _columns(name: str, done: str, best: str, cell: int) -> str:
    """Set a name to the left and figures to the right; a long name gives up its middle, since both ends tell."""
    done_room, best_room = _FIGURES
    room = cell - done_room - best_room
    if len(name) > room:
        name = f"{name[: room // 2]}…{name[len(name) - (room - 1) // 2 :]}"
    return f"{name:<{room}}{done:>{done_room}}{best:>{best_room}}"
