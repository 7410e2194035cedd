"""The placement of boxes and bots in an episode: drawn, written beside the trace, and their poses rebuilt from it."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from deepracer_exp.config.race import LANES, RaceConfig
from deepracer_exp.sim.collisions import BOX_M
from deepracer_exp.sim.others import Others
from deepracer_exp.sim.placement import episode_seeds, place
from deepracer_exp.sim.scenery import box_corners
from deepracer_exp.tracks.lanes import Lanes
from deepracer_exp.tracks.track import Track, Tracks

from .randomization import CarStreams, Purpose
from .rules import lap_clock_s
from .setup import RaceSetup
from .trace import PACKED

Floats = NDArray[np.float64]

_COLUMNS: tuple[tuple[str, pa.DataType, str], ...] = (
    ("episode", pa.int32(), "number of the episode in the trace"),
    ("car", pa.int32(), "number of the car over all processes"),
    ("reversed", pa.bool_(), "the track is driven against its published direction"),
    (
        "places_m",
        pa.list_(pa.float64()),
        "m from the start line along the centre line, of each box and then each bot",
    ),
    (
        "lanes",
        pa.list_(pa.int8()),
        " ".join(f"{number}={name}" for number, name in enumerate(LANES)) + ", of each",
    ),
    ("seed", pa.uint64(), "decides when bots change lanes"),
    (
        "bots_stopped_at_s",
        pa.list_(pa.float64()),
        "s since the reset: all bots stopped in these rows of the trace",
    ),
)
SCHEMA = pa.schema([pa.field(name, kind, metadata={"unit": unit}) for name, kind, unit in _COLUMNS])
"""One row for each episode that drove in an iteration."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the others of an episode are at its begin; arrays are (K,), boxes first."""

    places_m: Floats
    """Distances from the start line along the centre line."""
    lanes: NDArray[np.int64]
    seed: int
    """Decides when bots change lanes."""


def draw_placements(
    race: RaceConfig, length_m: Floats, episode: NDArray[np.int64], seeds: NDArray[np.uint64]
) -> tuple[Floats, NDArray[np.int64]]:
    """Draw where the others of episodes are: distances from the start line along the lap, and lanes, (n, K) each.

    Args:
        race: how many there are, and how they are placed.
        length_m: of the centre lines, (n,).
        episode: their numbers among those of their cars, from 0, (n,).
        seeds: of the episodes, (n,); see `sim.placement.episode_seeds`.
    """
    boxes, bots = race.boxes, race.bots
    places_m = np.empty((len(seeds), boxes.count + bots.count))
    lanes = np.empty(places_m.shape, np.int64)
    of_boxes, of_bots = np.s_[:, : boxes.count], np.s_[:, boxes.count :]
    if boxes.placement == "fixed":
        places_m[of_boxes] = np.array([position.lap for position in boxes.positions]) * length_m[:, None]
        lanes[of_boxes] = [LANES.index(position.lane) for position in boxes.positions]
    else:
        least_m = _least_m(race, length_m, episode)
        place(seeds, 0, boxes.placement == "random", least_m, length_m, places_m[of_boxes], lanes[of_boxes])
    least_m = np.full(len(seeds), bots.min_distance_m)
    random = bots.placement == "random"
    place(seeds, boxes.count, random, least_m, length_m, places_m[of_bots], lanes[of_bots])
    return places_m, lanes


def placements_table(setup: RaceSetup, rows: NDArray[np.float64], extra: NDArray[np.float64]) -> pa.Table:
    """Return what is written of the others of a batch, with the columns of `SCHEMA`.

    Placements are drawn again from the streams of their cars, as in the processes that drove them.

    Args:
        setup: of the race, which has boxes or bots.
        rows: the packed trace by episode and step, (n, len(PACKED)).
        extra: the columns `trace.OTHERS_PACKED` of the same rows, (n, 2).
    """
    assert setup.others is not None
    number = rows[:, PACKED["episode"]].astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1) != 0)
    cars, index = np.unique(rows[first, PACKED["car"]].astype(np.int64), return_inverse=True)
    episode = extra[first, 0].astype(np.int64)
    seeds = episode_seeds(CarStreams(setup.seed, cars.tolist(), Purpose.OTHERS).keys[index], episode)
    courses = [setup.courses[course] for course in rows[first, PACKED["track"]].astype(np.int64).tolist()]
    # A car stays on its course, whose directions alternate.
    tracks = [
        course.tracks[count % len(course.tracks)]
        for course, count in zip(courses, episode.tolist(), strict=True)
    ]
    lengths_m = np.array([track.length_m for track in tracks])
    places_m, lanes = draw_placements(setup.others, lengths_m, episode, seeds)
    written = []
    for drawn, (row, last) in enumerate(itertools.pairwise([*first.tolist(), len(rows)])):
        stopped = row + np.flatnonzero(extra[row:last, 1])
        clock_s = lap_clock_s(rows[stopped, PACKED["steps"]], setup.car.control_period_s)
        values = (
            *(int(number[row]), int(cars[index[drawn]]), tracks[drawn].reversed, places_m[drawn].tolist()),
            *(lanes[drawn].tolist(), int(seeds[drawn]), clock_s.tolist()),
        )
        written.append(dict(zip(SCHEMA.names, values, strict=True)))
    return pa.Table.from_pylist(written, schema=SCHEMA)


