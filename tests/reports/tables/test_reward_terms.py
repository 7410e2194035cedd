"""Terms of a reward function: they add up to what was paid, step by step."""

from dataclasses import replace

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.reward_replay import replay_reward
from deepracer_exp.reports.tables.reward_terms import contributed_terms, run_terms
from deepracer_exp.rewards.source import RewardSource, named_reward_source, zoo_names
from tests.conftest import refused

from .made_up import Drive, made_up_recording

CAR = compose_experiment([])[0].car
WITH_TERMS = (
    *("center_speed_blend", "progress_delta", "careful_progress", "racing_line"),
    *("avoid_objects", "free_lane", "overtake", "self_motivator", "steps_to_finish"),
)


@pytest.fixture(scope="module")
def view() -> LogView:
    drives = [Drive(speed_mps=2.0 + 0.5 * k, offset_m=0.1 * k) for k in range(3)]
    return prepare(made_up_recording([*drives, Drive(speed_mps=2.0, off_at=60)]))


def module(text: str) -> RewardSource:
    return RewardSource("mine", "mine.py", text, "", {}, {})


@pytest.mark.parametrize("name", zoo_names())
def test_the_functions_of_the_zoo_that_are_sums_name_their_terms(name: str, view: LogView) -> None:
    assert (contributed_terms(view, named_reward_source(name), CAR, most=50) is not None) == (
        name in WITH_TERMS
    )


@pytest.mark.parametrize("name", WITH_TERMS)
def test_terms_add_up_to_the_reward(name: str, view: LogView) -> None:
    terms = contributed_terms(view, named_reward_source(name), CAR)
    assert terms is not None
    paid = replay_reward(view, named_reward_source(name), CAR).steps["new_reward"]
    np.testing.assert_allclose(terms.sum(axis=1), paid.loc[terms.index], rtol=1e-9, atol=1e-12)


def test_every_driven_row_has_its_terms(view: LogView) -> None:
    terms = contributed_terms(view, named_reward_source("center_speed_blend"), CAR)
    assert terms is not None
    driven = view.steps[view.steps["episode_status"] != "prepare"]
    assert terms.index.equals(driven.index)


def test_of_a_long_training_whole_episodes_are_asked_about(view: LogView) -> None:
    most = len(view.steps) // 3
    terms = contributed_terms(view, named_reward_source("center_speed_blend"), CAR, most=most)
    assert terms is not None
    asked = view.steps.loc[terms.index, "episode"]
    assert 0 < len(terms) < 1.5 * most
    whole = view.steps["episode"].isin(asked) & (view.steps["episode_status"] != "prepare")
    assert len(terms) == whole.sum()


def test_a_recordings_own_function_is_run_if_it_was_just_trained(view: LogView) -> None:
    assert run_terms(view, CAR) == (view, None)
    text = "def terms(params):\n    return {'one': 1.0, 'two': 2}\n\n\ndef reward_function(params):\n    return 3.0\n"
    own = replace(view, recording=replace(view.recording, reward_source=text))
    assert run_terms(own, CAR) == (own, None)
    _, terms = run_terms(own, CAR, just_trained=True)
    assert terms is not None
    assert terms.mean().to_dict() == {"one": 1.0, "two": 2.0}


def test_without_a_course_there_are_no_terms(view: LogView) -> None:
    assert contributed_terms(replace(view, course=None), named_reward_source("progress_delta"), CAR) is None


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return 3.0", "returned '3.0', not a dict of numbers"),
        ("return {}", "not a dict of numbers"),
        ("return {'a': 'b'}", "returned 'b' for 'a'"),
        ("return {'a': float('nan')}", "returned 'nan' for 'a'"),
        ("return {'a': 1 / 0}", "raised ZeroDivisionError"),
        ("while True: pass", "took longer than the time limit of 0.2 s"),
    ],
)
def test_terms_that_fail_are_reported_in_one_line(body: str, words: str, view: LogView) -> None:
    text = f"def terms(params):\n    {body}\n\n\ndef reward_function(params):\n    return 1.0\n"
    message = refused(contributed_terms, view, module(text), CAR, time_limit_s=0.2)
    assert "mine.py: terms " in message
    assert words in message
