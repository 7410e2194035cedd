"""Boxes and bots for the validation of a reward function: their places and params."""

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.config.racing import ALONE, BoxPosition
from deepracer_exp.env.others.boxes_and_bots import Others
from deepracer_exp.env.others.placement import Placement, draw_placements
from deepracer_exp.env.others.race_others import RaceOthers
from deepracer_exp.env.others.service_draws import episode_seeds
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose
from deepracer_exp.env.rules import RaceRules, StepResult
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.rewards.params import OBJECT_COLUMNS
from deepracer_exp.sim.scenery import box_corners
from deepracer_exp.tracks.lanes import Lanes
from deepracer_exp.tracks.track import Tracks

Quirks = Literal["fixed", "service"]
Floats = NDArray[np.float64]

EXAMPLE = replace(
    ALONE,
    boxes=replace(
        ALONE.boxes,
        placement="fixed",
        positions=(BoxPosition(lap=0.3, lane="inner"), BoxPosition(lap=0.6, lane="outer")),
    ),
    bots=replace(ALONE.bots, number=1),
)
"""The others for a reward function that reads their params, where the race has none."""
_APART_M = 0.6
"""Along the lap, between others that are out of the way."""


def with_others(setup: RaceSetup) -> RaceSetup:
    """Return the race with others if it has some or its reward function reads their params; a rival counts as a bot."""
    race = setup.others
    if race is not None and race.rivals is not None:
        race = replace(race, bots=replace(race.bots, number=1), rivals=None)
    text = setup.reward.text
    if race is None and any(f"'{key}'" in text or f'"{key}"' in text for key in OBJECT_COLUMNS):
        race = EXAMPLE if setup.track.closed else replace(EXAMPLE, bots=ALONE.bots)
    return replace(setup, others=race)


def first_placement(setup: RaceSetup) -> Placement:
    """Return the placement of a race's others in the first episode of its first car."""
    assert setup.others is not None
    episode = np.zeros(1, np.int64)
    seeds = episode_seeds(CarStreams(setup.seed, [0], Purpose.OTHERS).keys, episode)
    places_m, lanes = draw_placements(setup.others, np.array([setup.track.length_m]), episode, seeds)
    return Placement(places_m[0], lanes[0], int(seeds[0]))


def all_at(
    setup: RaceSetup, away_m: float, lane: int = 0, other: int | None = None, at_m: float = 0.0
) -> Placement:
    """Return a placement with all others out of the way, `away_m` along the lap, but one, which is `at_m` in `lane`."""
    assert setup.others is not None
    count = setup.others.boxes.count + setup.others.bots.count
    places_m = away_m + _APART_M * np.arange(count)
    lanes = np.arange(count) % 2
    if other is not None:
        places_m[other], lanes[other] = at_m, lane
    return Placement(np.mod(places_m, setup.track.length_m), lanes, 0)


def object_columns(
    setup: RaceSetup, rules: RaceRules, result: StepResult, placement: Placement, quirks: Quirks | None = None
) -> dict[str, np.ndarray]:
    """Return the columns `params.OBJECT_COLUMNS` and the mask of n cars among the others of one placement.

    Args:
        setup: of a race with others.
        rules: of the cars.
        result: of their step.
        placement: of the others of all cars.
        quirks: whose params; None: the race's.
    """
    assert setup.others is not None
    race = replace(setup.others, quirks=quirks) if quirks is not None else setup.others
    others = RaceOthers(race, setup, rules)
    n = rules.n_cars
    others.others.place(
        np.arange(n),
        rules.track_index,
        np.tile(placement.places_m, (n, 1)),
        np.tile(placement.lanes, (n, 1)),
        np.full(n, placement.seed, np.uint64),
    )
    # At the beginning of the episode: later the bots would have driven on from where they are placed.
    _, columns = others.judge(result, np.zeros(n))
    return columns


def free_road(
    setup: RaceSetup, rules: RaceRules, result: StepResult, others: RaceOthers
) -> dict[str, np.ndarray]:
    """Return the same columns where the others of each car are half a lap away from it; `others` are of these cars."""
    assert setup.others is not None
    n, length_m = rules.n_cars, setup.track.length_m
    far = all_at(setup, 0.5 * length_m)
    places_m = np.mod(result.now.ndist[:, None] * length_m + far.places_m, length_m)
    others.others.place(
        np.arange(n), rules.track_index, places_m, np.tile(far.lanes, (n, 1)), np.zeros(n, np.uint64)
    )
    _, columns = others.judge(result)
    return columns


def object_outlines(setup: RaceSetup) -> Floats:
    """Return the corners of the others' crash rectangles in the first placement, (K, 4, 2)."""
    if setup.others is None:
        return np.zeros((0, 4, 2))
    tracks = [setup.track]
    others, placement = Others(setup.others, Lanes(tracks), Tracks(tracks), 1), first_placement(setup)
    seed = np.array([placement.seed], np.uint64)
    others.place(
        np.zeros(1, np.intp), np.zeros(1, np.intp), placement.places_m[None], placement.lanes[None], seed
    )
    corners: Floats = box_corners(np.concatenate([others.poses[0], 2 * others.half_m], axis=1)).astype(
        np.float64
    )
    return corners


QUIRKS = {
    "objects_heading": "documented in degrees and 0 for boxes, it comes in radians, of boxes too where there are bots",
    "objects_speed": "documented as 0 for boxes, it is the bots' speed for all, also while they stand",
    "object_in_camera": "documented for the next object, it is that of the one before it, and hardly ever true",
}
"""Params in which the service deviates from its documentation."""
