"""Races of two under a protocol: who wins, and what `evaluate` says of it."""

import json

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.race_protocol import Attempt, RaceProtocol
from deepracer_exp.evaluation.rival_protocol import DRAWN, LOST, WON, RivalProtocol
from tests.conftest import OFTEN, POOL, THREE, refused

from .conftest import Driver

FAST, SLOW = 0.0, -0.3


def test_a_rival_is_no_physical_car(protocol):
    seen = ("observation=camera", "network=cnn_small", "action_space=real_car")
    experiment = compose_experiment(["race=head_to_head", "observation.next_objects=1", *seen])[0]
    assert "a rival is not driven as the physical car" in refused(
        Evaluator, experiment, protocol("real_car", trials=2)
    )


@pytest.fixture(scope="module")
def racing(circle):
    """The circle with room for two cars."""
    return compose_experiment(
        [
            *(f"track.file={circle}", "action_space=continuous"),
            *("race=head_to_head", "observation.next_objects=1"),
        ]
    )[0]


@pytest.fixture
def race_of(racing, protocol):
    """Race a driver against another, 4 times."""

    def race(mine: float, theirs: float, **changes: object):
        config = protocol("head_to_head", trials=4, **{"laps": 2, **changes})
        return Evaluator(racing, config, threads=1)(Driver(racing, mine), rival=Driver(racing, theirs))

    return race


def test_the_faster_car_wins_wherever_it_starts_if_it_need_not_pass(racing, protocol):
    config = protocol("head_to_head", trials=4, laps=2)
    evaluator = Evaluator(racing, config, threads=1)
    starts = [trial.start_ndist for trial in evaluator.trials]
    assert starts == [0.0, 0.0, 0.5, 0.5]
    (group,) = evaluator(Driver(racing, FAST), rival=Driver(racing, SLOW)).groups
    # In even trials the car is in front.
    assert group.won[0] == group.won[2] == WON
    (group,) = evaluator(Driver(racing, SLOW), rival=Driver(racing, FAST)).groups
    assert group.won[1] == group.won[3] == LOST


def test_against_itself_a_policy_wins_half_of_the_races(racing, protocol):
    config = protocol("head_to_head", trials=8, laps=2)
    evaluator = Evaluator(racing, config, threads=1)
    policy = Driver(racing, FAST)
    group = evaluator(policy).groups[0]
    assert group.won_share == 0.5
    assert group.won == evaluator(policy, rival=policy).groups[0].won
    assert group.statistics()["won"]["mean"] == 0.5


def test_if_the_time_is_up_whoever_came_further_has_won(race_of):
    (group,) = race_of(FAST, SLOW, laps=None, time_s=6.0).groups
    assert group.won[0] == group.won[2] == WON
    (group,) = race_of(SLOW, FAST, laps=None, time_s=6.0).groups
    assert group.won[1] == group.won[3] == LOST


def lap(begin_s: float, time_s: float, end: str = "lap_complete", progress: float = 100.0) -> Attempt:
    return Attempt(
        trial=0, begin_s=begin_s, time_s=time_s, penalty_s=0.0, resets=0, progress=progress, end=end
    )


@pytest.mark.parametrize(
    ("mine", "theirs", "result"),
    [
        ([lap(0, 5), lap(5, 5)], [lap(0, 4), lap(4, 7)], WON),
        ([lap(0, 5), lap(5, 5)], [lap(0, 4), lap(4, 6)], DRAWN),
        ([lap(0, 5), lap(5, 5)], [lap(0, 4), lap(4, 5)], LOST),
        ([lap(0, 5), lap(5, 5)], [lap(0, 9)], WON),
        ([lap(0, 5), lap(5, 2, "off_track", 40.0)], [lap(0, 6)], LOST),
        ([lap(0, 5), lap(5, 2, "time_up", 40.0)], [], WON),
        ([lap(0, 5, "time_up", 40.0)], [lap(0, 3), lap(3, 3)], LOST),
    ],
)
def test_whoever_finishes_the_laps_first_has_won(protocol, mine, theirs, result):
    config, closed = protocol("head_to_head", laps=2), np.array([True])
    rivals, cars = RivalProtocol(config, closed, 1 / 15), RaceProtocol(config, closed, 1 / 15, True)
    rivals._protocol.attempts, cars.attempts = theirs, mine
    assert rivals.results(cars) == (result,)


def test_other_races_have_no_winner(experiment, protocol):
    (group,) = Evaluator(experiment, protocol("three_trials"), threads=1)(Driver(experiment)).groups
    assert not group.won
    assert "won" not in group.statistics()


def test_evaluate_races_one_run_against_another_and_says_so(copied, call, tmp_path):
    run = copied(*OFTEN, *POOL, *THREE)
    other = copied(*OFTEN, *THREE, "seed=1")  # sees no other car
    ended = call(
        *("evaluate", run.name, "evaluation=head_to_head", f"rival={other.name}", "rival_checkpoint=last"),
        *("evaluation.trials=2", "evaluation.laps=1", "evaluation.time_s=4"),
    )
    assert ended.code == 0, ended.stderr
    assert f"against {other.name}, checkpoint" in ended.stderr.replace("\n", " ")
    assert "won %" in ended.stdout
    (file,) = (run / "evaluations").glob("*.json")
    content = json.loads(file.read_text())
    assert content["rival"]["run"] == other.name
    assert 0 <= content["groups"][0]["won"]["mean"] <= 1
    alone = call(
        "evaluate", other.name, "evaluation=head_to_head", "evaluation.trials=2", "evaluation.time_s=2"
    )
    assert alone.code == 0, alone.stderr
    assert "against itself" in alone.stderr.replace("\n", " ")


def test_a_rival_that_cannot_race_is_refused_in_one_line(copied, call):
    run, other = copied(), copied("action_space=discrete")
    for overrides, words in (
        ((f"rival={other.name}",), ("rival=", "this race has none", "evaluation=head_to_head")),
        (("evaluation=head_to_head", f"rival={other.name}"), ("has other actions: 15 actions",)),
        (("evaluation=head_to_head", "rival=nobody"), ("rival=nobody: no such run",)),
        (("evaluation=head_to_head", f"rival={run.name}", "rival_checkpoint=77"), ("rival=", "77")),
        (("evaluation=head_to_head", "rival_checkpoint=last"), ("rival_checkpoint=last", "rival=RUN")),
    ):
        call("evaluate", run.name, *overrides).assert_refused(*words)


def test_pages_of_a_policy_against_itself_take_no_rival(copied, call):
    run = copied(*OFTEN, *POOL, *THREE)
    for flags in (("--live",), ("--replay", "laps.html")):
        ended = call("watch", run.name, "evaluation=head_to_head", f"rival={run.name}", *flags)
        ended.assert_refused("rival=", flags[0], "against itself")
