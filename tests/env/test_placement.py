"""What is written of boxes and bots rebuilds the poses that they had."""

import numpy as np
import pyarrow as pa
import pytest
import torch

from deepracer_exp.env.others.head_to_head import HeadToHead, rival_setup
from deepracer_exp.env.others.placement import (
    SCHEMA,
    placements_table,
    read_placements,
    rebuild_poses,
)
from deepracer_exp.env.race import Race
from deepracer_exp.env.trace_columns import PACKED
from tests.env.conftest import make_setup, random_actions

STANDING = ("action_space=continuous", "action_space.speed.low=0", "episode.immobilized_steps=0")
SEES = "observation.next_objects=2"


@pytest.mark.parametrize(
    "overrides",
    [
        ("race=object_avoidance",),
        ("race=six_boxes",),
        ("race=head_to_bot", "race.boxes.number=2", "race.bots.placement=random", "race.bots.speed_mps=2"),
        ("race=head_to_bot", "race.boxes.number=2", "race.quirks=service", "track.direction=alternate"),
    ],
    ids=["random boxes", "fixed boxes", "both", "quirks, both directions"],
)
def test_every_pose_of_every_other_is_rebuilt_from_what_is_written(overrides):
    """Also where bots have hit the car and stopped, and over several episodes of a car."""
    hit = "race.bots.speed_mps=2" in overrides
    setup = make_setup("track=reInvent2019_track", *STANDING, SEES, *overrides)
    race = Race(setup, 6, first_car=3)
    race.reset()
    rows, poses, distances = [], [], []
    for action in random_actions(150, 6):
        # Cars that mostly stand are hit from behind.
        race.step(np.tile([0.0, -1.0], (6, 1)) if hit else action)
        rows.append(race.trace.copy())
        others = race.others.others
        poses.append(others.poses.copy())
        distances.append(others.distance_m.copy())
        ended = np.flatnonzero(race.terminated | race.truncated)
        if len(ended):
            race.reset(ended)
    packed, poses, distances = (np.concatenate(values) for values in (rows, poses, distances))
    order = np.lexsort([packed[:, PACKED[name]] for name in ("steps", "episode", "car")])
    packed, poses, distances = packed[order], poses[order], distances[order]
    begins = packed[:, PACKED["steps"]] == 1
    extra = packed[:, len(PACKED) :]
    trace = packed[:, : len(PACKED)].copy()
    trace[:, PACKED["episode"]] = np.cumsum(begins) - 1
    table = placements_table(setup, trace, extra)
    assert table.schema == SCHEMA
    assert len(table) == begins.sum() >= 6
    placed = read_placements(table)
    assert extra[:, 1].any() or not hit
    direction = np.array(table["reversed"])[trace[:, PACKED["episode"]].astype(int)]
    for track in setup.courses[0].tracks:
        here = direction == track.reversed
        number = trace[here, PACKED["episode"]].astype(np.intp)
        known = placed[track.reversed]
        own = np.unique(number)
        assert sorted(known) == own.tolist()
        rebuilt, distance_m = rebuild_poses(
            setup.others,
            track,
            [known[episode] for episode in own.tolist()],
            setup.car.control_period_s,
            np.searchsorted(own, number),
            trace[here, PACKED["steps"]].astype(np.int64),
        )
        np.testing.assert_array_equal(rebuilt, poses[here])
        np.testing.assert_array_equal(distance_m, distances[here])


def test_the_path_of_a_rival_is_kept_beside_the_boxes_over_two_iterations():
    sees = ("race=head_to_head", "race.boxes.number=3", SEES)
    setup = make_setup("track=reInvent2019_track", *STANDING, *sees)
    race = HeadToHead(setup, 4, rival_setup(setup, setup.observation))
    race.drive_with(
        [lambda seen: seen.set("action", torch.tensor([[0.1, 0.4]]).expand(*seen.batch_size, -1))]
    )
    race.reset()
    rows, poses = [], []
    for _ in range(30):
        poses.append(race.others.others.poses.copy())
        race.step(np.tile([0.0, -0.9], (4, 1)))
        rows.append(race.trace.copy())
    packed = np.array(rows)
    packed[:, :, PACKED["episode"]] = np.arange(4)
    parts = [some.swapaxes(0, 1).reshape(-1, packed.shape[-1]) for some in (packed[:12], packed[12:])]
    tables = [placements_table(setup, some[:, : len(PACKED)], some[:, len(PACKED) :]) for some in parts]
    placed = read_placements(pa.concat_tables(tables))[False]
    step = np.tile(np.arange(1, 31), 4)
    episode = np.repeat(np.arange(4), 30)
    period_s = setup.car.control_period_s
    drawn = [placed[number] for number in range(4)]
    rebuilt, distance_m = rebuild_poses(setup.others, setup.track, drawn, period_s, episode, step)
    np.testing.assert_allclose(rebuilt, np.array(poses).swapaxes(0, 1).reshape(-1, 4, 3), atol=1e-5)
    moved_m = np.diff(distance_m[episode == 0, -1])
    assert moved_m.max() > 0.02
    # Of an episode whose first file is gone, the rival's path begins with the second.
    late = read_placements(tables[1])[False]
    rebuilt, distance_m = rebuild_poses(
        setup.others, setup.track, [late[0]], period_s, np.zeros(30, int), step[:30]
    )
    assert np.isnan(rebuilt[:12, -1]).all()
    assert np.isnan(distance_m[:12, -1]).all()
    np.testing.assert_allclose(rebuilt[12:, -1], np.array(poses)[12:, 0, -1], atol=1e-5)
