"""Boxes, bots and rival of an episode: drawn at random, recorded beside the trace, and replayed from there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from deepracer_exp.config.racing import LANES, RaceConfig
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.trace_columns import OTHERS_PACKED, PACKED
from deepracer_exp.sim.scenery import box_corners
from deepracer_exp.tracks.lanes import Lanes
from deepracer_exp.tracks.track import Track, Tracks

from .boxes_and_bots import BOX_M, Others
from .service_draws import episode_seeds, place

Floats = NDArray[np.float64]

_RIVAL = ("rival_x_m", "rival_y_m", "rival_yaw_deg")
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
    ("first_step", pa.int32(), "control step of the episode's first row in this iteration"),
    (
        "rival_x_m",
        pa.list_(pa.float32()),
        "m, origin of the rival at each of its rows; empty without a rival",
    ),
    ("rival_y_m", pa.list_(pa.float32()), "m, of the same"),
    ("rival_yaw_deg", pa.list_(pa.float32()), "degrees, of the same"),
)
SCHEMA = pa.schema([pa.field(name, kind, metadata={"unit": unit}) for name, kind, unit in _COLUMNS])
"""One row for each episode that drove in an iteration."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The others of an episode; arrays are (K,), boxes first and without a rival."""

    places_m: Floats
    """Distances from the start line along the centre line, at the begin."""
    lanes: NDArray[np.int64]
    seed: int
    """Decides when bots change lanes."""
    stopped_at_s: Floats = field(default_factory=lambda: np.zeros(0))
    """Times since the reset at which all bots stopped, because one had hit the car."""
    rival: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """x and y of the rival's origin in metres and its yaw in radians at each control step from the first, (T, 3); NaN
    where they are not recorded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedOthers:
    """The others of the episodes of a recording."""

    race: RaceConfig
    episodes: Mapping[bool, Mapping[int, Placement]]
    """Placements by direction (whether the track is driven reversed) and episode number."""
    period_s: float
    """Simulated seconds of a control step."""

    def on(self, track: Track) -> Mapping[int, Placement]:
        """Return the episodes on a track in its direction, by their numbers."""
        return self.episodes.get(track.reversed, {})


def draw_placements(
    race: RaceConfig, length_m: Floats, episode: NDArray[np.int64], seeds: NDArray[np.uint64]
) -> tuple[Floats, NDArray[np.int64]]:
    """Draw where the others of episodes are: distances from the start line along the lap, and lanes, (n, K) each.

    Args:
        race: how many there are, and how they are placed.
        length_m: of the centre lines, (n,).
        episode: their numbers among those of their cars, from 0, (n,).
        seeds: of the episodes, (n,); see `env.others.service_draws.episode_seeds`.
    """
    boxes, bots = race.boxes, race.bots
    places_m = np.empty((len(seeds), boxes.count + bots.count))
    lanes = np.empty(places_m.shape, np.int64)
    of_boxes, of_bots = np.s_[:, : boxes.count], np.s_[:, boxes.count :]
    if boxes.placement == "fixed":
        places_m[of_boxes] = np.array([position.lap for position in boxes.positions]) * length_m[:, None]
        lanes[of_boxes] = [LANES.index(position.lane) for position in boxes.positions]
    elif boxes.count:
        least_m = _least_m(race, length_m, episode)
        place(seeds, 0, boxes.placement == "random", (least_m, length_m), places_m[of_boxes], lanes[of_boxes])
    if bots.count:
        least_m = np.full(len(seeds), bots.min_distance_m)
        random = bots.placement == "random"
        place(seeds, boxes.count, random, (least_m, length_m), places_m[of_bots], lanes[of_bots])
    return places_m, lanes


def placements_table(setup: RaceSetup, rows: NDArray[np.float64], extra: NDArray[np.float64]) -> pa.Table:
    """Return the table of a batch's boxes, bots and rivals, with the columns of `SCHEMA`.

    Placements are drawn again from the streams of their cars, as in the processes that drove them.

    Args:
        setup: of the race, which has others.
        rows: the packed trace by episode and step, (n, len(PACKED)).
        extra: the columns `trace.OTHERS_PACKED` of the same rows, and against a rival `RIVAL_PACKED`, (n, C).
    """
    assert setup.others is not None
    number = rows[:, PACKED["episode"]].astype(np.int64)
    first = np.flatnonzero(np.diff(number, prepend=-1) != 0)
    cars, episode = rows[first, PACKED["car"]].astype(np.int64), extra[first, 0].astype(np.int64)
    keys = np.array([_key(setup.seed, car) for car in cars.tolist()], np.uint64)
    seeds = episode_seeds(keys, episode)
    # A car stays on its course, whose directions alternate.
    turns = np.array([len(course.tracks) for course in setup.courses])
    course = rows[first, PACKED["track"]].astype(np.int64)
    track = (np.cumsum(turns) - turns)[course] + episode % turns[course]
    tracks = [track for course in setup.courses for track in course.tracks]
    lengths_m = np.array([track.length_m for track in tracks])[track]
    places_m, lanes = draw_placements(setup.others, lengths_m, episode, seeds)
    stopped = np.flatnonzero(extra[:, 1])
    steps = rows[:, PACKED["steps"]]
    ends = np.append(first, len(rows))
    rival = extra[:, len(OTHERS_PACKED) :] if extra.shape[1] > len(OTHERS_PACKED) else np.zeros((0, 3))
    each = np.arange(len(first) + 1) * places_m.shape[1]
    columns = [
        *(number[first], cars, np.array([track.reversed for track in tracks])[track]),
        *(_lists(each, places_m.ravel()), _lists(each, lanes.ravel()), seeds),
        _lists(np.searchsorted(stopped, ends), lap_clock_s(steps[stopped], setup.car.control_period_s)),
        steps[first],
        *(
            _lists(np.minimum(ends, len(rival)), values)
            for values in (*rival[:, :2].T, np.degrees(rival[:, 2]))
        ),
    ]
    return pa.Table.from_arrays(
        [
            (pa.array(column) if isinstance(column, np.ndarray) else column).cast(declared.type)
            for column, declared in zip(columns, SCHEMA, strict=True)
        ],
        schema=SCHEMA,
    )


def read_placements(table: pa.Table) -> dict[bool, dict[int, Placement]]:
    """Return the placements of each episode from tables in the order of iterations.

    The keys are whether the track is driven reversed, and the episode's number.
    """
    by_way: dict[bool, dict[int, Placement]] = {False: {}, True: {}}
    paths = zip(*(_parts(table[name]) for name in _RIVAL), strict=True)
    plain = table.drop_columns([*_RIVAL]).to_pylist()
    for row, path in zip(plain, paths, strict=True):
        episodes = by_way[row["reversed"]]
        rival = np.column_stack(path).astype(np.float64)
        rival[:, 2] = np.radians(rival[:, 2])
        before = episodes.get(row["episode"])
        if before is None:
            drawn = np.array(row["places_m"], np.float64), np.array(row["lanes"], np.int64)
            before = Placement(*drawn, row["seed"])
        stopped_at_s = np.append(before.stopped_at_s, row["bots_stopped_at_s"])
        if len(rival):
            # Files of the episode's earlier rows may have been removed.
            missing = max(row["first_step"] - 1 - len(before.rival), 0)
            rival = np.concatenate([before.rival, np.full((missing, 3), np.nan), rival])
        else:
            rival = before.rival
        episodes[row["episode"]] = Placement(before.places_m, before.lanes, before.seed, stopped_at_s, rival)
    return by_way


@lru_cache(maxsize=10_000)
def _key(seed: int, car: int) -> int:
    """Return the key of a car's stream; a stream takes longer to set up than anything else here."""
    return int(CarStreams(seed, [car], Purpose.OTHERS).keys[0])


