from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from deepracer_exp.config.compose import compose_option
from deepracer_exp.config.driving import TrackConfig
from deepracer_exp.tracks.track import Track


def compose_track(name: str, **changed: object) -> TrackConfig:
    return replace(compose_option("track", name, TrackConfig), **changed)


@pytest.fixture(scope="session")
def track_config() -> Callable[..., TrackConfig]:
    return compose_track


@pytest.fixture(scope="session")
def catalogue_track() -> Callable[..., Track]:
    return cache(
        lambda name, direction="forward": Track.from_config(compose_track(name, direction=direction))
    )


@pytest.fixture
def ring() -> np.ndarray:
    """Route rows of a 1 m wide circular course, counter-clockwise, centre radius 3 m, closed exactly."""
    angle = np.linspace(0, 2 * np.pi, 61)[:-1]
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    rows = np.column_stack([3.0 * around, 2.5 * around, 3.5 * around])
    return np.concatenate([rows, rows[:1]])
