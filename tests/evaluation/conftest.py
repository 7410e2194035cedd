"""A short round course, and drivers that need no training."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from tensordict import TensorDictBase

from deepracer_exp.config.compose import compose_evaluation, compose_experiment
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.observation import feature_names

RADIUS_M = 1.5
PEDAL = 0.0
"""A speed action that stays on the course."""


class Driver(torch.nn.Module):
    """Steers towards the road a metre ahead at a constant speed action; with a gain of 0, not at all."""

    def __init__(self, experiment: Experiment, pedal: float = PEDAL, gain: float = 2.5):
        super().__init__()
        self._at = feature_names(experiment.observation).index("ahead_x_1")
        self._pedal, self._gain = pedal, gain

    def forward(self, seen: TensorDictBase) -> TensorDictBase:
        x, y = seen["observation"][:, self._at : self._at + 2].T
        steering = (self._gain * torch.atan2(y, x) / np.radians(30)).clamp(-1, 1)
        return seen.set("action", torch.stack([steering, torch.full_like(steering, self._pedal)], -1))


@pytest.fixture(scope="session")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A circle of 9.4 m, driven in some five seconds."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    knots = np.round(RADIUS_M * np.stack([np.cos(angles), np.sin(angles)], axis=1), 6)
    file = tmp_path_factory.mktemp("course") / "circle.yaml"
    file.write_text(yaml.safe_dump({"closed": True, "width_m": 0.7, "knots": knots.tolist()}))
    return file


@pytest.fixture(scope="session")
def experiment(circle: Path) -> Experiment:
    return compose_experiment([f"track.file={circle}", "action_space=continuous"])[0]


@pytest.fixture
def protocol() -> Callable[..., EvaluationConfig]:
    """Compose a protocol; without held-out conditions unless they are asked for."""

    def build(name: str, **changes: object) -> EvaluationConfig:
        config = compose_evaluation([f"evaluation={name}"])[0].evaluation
        return dataclasses.replace(config, **{"held_out": None, **changes})

    return build


@pytest.fixture
def run_dir(copied: Callable[..., Path]) -> Path:
    """A copy of a trained run of one's own, under `runs/tiny/`."""
    return copied()


@pytest.fixture
def driver(experiment: Experiment) -> Callable[..., Driver]:
    return functools.partial(Driver, experiment)