def _lists(offsets: NDArray[np.intp], values: NDArray) -> pa.Array:
    return pa.ListArray.from_arrays(pa.array(offsets.astype(np.int32)), pa.array(values))


def _parts(column: pa.ChunkedArray) -> list[NDArray[np.float32]]:
    """Return the entries of a column of lists."""
    whole = column.combine_chunks()
    values = whole.flatten().to_numpy(zero_copy_only=False)
    lengths = whole.value_lengths().to_numpy(zero_copy_only=False)
    return np.split(values, np.cumsum(lengths)[:-1]) if len(lengths) else []


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
    placements: Sequence[Placement],
    period_s: float,
    episode: NDArray[np.intp],
    step: NDArray[np.int64],
) -> tuple[Floats, Floats]:
    """Return the others at rows of a trace: poses (n, K, 3) and distances along the lap in metres, (n, K).

    Bots are driven again by the code that drove them; a rival is where it was recorded, or NaN. A row has the pose of
    the car at a control step and, of the others, the poses of the same time; crashes and params of that step used the
    bots' poses of the step before, as on the service.

    Args:
        race: with the boxes and bots around the car.
        track: in the direction driven.
        placements: of each episode.
        period_s: simulated seconds of a control step.
        episode: of each row, the index in `placements`, (n,).
        step: of each row, (n,), the prepare step being 1.
    """
    others = Others(race, Lanes([track]), Tracks([track]), len(placements))
    everyone, track_index = np.arange(len(placements)), np.zeros(len(placements), np.intp)
    others.place(
        everyone,
        track_index,
        np.stack([drawn.places_m for drawn in placements]),
        np.stack([drawn.lanes for drawn in placements]),
        np.array([drawn.seed for drawn in placements], np.uint64),
    )
    if not race.bots.count:
        poses, distance_m = others.poses[episode], others.distance_m[episode]
        if race.rivals is not None:
            poses[:, -1] = _rival_poses(placements, episode, step)
            recorded = np.isfinite(poses[:, -1, 0])
            distance_m[:, -1] = np.nan
            distance_m[recorded, -1] = track.project(poses[recorded, -1, :2]).distance_m
        return poses, distance_m
    stops = np.zeros((len(placements), int(step.max(initial=0)) + 1), bool)
    for number, drawn in enumerate(placements):
        steps = np.round(drawn.stopped_at_s / period_s).astype(np.int64)
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


def _rival_poses(
    placements: Sequence[Placement], episode: NDArray[np.intp], step: NDArray[np.int64]
) -> Floats:
    """Return the recorded poses of rivals at rows, (n, 3); the last is NaN, which stands for all that are not there."""
    lengths = np.array([len(drawn.rival) for drawn in placements])
    recorded = np.concatenate([*(drawn.rival for drawn in placements), np.full((1, 3), np.nan)])
    row = (np.cumsum(lengths) - lengths)[episode] + step - 1
    rival: Floats = recorded[np.where(step <= lengths[episode], row, -1)]
    return rival


def _least_m(race: RaceConfig, length_m: Floats, episode: NDArray[np.int64]) -> Floats:
    """Return the least distances between boxes in episodes, (n,).

    The service reads its distance as per cent of the lap, and scales its own result again at every placement, of which
    there is one more than episodes (deepracer-simapp, agent_ctrl/obstacles_agent_ctrl.py).
    """
    least = race.boxes.min_distance_m
    if race.quirks == "fixed":
        return np.full(len(length_m), least)
    return np.minimum(least * (length_m / 100) ** (episode + 2), length_m)
