import copy
import hashlib

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.others.boxes_and_bots import BOX_M
from deepracer_exp.env.others.race_others import NEAR_M, with_crashes
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import EPISODE_STATUS, PACKED, STATUS_CODE
from tests.conftest import refused
from tests.env.conftest import drive, make_setup, put, random_actions, spied

SEES = "observation.next_objects=2"
BOXES = ("race=object_avoidance", SEES)
BOTS = ("race=head_to_bot", SEES)
MIXED = ("race=head_to_bot", "race.boxes.number=3", "race.bots.placement=random", SEES)
ON = "track=reInvent2019_track"
STANDING = ("action_space=continuous", "action_space.speed.low=0", "episode.immobilized_steps=0")


def stop(race: Race, steps: int) -> list[str]:
    """Let all cars stand; return the status of the first at each step."""
    found = []
    for _ in range(steps):
        race.step(np.tile([0.0, -1.0], (race.n_cars, 1)))
        found.append(EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])])
    return found


def test_a_race_alone_has_the_bits_it_had_before_there_were_others():
    race = Race(make_setup("action_space=continuous", "reward=progress_delta"), 8)
    race.reset()
    trace = drive(race, random_actions(60, 8))
    # Rounded, and without signs of zero: processors may differ in the last bits.
    assert hashlib.sha256((np.round(trace, 6) + 0.0).tobytes()).hexdigest()[:16] == "54313f280a005b86"


@pytest.mark.parametrize("overrides", [BOXES, BOTS, MIXED], ids=["boxes", "bots", "mixed"])
def test_others_are_on_the_road_and_as_far_apart_as_configured(overrides):
    setup = make_setup(ON, *overrides)
    race = Race(setup, 40)
    for _ in range(5):
        race.reset()
        others, race_config = race.others.others, setup.others
        boxes = race_config.boxes.count
        assert setup.track.on_road(others.poses[..., :2].reshape(-1, 2)).all()
        for some, least_m in (
            (others.distance_m[:, :boxes], race_config.boxes.min_distance_m),
            (others.distance_m[:, boxes:], race_config.bots.min_distance_m),
        ):
            if some.shape[1] > 1:
                # Places are on the centre line, poses on lanes, whose projections differ by centimetres in bends.
                assert np.diff(np.sort(some, axis=1), axis=1).min() > least_m - 0.1


def test_random_boxes_stand_elsewhere_in_every_episode_and_alternating_ones_do_not():
    for placement, differs in (("random", True), ("alternating", False)):
        race = Race(make_setup(ON, *BOXES, f"race.boxes.placement={placement}"), 2)
        places = []
        for _ in range(3):
            race.reset()
            places.append(race.others.others.poses.copy())
        assert (not np.array_equal(places[0], places[1])) is differs
        assert (not np.array_equal(places[0][0], places[0][1])) is differs


def test_fixed_boxes_stand_where_they_are_configured(race_of):
    race = race_of(
        ON,
        *BOXES,
        "race.boxes.placement=fixed",
        "race.boxes.positions=[{lap: 0.25, lane: inner}, {lap: 0.5, lane: outer}]",
    )
    others, track = race.others.others, race.setup.track
    np.testing.assert_allclose(others.distance_m[0] / track.length_m, [0.25, 0.5], atol=0.005)
    inner_is_left = not track.is_clockwise
    assert (others.offset_m[0] > 0).tolist() == [inner_is_left, not inner_is_left]


def test_a_car_drives_into_a_box_and_its_episode_ends_as_crashed(race_of, spy):
    race = race_of(
        ON,
        *BOXES,
        "action_space=continuous",
        "race.boxes.placement=fixed",
        "race.boxes.positions=[{lap: 0.5, lane: inner}]",
        spy,
    )
    box = race.others.others.distance_m[0, 0]
    put(race, box - 0.5, float(race.others.others.offset_m[0, 0]))
    seen = []
    for _ in range(30):
        race.step(np.array([[0.0, 1.0]]))
        seen.append(EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])])
        if race.terminated[0]:
            break
    assert seen[-1] == "crashed"
    assert set(seen[:-1]) == {"prepare", "in_progress"}
    crashed = [params["is_crashed"] for params in spied(race)[0]]
    assert crashed == [False] * (len(crashed) - 1) + [True]


