"""Situations among boxes and bots, and the mistakes that reward functions make with params about them."""

import dataclasses

import numpy as np
import pytest

from deepracer_exp.commands.validation.objects import object_outlines, with_others
from deepracer_exp.commands.validation.situations import named_situations
from deepracer_exp.commands.validation.validate import read
from deepracer_exp.config.compose import compose_experiment

AVOID = """def reward_function(params):
    reward = 1.0
    following = params["closest_objects"][1]
    gap_m = params["objects_distance"][following]{less}
    same = params["objects_left_of_center"][following] == params["is_left_of_center"]
    if same and 0 <= gap_m < 0.8:
        reward = 0.2
    {more}
    return 1e-3 if params["is_crashed"] else reward
"""
RELATIVE = "takes objects_distance as the distance from the car"


def function(less: str = ' - params["projection_distance"]', more: str = "") -> str:
    return AVOID.format(less=less, more=more)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (function(), None),
        (function(less=""), RELATIVE),
        (
            function(more='if params["object_in_camera"]:\n        reward *= 0.5'),
            "object_in_camera decides in",
        ),
        (
            function(more='reward *= 1 - abs(params["objects_heading"][following]) / 200'),
            "objects_heading decides in",
        ),
        (function(more='reward += params["objects_speed"][following]'), "objects_speed decides in"),
    ],
    ids=["right", "relative", "camera", "radians", "speed"],
)
def test_each_mistake_with_objects_is_named_and_a_right_function_has_none(check_of, text, words):
    check = check_of(text)
    assert check.failures == []
    mistakes = [line for line in check.warnings if RELATIVE in line or "decides in" in line]
    assert [words in line for line in mistakes] == ([] if words is None else [True])
    assert not any("never reaches" in line for line in check.warnings) or words == RELATIVE
    in_lane, beside = (check.tried[f"box ahead in {lane}"].reward for lane in ("its lane", "the other lane"))
    assert in_lane < beside or words == RELATIVE
    assert check.tried["in a box"].reward == 1e-3 == check.tried["in a bot"].reward


def test_a_function_that_reads_of_no_others_is_tried_alone(check_of):
    check = check_of('def reward_function(params):\n    return params["speed"]\n')
    assert check.setup.others is None
    assert not any("box" in name or "bot" in name for name in check.tried)


def test_situations_are_those_of_the_race_and_its_boxes_are_on_the_map():
    overrides = [
        "track=reInvent2019_track",
        "race=six_boxes",
        "observation.next_objects=2",
        "reward=avoid_objects",
    ]
    check = read(compose_experiment(overrides)[0])
    names = [case.name for case in named_situations(check.setup, check.against)]
    assert [name for name in names if "bo" in name] == [
        *("box ahead in its lane", "box ahead in the other lane", "beside a box", "in a box")
    ]
    corners = object_outlines(check.setup)
    assert corners.shape == (6, 4, 2)
    assert check.setup.track.on_road(corners.mean(axis=1)).all()
    crashed = {
        case.name: bool(case.now.columns["is_crashed"][0])
        for case in named_situations(check.setup, check.against)
    }
    assert [name for name, hit in crashed.items() if hit] == ["in a box"]


def test_a_rival_counts_as_a_bot(race):
    rivals = compose_experiment(["race=head_to_head", "observation.next_objects=1"])[0].race
    others = with_others(dataclasses.replace(race, others=rivals)).others
    assert (others.boxes.count, others.bots.count, others.rivals) == (0, 1, None)
    assert np.isfinite(object_outlines(with_others(dataclasses.replace(race, others=rivals)))).all()
