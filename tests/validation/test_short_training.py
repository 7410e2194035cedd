from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.validation.short_training import compare_thirds, short_training_overrides, trial_seconds


@pytest.mark.parametrize(("text", "seconds"), [("60s", 60), ("2min", 120), ("90", 90), ("1.5s", 1.5)])
def test_a_time_is_seconds_or_minutes(text, seconds):
    assert trial_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "0s", "-5s", "20000steps", "inf", "1h"])
def test_anything_else_is_refused_with_what_is_accepted(text):
    with pytest.raises(BadInput, match="accepted: seconds or minutes above 0"):
        trial_seconds(text)


def test_only_time_ends_a_trial():
    experiment, _ = compose_experiment(["experiment=tiny", *short_training_overrides(90.0)])
    assert experiment.budget.minutes == 1.5
    assert experiment.budget.env_steps is None
    assert experiment.stopping.kind == "none"
    assert experiment.name == "validate"


def rows(completion: list[float | None], reward: list[float]) -> list[dict]:
    return [
        {"completion": c, "mean_return": r, "episodes": 10 * (i + 1), "env_steps": 100 * (i + 1)}
        for i, (c, r) in enumerate(zip(completion, reward, strict=True))
    ]


def test_a_rise_is_told_from_noise():
    noise = np.random.default_rng(0).normal(0, 3, 30)
    trial = compare_thirds(Path(), rows([*(np.linspace(10, 80, 30) + noise)], [*(50 + noise)]))
    completion, reward = trial.changes
    assert completion.rises
    assert completion.last > completion.first
    assert not reward.rises
    assert (trial.first_episodes, trial.last_episodes, trial.env_steps) == (100, 100, 3000)


def test_iterations_without_an_episode_count_for_nothing():
    trial = compare_thirds(Path(), rows([None, 5, 6, 7, 8, 9, 50, None, 60], [1.0] * 9))
    assert (trial.changes[0].first, trial.changes[0].last) == (5.5, 55)


@pytest.mark.parametrize("n", [0, 1, 5])
def test_too_few_iterations_say_nothing(n):
    assert compare_thirds(Path(), rows([1.0] * n, [1.0] * n)).changes == ()