def test_only_a_corner_of_the_car_inside_the_box_counts(race_of):
    race = race_of(ON, *BOXES, "race.boxes.placement=fixed", "race.boxes.positions=[{lap: 0.5, lane: inner}]")
    others = race.others.others
    x, y, yaw = others.poses[0, 0]
    ahead = np.array([np.cos(yaw), np.sin(yaw)])

    def hit(along_m, left_m=0.0):
        at = np.array([x, y]) + along_m * ahead + left_m * np.array([-ahead[1], ahead[0]])
        return others.hit(at[:1], at[1:], np.array([yaw]))[0]

    limit_m = 0.5 * (BOX_M[0] + 0.32352)
    assert hit(-limit_m + 0.001) == 0
    assert hit(-limit_m - 0.001) == -1
    side_m = 0.5 * (BOX_M[1] + 0.1961)
    assert hit(0.0, side_m - 0.001) == 0
    assert hit(0.0, side_m + 0.001) == -1


def test_a_crash_takes_the_place_of_the_weaker_statuses_only():
    weaker = ["in_progress", "off_track", "immobilized", "reversed"]
    every = [*weaker, "prepare", "lap_complete", "time_up"]
    codes = np.array([STATUS_CODE[status] for status in every])
    yes, no = np.ones(len(codes), bool), np.zeros(len(codes), bool)
    assert [EPISODE_STATUS[c] for c in with_crashes(codes, yes, yes)] == ["crashed"] * 4 + every[4:]
    # Not at fault: what happened in that step does not count.
    assert [EPISODE_STATUS[c] for c in with_crashes(codes, yes, no)] == ["in_progress"] * 4 + every[4:]
    assert with_crashes(codes, no, no).tolist() == codes.tolist()


def test_bots_keep_their_distances_and_their_speed(race_of):
    race = race_of(ON, *BOTS, "race.bots.lane_change_after_s=null", *STANDING)
    others, length_m = race.others.others, race.setup.track.length_m
    put(race, 5.0, 2.5)  # out of their way: bots that hit a car stop
    stop(race, 2)
    first = others.distance_m.copy()
    stop(race, 150)
    driven_m = np.mod(others.distance_m - first, length_m)
    np.testing.assert_allclose(driven_m, 10 * 0.75, atol=0.15)


def test_bots_change_lanes_as_often_as_configured(race_of):
    race = race_of(ON, *BOTS, *STANDING, n_cars=20)
    put(race, 5.0, 2.5)  # out of their way: bots that hit a car stop
    stop(race, 15 * 20)
    # Each lane lasts 1 to 3 s, each change 1 m / 0.75 m/s.
    passed = race.others.others.changes
    assert passed.min() >= 20 / 4.34 - 1
    assert passed.max() <= 20 / 2.33 + 1
    assert abs(passed.mean() - 20 / 3.33) < 1
    away_m = np.abs(race.others.others.offset_m)
    assert (away_m < 0.3).all()


def test_a_bot_that_hits_the_car_from_behind_stops_all_bots_and_is_to_blame(race_of):
    race, resumed = (race_of(ON, *BOTS, "race.bots.lane_change_after_s=null", *STANDING) for _ in range(2))
    others = race.others.others
    stop(race, 3)
    bot_m, offset_m = float(others.distance_m[0, 2]), float(others.offset_m[0, 2])
    put(race, bot_m + 0.5, offset_m)
    statuses = stop(race, 15)
    assert "crashed" not in statuses
    assert others.pauses[0] == 1
    standing = others.poses.copy()
    resumed.load_state_dict(race.state_dict())
    for one in (race, resumed):
        stop(one, 10)
        np.testing.assert_array_equal(one.others.others.poses, standing)
    stop(race, 30)
    assert (others.poses != standing).any()


