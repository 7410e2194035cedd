"""Races of two: where both start, what each sees of the other, who is at fault, and that a state restores all of it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.api import compose, make_env
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.gym_env import DeepRacerEnv
from deepracer_exp.env.others.boxes_and_bots import CAR_M
from deepracer_exp.env.others.head_to_head import HeadToHead, Rivals, rival_setup, weights_of
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import EPISODE_STATUS, PACKED
from deepracer_exp.runs.checkpoints import networks_of
from tests.conftest import refused

from .conftest import make_setup, put

RACE = (
    *("race=head_to_head", "observation.next_objects=1", "track=reInvent2019_track"),
    *("action_space=continuous", "action_space.speed.low=0", "episode.immobilized_steps=0"),
)
GO, STOP, SLOWLY = np.array([0.0, 1.0]), np.array([0.0, -1.0]), np.array([0.0, -0.6])


class Always(torch.nn.Module):
    """A policy that takes one action whatever it sees."""

    def __init__(self, action: np.ndarray = STOP):
        super().__init__()
        self.action = torch.nn.Parameter(torch.from_numpy(action).float())

    def forward(self, seen: TensorDictBase) -> TensorDictBase:
        return seen.set("action", self.action.expand(*seen.batch_size, -1))


@pytest.fixture
def duel() -> Callable[..., HeadToHead]:
    """Build a race of n learners whose rivals take an action."""

    def build(*overrides: str, n_cars: int = 1, rival: np.ndarray = STOP, **options) -> HeadToHead:
        setup = make_setup(*RACE, *overrides)
        race = HeadToHead(setup, n_cars, rival_setup(setup, setup.observation), **options)
        race.drive_with([Always(rival)])
        race.reset()
        return race

    return build


def meet(race: HeadToHead, mine_m: float, theirs_m: float, theirs_offset_m: float = 0.0) -> None:
    """Put learners and rivals on the road, past their prepare step."""
    race.step(np.tile(STOP, (race.n_cars, 1)))
    put(race, mine_m)
    put(race.rival, theirs_m, theirs_offset_m)
    race._update_opponents(race._everyone)
    for one in (race, race.rival):
        one.rules.start_midway(np.full(race.n_cars, 10), 100 * one.rules.now.ndist)


def status(race) -> list[str]:
    return [EPISODE_STATUS[int(code)] for code in race.trace[:, PACKED["episode_status"]]]


def test_one_car_starts_behind_the_other_in_the_other_lane_and_both_places_occur(duel):
    race = duel("episode.start_advance=0", "episode.start_offset=0.3", n_cars=40)
    track = race.setup.track
    gap_m = race.others.others.distance_m[:, 0] - race.rival.others.others.distance_m[:, 0]
    assert 8 < (gap_m > 0).sum() < 32
    np.testing.assert_allclose(np.abs(gap_m), 0.75, atol=0.15)
    sides = np.sign(race.others.others.offset_m[:, 0]), np.sign(race.rival.others.others.offset_m[:, 0])
    assert (sides[0] == -sides[1]).all()
    # Whoever is in front is in the outer lane.
    outer = -1 if not track.is_clockwise else 1
    assert (np.where(gap_m > 0, sides[0], sides[1]) == outer).all()
    race.step(np.tile(STOP, (40, 1)))
    behind = gap_m > 0
    assert (race.trace[behind, PACKED["progress"]] < 0).all()
    assert (race.trace[~behind, PACKED["progress"]] >= 0).all()


def test_both_meet_the_same_boxes_and_neither_starts_beside_one(duel):
    race = duel("race.boxes.number=5", "race.boxes.min_distance_m=1.5", n_cars=40)
    for _ in range(3):
        mine, theirs = race.others.others, race.rival.others.others
        np.testing.assert_array_equal(mine.poses[:, :5], theirs.poses[:, :5])
        assert (np.ptp(mine.poses[:, :5, 0], axis=0) > 0).all()
        for one in (race, race.rival):
            boxes = one.others.others.poses[:, :5, :2]
            here = np.stack([one.rules.now.x_m, one.rules.now.y_m], axis=-1)
            away_m = np.linalg.norm(boxes - here[:, None], axis=-1)
            assert away_m.min() > 0.5
        race.step(np.tile(STOP, (40, 1)))
        race.step(np.tile(STOP, (40, 1)))
        assert "crashed" not in status(race) + status(race.rival)
        race.reset()


def test_a_box_beside_a_rival_is_met_as_without_one(duel):
    fixed = ("race.boxes.placement=fixed", "race.boxes.positions=[{lap: 0.4, lane: inner}]")
    race = duel(*fixed, "episode.start_advance=0", n_cars=2)
    box = race.others.others
    meet(race, box.distance_m[0, 0], 1.0)
    put(race, box.distance_m[0, 0], box.offset_m[0, 0])
    race.step(np.tile(STOP, (2, 1)))
    assert status(race) == ["crashed", "crashed"]
    race.reset()
    meet(race, 1.0, box.distance_m[0, 0], box.offset_m[0, 0])
    race._rival_percent[:] = 100 * race.rival.rules.now.ndist
    race.step(np.tile(STOP, (2, 1)))
    assert status(race.rival) == ["crashed", "crashed"]
    assert race.others.serving.tolist() == [False, False]
    # It stands 1 m before the box in the other lane, and no car can run into it.
    shown = race.others.others
    np.testing.assert_allclose(shown.distance_m[:, 1], box.distance_m[:, 0] - 1.0, atol=0.1)
    assert (np.sign(shown.offset_m[:, 1]) == -np.sign(box.offset_m[:, 0])).all()
    assert shown.untouchable.all()


def test_each_car_sees_where_the_other_is_now(duel):
    race = duel(n_cars=4, rival=np.array([0.2, 0.5]))
    for _ in range(25):
        race.step(np.tile([-0.1, 0.2], (4, 1)))
        for one, other in ((race, race.rival), (race.rival, race)):
            now, shown = other.rules.now, one.others.others
            np.testing.assert_array_equal(shown.poses[:, 0], np.stack([now.x_m, now.y_m, now.yaw_rad], 1))
            np.testing.assert_array_equal(shown.speeds_mps(np.arange(4), None)[:, 0], now.speed_mps)
    at = race.feature_names.index("next_1_closing")
    scale = race.setup.observation.speed_scale_mps
    ahead = race.observation[:, at - 2] < 1
    assert ahead.any()
    closing = (race.rules.now.speed_mps - race.rival.rules.now.speed_mps) / scale
    np.testing.assert_allclose(race.observation[ahead, at], closing[ahead], rtol=1e-5)


@pytest.mark.parametrize("learner_is_behind", [True, False])
def test_who_runs_into_the_other_from_behind_is_at_fault_and_the_other_drives_on(duel, learner_is_behind):
    race = duel(rival=STOP if learner_is_behind else GO)
    gap_m = 0.6 if learner_is_behind else -0.6
    meet(race, 3.0, 3.0 + gap_m)
    for _ in range(20):
        race.step(np.array([GO if learner_is_behind else STOP]))
        if {"crashed"} & {*status(race), *status(race.rival)}:
            break
    hit, innocent = (race, race.rival) if learner_is_behind else (race.rival, race)
    assert status(hit) == ["crashed"]
    assert status(innocent) == ["in_progress"]
    assert race.terminated.tolist() == [learner_is_behind]


def test_a_rival_that_has_crashed_stands_for_its_pause_and_cannot_be_run_into(duel):
    race = duel("race.rivals.pause_s=1", rival=GO)
    meet(race, 3.0, 3.0 - 0.6)
    seen, stood_at = [], []
    for _ in range(40):
        race.step(np.array([STOP]))
        seen += status(race.rival)
        stood_at.append(race.rival.rules.now.x_m[0])
        assert status(race) == ["in_progress"]
        if "pause" in seen and seen[-1] != "pause":
            break
    first = seen.index("pause")
    assert seen[first - 1] == "crashed"
    assert seen.count("pause") == 15
    assert len(set(stood_at[first : first + 14])) == 1
    # It stands in the learner, who could not but run into it.
    away_m = np.hypot(
        race.rules.now.x_m - race.rival.rules.now.x_m, race.rules.now.y_m - race.rival.rules.now.y_m
    )
    assert away_m < CAR_M[0] + 1.0


def test_across_the_start_line_the_car_ahead_is_the_one_ahead_unless_as_on_the_service(duel):
    for quirks, at_fault in (("fixed", True), ("service", False)):
        race = duel(f"race.quirks={quirks}")
        # The front of the learner is before the line, that of the rival past it.
        meet(race, race.setup.track.length_m - 0.35, 0.0 - 0.05)
        race.step(np.array([STOP]))
        assert (status(race) == ["crashed"]) is at_fault, quirks


def test_a_rival_that_leaves_the_track_goes_on_from_where_it_left_and_the_learner_s_episode_goes_on(duel):
    race = duel(rival=np.array([1.0, 0.5]))
    seen = []
    for _ in range(60):
        race.step(np.array([STOP]))
        seen += status(race.rival)
        assert not race.terminated.any()
    assert "off_track" in seen
    assert seen[seen.index("off_track") + 1] == "pause"


def test_learner_and_rival_meet_the_same_conditions(duel):
    race = duel("randomization=sim2real", n_cars=6)
    np.testing.assert_array_equal(race.randomization.values, race.rival.randomization.values)


def test_a_rival_drives_at_the_pace_of_its_episode_in_a_training_only(duel):
    for evaluated in (False, True):
        race = duel("race.rivals.pace=[0.5,0.9]", n_cars=32, rival=SLOWLY, evaluated=evaluated)
        for _ in range(10):
            race.step(np.tile(STOP, (32, 1)))
        pace = race.rival.trace[:, PACKED["throttle"]] / race.setup.actions.commands(SLOWLY[None])[1]
        if evaluated:
            np.testing.assert_allclose(pace, 1.0, rtol=1e-6)
        else:
            assert 0.499 < pace.min() < 0.6 < 0.8 < pace.max() < 0.901
            assert (race.rival.rules.now.speed_mps.argsort()[[0, -1]] == pace.argsort()[[0, -1]]).all()


def test_each_episode_draws_its_rival_among_all(duel):
    race = duel(n_cars=64)
    race.drive_with([Always(STOP), Always(SLOWLY)])
    for _ in range(10):
        race.step(np.tile(STOP, (64, 1)))
    moved = race.rival.rules.now.speed_mps > 0.2
    assert 16 < moved.sum() < 48
    race.reset()
    for _ in range(10):
        race.step(np.tile(STOP, (64, 1)))
    assert (moved != (race.rival.rules.now.speed_mps > 0.2)).any()


@pytest.mark.parametrize("overrides", [(), ("action_space=discrete",), ("algorithm=sac",)], ids=" ".join)
def test_a_rival_takes_the_actions_of_an_evaluation(overrides):
    config = compose_experiment([*RACE[:3], *overrides])[0]
    setup = build_setup(config)
    policy = networks_of(config, torch.Generator().manual_seed(3)).policy
    race = HeadToHead(setup, 8, rival_setup(setup, config.observation))
    race.drive_with([policy])
    race.reset()
    seen = TensorDict({"observation": torch.from_numpy(race.rival.observation)}, [8])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        np.testing.assert_array_equal(race._rivals_actions(), policy(seen)["action"].numpy())


def test_a_restored_race_continues_bit_for_bit(duel):
    def roll(race, steps):
        rows = []
        for action in np.random.default_rng(steps).uniform(-0.3, 0.4, (steps, 8, 2)):
            race.step(action)
            rows.append(np.concatenate([race.trace, race.rival.trace, race.observation], axis=1))
            race.reset(np.flatnonzero(race.terminated | race.truncated))
        return np.array(rows)

    def build():
        race = duel("randomization=sim2real", "race.boxes.number=2", n_cars=8, rival=np.array([0.1, 0.1]))
        race.drive_with([Always(np.array([0.1, 0.1])), Always(np.array([-0.1, 0.3]))])
        return race

    race = build()
    roll(race, 50)
    state = race.state_dict()
    wanted = roll(race, 40)
    again = build()
    again.load_state_dict(state)
    np.testing.assert_array_equal(roll(again, 40), wanted)


def test_weights_survive_the_way_to_another_process():
    first, second = Always(GO), Always(STOP)
    setup = make_setup(*RACE)
    rivals = Rivals(setup=rival_setup(setup, setup.observation), policy=first, weights=(weights_of(second),))
    (built,) = rivals.policies(rivals.weights)
    assert built.action.tolist() == STOP.tolist()
    assert first.action.tolist() == GO.tolist()


def test_environments_without_anybody_to_drive_the_rival_are_refused():
    assert "race.rivals.policy=pool" in refused(make_env, compose(*RACE))
    assert "race.rivals.policy=pool" in refused(DeepRacerEnv, RACE)


def test_a_rival_needs_a_closed_track_and_no_bots(tmp_path):
    file = tmp_path / "straight.yaml"
    file.write_text("closed: false\nwidth_m: 1.0\nknots: [[0, 0], [1, 0], [2, 0.2], [3, 0], [4, 0]]\n")
    open_track = compose_experiment([*RACE[:2], f"track.file={file}"])[0]
    assert "no room behind its start" in refused(build_setup, open_track)
    assert "without bots" in refused(compose_experiment, [*RACE, "race.bots.number=2"])
    assert "next_objects=0" in refused(compose_experiment, ["race=head_to_head"])
    line = refused(compose_experiment, [*RACE, "race.rivals.checkpoint=last"])
    assert "checkpoint=last" in line
