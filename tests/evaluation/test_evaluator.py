import dataclasses
from collections import defaultdict

import numpy as np
import pytest
import torch

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import build_setup
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.evaluation.evaluator import Evaluator
from tests.conftest import refused


def evaluate(experiment, config, policy):
    return Evaluator(experiment, config, threads=1)(policy)


def plain(attempt):
    return dataclasses.replace(attempt, trial=0)


def by_trial(evaluation):
    found = defaultdict(list)
    for group in evaluation.groups:
        for attempt in group.attempts:
            found[attempt.trial].append(plain(attempt))
    return list(found.values())


def test_all_trials_in_one_batch_equal_each_trial_alone(experiment, protocol, driver):
    starts = (0.0, 0.3, 0.7)
    together = by_trial(evaluate(experiment, protocol("three_trials", starts=starts), driver()))
    alone = [
        by_trial(evaluate(experiment, protocol("three_trials", trials=1, starts=(start,)), driver()))[0]
        for start in starts
    ]
    assert together == alone
    assert all(attempts[0].complete for attempts in together)


def test_held_out_trials_beside_them_change_nothing_for_the_usual_ones(experiment, protocol, driver):
    both = evaluate(experiment, protocol("three_trials", trials=2, held_out="sim2real"), driver())
    usual = evaluate(experiment, protocol("three_trials", trials=2), driver())
    assert both.conditions == ["usual", "held_out"]
    assert list(map(plain, both.on("usual").attempts)) == list(map(plain, usual.on("usual").attempts))
    assert both.on("held_out").attempts


def test_the_same_policy_meets_the_same_trials_again(experiment, protocol, driver):
    evaluator = Evaluator(experiment, protocol("three_trials", trials=2, usual="sim2real"), threads=1)
    first, other, again = evaluator(driver()), evaluator(driver(0.1)), evaluator(driver())
    assert by_trial(first) == by_trial(again)
    assert by_trial(first) != by_trial(other)


def test_held_out_trials_start_between_the_usual_ones(experiment, protocol):
    trials = Evaluator(experiment, protocol("three_trials", trials=4, held_out="aws"), threads=1).trials
    assert [trial.start_ndist for trial in trials] == [0, 0.25, 0.5, 0.75, 0.125, 0.375, 0.625, 0.875]


def test_four_minutes_drives_one_flying_lap_after_the_other(experiment, protocol, driver):
    config = protocol("four_minutes", trials=1, time_s=18.0)
    *laps, last = evaluate(experiment, config, driver()).groups[0].attempts
    assert len(laps) >= 2
    assert all(lap.complete for lap in laps)
    assert last.end == "time_up"
    assert laps[1].time_s < laps[0].time_s, "the first one starts standing"
    assert [lap.begin_s for lap in laps[1:]] == pytest.approx([lap.begin_s + lap.time_s for lap in laps[:-1]])


def test_summit_puts_the_car_back_at_its_last_progress_standing(experiment, protocol, driver):
    config = protocol("summit", trials=1, time_s=20.0)
    seen = []

    def look(race, protocol, acted):
        row = race.trace[0]
        seen.append((row[PACKED["progress"]], row[PACKED["speed_mps"]], row[PACKED["episode_status"]]))

    evaluation = Evaluator(experiment, config, threads=1)(driver(gain=0.0), look)
    progress, speed, status = np.array(seen).T
    off = np.flatnonzero(status == STATUS_CODE["off_track"])
    attempts = evaluation.groups[0].attempts
    failed = {round((lap.begin_s + lap.time_s) * 15) - 1 for lap in attempts if lap.end == "off_track"}
    assert failed, "it never left the road four times in a lap"
    assert {lap.resets for lap in attempts if lap.end == "off_track"} == {3}
    assert max(lap.resets for lap in attempts) == 3
    for at in off[off + 1 < len(progress)]:
        # The chassis' origin stands there, on the line with a new lap, and its front 0.14 m ahead.
        expected = 100 * 0.14 / 9.4 + (0.0 if at in failed else progress[at - 1])
        assert progress[at + 1] == pytest.approx(expected, abs=0.5)
        assert abs(speed[at + 1]) < 1e-6


def test_no_car_is_put_back_behind_the_start(experiment, protocol):
    race = Evaluator(experiment, protocol("three_trials", trials=1), threads=1).race
    race.reset()
    race.put_back(np.array([0]), np.array([0.0]))
    race.step(np.zeros((1, 2), np.float32))
    assert race.trace[0, PACKED["progress"]] > 0


def test_a_car_put_back_keeps_what_its_episode_drew_but_no_command_on_its_way(circle):
    delay = "randomization.action_delay_steps=[3,3]"
    experiment, _ = compose_experiment(
        [f"track.file={circle}", "action_space=continuous", "randomization=sim2real", delay]
    )
    race = Race(build_setup(experiment), 1)
    race.reset()
    for _ in range(10):
        race.step(np.array([[0.0, 1.0]], np.float32))
    drawn, episode = race.randomization.values.copy(), race.rules.episode.copy()
    race.put_back(np.array([0]), np.array([20.0]))
    speeds = []
    for _ in range(6):
        race.step(np.array([[0.0, 1.0]], np.float32))
        speeds.append(race.trace[0, PACKED["speed_mps"]])
    assert (race.randomization.values == drawn).all()
    assert (race.rules.episode == episode).all()
    # The command chosen at the first pose acts three steps later, and the pose after that shows it.
    assert np.abs(speeds[:4]).max() < 1e-3
    assert speeds[4] > 0.05


def test_several_tracks_make_a_matrix(experiment, protocol, driver):
    config = protocol(
        "three_trials", trials=1, tracks=("Oval_track", "Straight_track"), held_out="aws", time_s=2.0
    )
    evaluation = evaluate(experiment, config, driver())
    assert evaluation.tracks == ["Oval_track", "Straight_track"]
    assert [(group.track, group.condition) for group in evaluation.groups] == [
        (track, condition) for track in evaluation.tracks for condition in ("usual", "held_out")
    ]


def test_a_track_driven_both_ways_counts_as_two(circle, protocol):
    experiment, _ = compose_experiment([f"track.file={circle}", "track.direction=alternate"])
    race = Evaluator(experiment, protocol("three_trials", trials=1), threads=1).race
    assert [course.tracks[0].reversed for course in race.setup.courses] == [False, True]
    assert len({course.name for course in race.setup.courses}) == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tracks": ("Ovl_track",)}, ("evaluation.tracks", "Ovl_track", "Oval_track")),
        ({"tracks": "Ovl_track"}, ("evaluation.tracks", "Ovl_track", "Oval_track")),
        ({"held_out": "sim2rael"}, ("evaluation.held_out", "sim2rael", "sim2real")),
        ({"usual": "nothing"}, ("evaluation.usual", "nothing", "none")),
    ],
)
def test_an_unknown_track_or_condition_is_refused(experiment, protocol, change, words):
    said = refused(Evaluator, experiment, protocol("three_trials", **change))
    assert all(word in said for word in words)


def test_an_evaluation_leaves_the_training_s_random_numbers_alone(experiment, protocol, driver):
    config = protocol("three_trials", trials=1, sample=True, time_s=1.0)
    before = torch.random.get_rng_state()
    evaluate(experiment, config, driver())
    assert torch.equal(torch.random.get_rng_state(), before)