def test_a_car_hit_from_behind_as_its_time_is_up_has_not_crashed(race_of, spy):
    def hit(*more: str) -> Race:
        race = race_of(ON, *BOTS, spy, "race.bots.lane_change_after_s=null", *STANDING, *more)
        others = race.others.others
        stop(race, 3)
        put(race, float(others.distance_m[0, 2]) + 0.5, float(others.offset_m[0, 2]))
        while not others.pauses[0]:
            stop(race, 1)
        return race

    steps = int(hit().rules.steps[0])
    race = hit(f"episode.max_steps={steps}")
    assert race.truncated[0] or race.terminated[0]
    assert spied(race)[0][-1]["is_crashed"] is False


def test_a_car_that_runs_into_a_bot_from_behind_has_crashed(race_of):
    race = race_of(
        ON,
        *BOTS,
        "action_space=continuous",
        "race.bots.lane_change_after_s=null",
        "race.bots.speed_mps=0.1",
        "race.bots.number=1",
    )
    others = race.others.others
    put(race, float(others.distance_m[0, 0]) - 0.6, float(others.offset_m[0, 0]))
    for _ in range(20):
        race.step(np.array([[0.0, 1.0]]))
        if race.terminated[0]:
            break
    assert EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])] == "crashed"
    assert others.pauses[0] == 0


@pytest.mark.parametrize("quirks", ["fixed", "service"])
def test_params_about_others_are_the_services_with_its_mistakes_only_if_wanted(race_of, spy, quirks):
    race = race_of(ON, *MIXED, f"race.quirks={quirks}", spy, "race.bots.lane_change_after_s=null", *STANDING)
    others = race.others.others
    stop(race, 3)
    params = spied(race)[0][-1]
    count = race.setup.others.others
    for key, value in params.items():
        if key.startswith("objects_"):
            assert len(value) == count, key
    # Of the step before: params are computed before bots are sent.
    boxes = race.setup.others.boxes.count
    assert params["objects_location"][:boxes] == others.poses[0, :boxes, :2].tolist()
    ahead = sorted(
        range(count), key=lambda k: (params["objects_distance"][k] - params["projection_distance"]) % 23.118
    )
    assert params["closest_objects"] == [ahead[-1], ahead[0]]
    if quirks == "service":
        assert set(params["objects_speed"]) == {0.75}
        assert all(abs(heading) <= np.pi for heading in params["objects_heading"])
        assert params["objects_heading"][0] == others.poses[0, 0, 2]
    else:
        assert params["objects_speed"] == [0.0] * boxes + [0.75] * (count - boxes)
        assert params["objects_heading"][:boxes] == [0.0] * boxes
        assert max(abs(heading) for heading in params["objects_heading"]) > np.pi


def test_the_next_object_is_in_the_camera_when_it_is_ahead_and_not_when_it_is_beside(race_of, spy):
    positions = "race.boxes.positions=[{lap: 0.5, lane: inner}]"
    race = race_of(ON, *BOXES, "race.boxes.placement=fixed", positions, spy)
    box_m = float(race.others.others.distance_m[0, 0])
    for away_m, seen in ((1.5, True), (0.0, False), (-1.0, False)):
        put(race, box_m - away_m)
        race.step(np.array([7]))
        race.step(np.array([7]))
        assert spied(race)[0][-1]["object_in_camera"] is seen
        race.reset()