def read_placements(table: pa.Table) -> dict[bool, dict[int, tuple[Placement, Floats]]]:
    """Return the placement of each episode of written tables, and when all bots stopped, s since the reset.

    The keys are whether the track is driven reversed, and the episode's number.
    """
    by_way: dict[bool, dict[int, tuple[Placement, Floats]]] = {False: {}, True: {}}
    for row in table.to_pylist():
        episodes = by_way[row["reversed"]]
        drawn, stopped_at_s = episodes.get(row["episode"], (None, np.zeros(0)))
        if drawn is None:
            drawn = Placement(np.array(row["places_m"]), np.array(row["lanes"], np.int64), row["seed"])
        episodes[row["episode"]] = drawn, np.append(stopped_at_s, row["bots_stopped_at_s"])
    return by_way


def box_corners_of(race: RaceConfig, track: Track, drawn: Placement) -> Floats:
    """Return the corners of the boxes of an episode, by the rectangle in which a corner of a car crashes, (k, 4, 2)."""
    count = race.boxes.count
    points = track.points_at(drawn.places_m[:count] / track.length_m)
    pose = Lanes([track]).poses(points, drawn.lanes[:count], np.zeros(count, np.intp))
    corners: Floats = box_corners(np.column_stack([*pose, *np.tile(BOX_M, (count, 1)).T])).astype(np.float64)
    return corners


def rebuild_poses(
    race: RaceConfig,
    track: Track,
    placements: Sequence[tuple[Placement, Floats]],
    period_s: float,
    episode: NDArray[np.intp],
    step: NDArray[np.int64],
) -> tuple[Floats, Floats]:
    """Return where the others were at rows of a trace: poses (n, K, 3) and distances along the lap in metres, (n, K).

    They are driven again by the code that drove them. A row has the pose of the car at a control step and, of bots, the
    poses of the same time; crashes and params of that step used the bots' poses of the step before, as on the service.

    Args:
        race: among whom the car drove.
        track: on which, in its direction.
        placements: of each episode, with the times since its reset at which all bots stopped.
        period_s: simulated seconds of a control step.
        episode: of each row, the index in `placements`, (n,).
        step: of each row, (n,), the prepare step being 1.
    """
    others = Others(race, Lanes([track]), Tracks([track]), len(placements))
    everyone, track_index = np.arange(len(placements)), np.zeros(len(placements), np.intp)
    others.place(
        everyone,
        track_index,
        np.stack([drawn.places_m for drawn, _ in placements]),
        np.stack([drawn.lanes for drawn, _ in placements]),
        np.array([drawn.seed for drawn, _ in placements], np.uint64),
    )
    stops = np.zeros((len(placements), int(step.max(initial=0)) + 1), bool)
    for number, (_, stopped_at_s) in enumerate(placements):
        steps = np.round(stopped_at_s / period_s).astype(np.int64)
        stops[number, steps[steps < stops.shape[1]]] = True
    poses, distance_m = np.empty((len(step), race.others, 3)), np.empty((len(step), race.others))
    order = np.argsort(step, kind="stable")
    bounds = np.searchsorted(step[order], np.arange(stops.shape[1] + 1))
    for now in range(1, stops.shape[1]):
        time_s = np.full(len(placements), lap_clock_s(now, period_s))
        others.drive(track_index, time_s, np.full(len(placements), now > 1))
        others.pause(stops[:, now], time_s)
        here = order[bounds[now] : bounds[now + 1]]
        poses[here], distance_m[here] = others.poses[episode[here]], others.distance_m[episode[here]]
    return poses, distance_m


def _least_m(race: RaceConfig, length_m: Floats, episode: NDArray[np.int64]) -> Floats:
    """Return the least distances between boxes in episodes, (n,).

    The service takes its number for per cent of the lap, and applies that to its own result at every placement, of
    which there is one more than episodes (deepracer-simapp, agent_ctrl/obstacles_agent_ctrl.py).
    """
    least = race.boxes.min_distance_m
    if race.quirks == "fixed":
        return np.full(len(length_m), least)
    return np.minimum(least * (length_m / 100) ** (episode + 2), length_m)
