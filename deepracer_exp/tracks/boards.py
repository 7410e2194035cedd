"""The official leaderboards of the service's time trials, and the rank of a lap on them.

`boards.csv` has the boards since March 2020, when the service's commands were limited to 4 m/s as they are today. Times
before that do not compare.
"""

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from deepracer_exp.config.custom_files.model_files import CARS

FILE = Path(__file__).with_name("boards.csv")
_VERSION_5_SINCE = "2022-07-21"
"""Day of the first known models with simulation version 5; models raced on 3 July 2022 still state version 4."""
_VERSION_4_SINCE = "2020-10"
"""Models of August and September 2020 state version 3; the date of version 4 is not known."""
_ORDER = {"TOTAL_TIME": "total of", "AVG_LAP_TIME": "average of", "BEST_LAP_TIME": "best of"}


@dataclass(frozen=True, kw_only=True)
class Board:
    """A final leaderboard; its times are seconds a lap, with the penalties of the laps in them."""

    world: str
    date: str
    """When the race began."""
    board: str
    """Name of the race."""
    racers: int
    timing: Literal["TOTAL_TIME", "AVG_LAP_TIME", "BEST_LAP_TIME"]
    """Measure of the laps that counted: their total, their average, or the best of them."""
    laps: int
    """Laps that counted."""
    off_track_penalty_s: float | None
    """Added each time a car left the track; None: not known."""
    record_s: float
    """The fastest single lap."""
    winner_s: float
    first_1_percent_s: float
    """Lap time of the last racer among the first 1 %; the next two are those of 10 % and 50 %."""
    first_10_percent_s: float
    half_s: float

    @property
    def is_of_version_3(self) -> bool:
        """Whether simulation version 3 drove then, of which there is no car."""
        return self.date < _VERSION_4_SINCE

    @property
    def car(self) -> str:
        """Return the option of the car that drove then; that of version 4 stands in for version 3."""
        return CARS[5 if self.date >= _VERSION_5_SINCE else 4]

    @property
    def terms(self) -> str:
        """Return the scoring in words."""
        return "best lap" if self.laps == 1 else f"{_ORDER[self.timing]} {self.laps} laps"

    def place(self, lap_s: float) -> str:
        """Return the rank of a time, as far as the board's figures determine it, to follow ``it would``."""
        if lap_s <= self.winner_s:
            return f"have won ({self.winner_s:.2f} s won)"
        if lap_s <= self.first_1_percent_s:
            return f"be among the first 1 % ({self.winner_s:.2f} s won)"
        if lap_s <= self.first_10_percent_s:
            ends = f"{self.first_1_percent_s:.2f} and {self.first_10_percent_s:.2f} s"
            return f"be between the first 1 and 10 % ({ends})"
        if lap_s <= self.half_s:
            return f"be between the first 10 and 50 % ({self.first_10_percent_s:.2f} and {self.half_s:.2f} s)"
        return f"be in the slower half ({self.half_s:.2f} s and more)"


@cache
def boards() -> tuple[Board, ...]:
    """Return all boards."""
    with FILE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return tuple(Board(**{name: _value(name, text) for name, text in row.items()}) for row in rows)


def _value(name: str, text: str) -> Any:
    if name in ("racers", "laps"):
        return int(text)
    return (float(text) if text else None) if name.endswith("_s") else text


def boards_of(world: str) -> tuple[Board, ...]:
    """Return the boards of a world, the oldest first.

    A world with the ending `_ccw` is that of the race, resampled; one with `_cw` is driven the other way.
    """
    return tuple(board for board in boards() if board.world == world.removesuffix("_ccw"))


@dataclass(frozen=True, kw_only=True)
class Standing:
    """The place of a policy's laps on a board, and their differences from the racers' laps."""

    board: Board
    lap_s: float
    """Mean of the complete laps, or the best of them where that counted and is known; penalties included."""
    is_best: bool
    """Whether the time is that of the best lap."""
    car: str
    """The car that drove."""
    sees: str
    """Sensors of the policy in words, after ``from``."""
    off_track: str | None
    """Cost of leaving the track in words, where it differs from the board's."""

    @property
    def is_comparable(self) -> bool:
        """Whether the car is that of the board's time, or the one that stands in for it."""
        return self.car == self.board.car

    @property
    def words(self) -> str:
        """Return the place as a sentence."""
        board = self.board
        lap = f"a best lap of {self.lap_s:.2f} s" if self.is_best else f"{self.lap_s:.2f} s a lap"
        differs = f"driven with {self.car} from {self.sees}, the board's racers "
        if board.is_of_version_3:
            differs += "with simulation version 3 "
        elif not self.is_comparable:
            differs += f"with {board.car} "
        differs += "from a camera"
        if self.off_track is not None:
            differs += f"; {self.off_track}"
        if not self.is_comparable:
            differs += f"; to compare, train with car={board.car}"
        if board.is_of_version_3:
            differs += f"; there is no car of version 3, and {board.car} stands in for it"
        place = f"{lap} would {board.place(self.lap_s)}"
        return f"{board.board} ({board.racers:,} racers, {board.terms}): {place}; {differs}"

    def as_dict(self) -> dict[str, Any]:
        """Return the place as JSON types."""
        return {
            **vars(self.board),
            "board_car": self.board.car,
            "lap_s": self.lap_s,
            "car": self.car,
            "sees": self.sees,
            "comparable": self.is_comparable,
            "words": self.words,
        }


def standings(
    world: str,
    *,
    mean_lap_s: float,
    best_lap_s: float | None,
    car: str,
    sees: str,
    off_track_penalty_s: float | None,
) -> list[Standing]:
    """Return the place of laps on each board of a world, driven in the order of its waypoints.

    Boards of the car's own time come first, and of these the one with most racers.

    Args:
        world: name of a world of the service.
        mean_lap_s: mean of the complete laps.
        best_lap_s: the fastest of them; None: not known, and the mean counts instead.
        car: name of the car.
        sees: the policy's sensors, such as `a camera` or `features`.
        off_track_penalty_s: penalty for leaving the track; None: it ended the lap.
    """
    places = []
    for board in boards_of(world):
        best_s = best_lap_s if board.timing == "BEST_LAP_TIME" else None
        there = board.off_track_penalty_s
        off_track = None
        if there is not None and there != off_track_penalty_s:
            here = "it ends a lap" if off_track_penalty_s is None else f"{off_track_penalty_s:g} s"
            off_track = f"leaving the track cost {there:g} s there, here {here}"
        places.append(
            Standing(
                board=board,
                lap_s=mean_lap_s if best_s is None else best_s,
                is_best=best_s is not None,
                car=car,
                sees=sees,
                off_track=off_track,
            )
        )
    return sorted(places, key=lambda standing: (not standing.is_comparable, -standing.board.racers))


def what_it_sees(camera: object, lidar: object) -> str:
    """Name a policy's sensors, by whether its observation has a camera and a LIDAR."""
    seen = [name for name, sensor in (("a camera", camera), ("a LIDAR", lidar)) if sensor is not None]
    return " and ".join(seen) or "features"