def test_features_of_the_next_objects(race_of):
    positions = "race.boxes.positions=[{lap: 0.5, lane: inner}, {lap: 0.6, lane: outer}]"
    race = race_of(ON, *BOXES, "race.boxes.placement=fixed", positions)
    others, at = race.others.others, race.feature_names.index("next_1_gap")
    put(race, float(others.distance_m[0, 0]) - 1.14)
    race._observe()
    gap, side, closing, bot, *second = race.observation[0, at:]
    assert gap == pytest.approx(1.0 / 5, abs=0.02)
    assert side == pytest.approx(2 * others.offset_m[0, 0] / race.rules.now.track_width_m[0], abs=0.05)
    assert (closing, bot) == (0, 0)
    assert second[0] == pytest.approx((1.0 + 0.1 * race.setup.track.length_m) / 5, abs=0.02)
    put(race, float(others.distance_m[0, 1]) + 1.0)
    race._observe()
    assert race.observation[0, at:].tolist() == [1, 0, 0, 0] * 2


def test_a_car_starts_in_the_other_lane_where_one_stands_near_its_start():
    race = Race(make_setup(ON, *BOXES, "race.boxes.number=9", *STANDING), 200)
    race.reset()
    others, now, length_m = race.others.others, race.rules.now, race.setup.track.length_m
    away_m = others.distance_m - (race.rules.start_ndist * length_m)[:, None]
    away_m = np.mod(away_m + length_m / 2, length_m) - length_m / 2
    nearest = np.abs(away_m).argmin(axis=1)
    row = np.arange(200)
    near = np.abs(away_m[row, nearest]) < NEAR_M
    assert 20 < near.sum() < 200
    assert (np.abs(now.offset_m[~near]) < 0.02).all()
    assert (np.sign(now.offset_m[near]) == -np.sign(others.offset_m[row, nearest][near])).all()
    assert "crashed" not in stop(race, 5)


def test_a_race_among_others_continues_from_a_state_as_the_race_it_was_taken_from():
    setup = make_setup("track=[reInvent2019_track,Oval_track]", "track.direction=alternate", *MIXED)
    race, used = Race(setup, 6, first_car=2), Race(setup, 6, first_car=2)
    race.reset()
    used.reset()
    actions = np.random.default_rng(1).integers(15, size=(160, 6))
    drive(used, actions[:10])
    drive(race, actions[:100])
    state = race.state_dict()
    kept = copy.deepcopy(state)
    expected = drive(race, actions[100:])
    for other in (Race(setup, 6, first_car=2), used):
        other.load_state_dict(state)
        np.testing.assert_equal(other.state_dict(), kept)
        np.testing.assert_array_equal(drive(other, actions[100:]), expected)


def test_what_a_car_meets_does_not_depend_on_how_many_cars_there_are():
    setup = make_setup(ON, *MIXED)
    many, one = Race(setup, 5), Race(setup, 1, first_car=3)
    many.reset()
    one.reset()
    actions = np.random.default_rng(1).integers(15, size=(60, 5))
    np.testing.assert_allclose(drive(many, actions)[:, 3], drive(one, actions[:, 3:4])[:, 0], atol=1e-9)


def test_camera_and_lidar_see_a_box_ahead(race_of):
    positions = "race.boxes.positions=[{lap: 0.5, lane: inner}]"
    fixed = ("race=object_avoidance", "race.boxes.placement=fixed", positions)
    sees = ("observation=camera_lidar", "observation.lidar.yaw_deg=0")
    seeing, alone = race_of(ON, *fixed, *sees), race_of(ON, *sees)
    box = seeing.others.others.poses[0, 0]
    away_m = 1.0
    for race in (seeing, alone):
        pose = box[0] - away_m * np.cos(box[2]), box[1] - away_m * np.sin(box[2]), box[2]
        race._batch.place(np.array([0]), *(np.array([value]) for value in pose))
        race._observe_started(np.array([0]))
    assert (seeing.pixels != alone.pixels).mean() > 0.01
    assert seeing.lidar.min() < away_m <= alone.lidar.max()
    assert (seeing.lidar <= alone.lidar + 0.1).all()


def test_bad_numbers_are_refused_in_one_line():
    def compose(*overrides):
        return build_setup(compose_experiment([ON, *overrides])[0])

    assert "next_objects=2" in refused(compose, "race=object_avoidance")
    assert "no room" in refused(compose, *BOXES, "race.boxes.number=12")
    assert "accepted: up to 11" in refused(compose, *BOTS, "race.bots.number=12")
    assert "placement=fixed" in refused(compose, *BOXES, "race.boxes.positions=[{lap: 0.25, lane: inner}]")
    assert "lane" in refused(
        compose, *BOXES, "race.boxes.placement=fixed", "race.boxes.positions=[{lap: 0.2, lane: left}]"
    )


def test_a_car_put_back_after_a_box_stands_before_it_in_the_other_lane_for_its_penalty(race_of):
    positions = "race.boxes.positions=[{lap: 0.5, lane: inner}]"
    race = race_of(ON, *BOXES, "race.boxes.placement=fixed", positions, "action_space=continuous")
    others, ids, yes = race.others.others, np.array([0]), np.ones(1, bool)
    put(race, float(others.distance_m[0, 0]) - 0.3, float(others.offset_m[0, 0]))
    race.step(np.array([[0.0, 1.0]]))
    race.step(np.array([[0.0, 1.0]]))
    assert EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])] == "crashed"
    race.put_back(ids, np.array([50.0]), crashed=yes, hold_s=np.ones(1))
    before, offset_m = race.rules.now.x_m.copy(), race.rules.now.offset_m[0]
    origin = race.setup.track.project(np.stack([race.rules.now.x_m, race.rules.now.y_m], axis=-1))
    assert others.distance_m[0, 0] - origin.distance_m[0] == pytest.approx(1.0, abs=0.02)
    assert np.sign(offset_m) == -np.sign(others.offset_m[0, 0])
    statuses = []
    for _ in range(16):
        race.step(np.array([[0.0, 1.0]]))
        statuses.append(EPISODE_STATUS[int(race.trace[0, PACKED["episode_status"]])])
        if len(statuses) <= 14:
            np.testing.assert_allclose(race.rules.now.x_m, before, atol=1e-3)
    assert statuses == ["pause"] * 15 + ["in_progress"]
    assert not race.terminated[0]


def test_bots_drive_on_while_a_car_serves_its_penalty_where_it_ran_into_one(race_of):
    race = race_of(ON, *BOTS, "race.bots.lane_change_after_s=null", *STANDING)
    others = race.others.others
    stop(race, 2)
    put(race, float(others.distance_m[0, 1]) - 0.2, float(others.offset_m[0, 1]))
    (status,) = stop(race, 1)
    assert status == "crashed"
    at, bots = race.rules.now.front.copy(), others.distance_m.copy()
    race.put_back(np.array([0]), np.array([30.0]), crashed=np.ones(1, bool), hold_s=np.full(1, 2.0))
    np.testing.assert_allclose(race.rules.now.front, at)
    assert stop(race, 30) == ["pause"] * 30
    np.testing.assert_allclose(race.rules.now.front, at, atol=1e-3)
    driven_m = np.mod(others.distance_m - bots, race.setup.track.length_m)
    np.testing.assert_allclose(driven_m, 2 * 0.75, atol=0.15)


@pytest.mark.parametrize("side", [1, -1])
def test_a_car_alone_is_put_back_in_the_lane_nearer_to_where_it_left(race_of, side):
    race = race_of(ON, *STANDING)
    put(race, 10.0, 0.9 * side)
    stop(race, 2)
    race.put_back(np.array([0]), np.array([40.0]))
    assert np.sign(race.rules.now.offset_m[0]) == side
    assert abs(race.rules.now.offset_m[0]) == pytest.approx(race.setup.track.width_m / 4, abs=0.05)
    race.put_back(np.array([0]), np.array([0.0]), restarts=np.ones(1, bool))
    assert abs(race.rules.now.offset_m[0]) < 0.02
