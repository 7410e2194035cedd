import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from deepracer_exp.commands.validation import reward_map, simple_driver
from deepracer_exp.commands.validation import validate as checking
from deepracer_exp.commands.validation.objects import with_others
from deepracer_exp.commands.validation.simple_driver import DrivenLap, SimpleDriver, action_space_laps
from deepracer_exp.commands.validation.validate import Check, look_closer, read, try_named_situations
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.tracks.track import Track


@pytest.fixture(scope="session")
def experiment() -> Experiment:
    return compose_experiment(["action_space=discrete"])[0]


@pytest.fixture(scope="session")
def race(experiment: Experiment) -> RaceSetup:
    return read(experiment).setup


@pytest.fixture(scope="session")
def against(experiment: Experiment) -> Track:
    return read(experiment).against


@pytest.fixture(scope="session")
def laps(race: RaceSetup) -> list[DrivenLap]:
    return action_space_laps(race)


@pytest.fixture
def race_with(race: RaceSetup, tmp_path: Path) -> Callable[..., RaceSetup]:
    """Return the race with a reward function given as text."""

    def build(text: str, time_limit_s: float = 60.0) -> RaceSetup:
        file = tmp_path / "mine.py"
        file.write_text(text, encoding="utf-8")
        config = RewardConfig(name="", file=str(file), constants={}, time_limit_s=time_limit_s)
        return dataclasses.replace(race, reward=load_reward_source(config), reward_time_limit_s=time_limit_s)

    return build


@pytest.fixture(scope="session")
def driven() -> dict[tuple[Any, ...], list[DrivenLap | None]]:
    """Laps that were driven, by all that they depend on: hardly any reward function has others than the next."""
    return {}


@pytest.fixture
def coarsely(driven: dict[tuple[Any, ...], list[DrivenLap | None]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Sample fewer situations than the command does, and drive the same laps once."""
    drive = simple_driver.drive_laps

    def drive_once(setup: RaceSetup, drivers: Sequence[SimpleDriver]) -> list[DrivenLap | None]:
        track, low, high = setup.track, tuple(setup.actions.low), tuple(setup.actions.high)
        on = (track.name, track.reversed, track.length_m, low, high, repr(setup.car), repr(setup.others))
        key = (*on, setup.seed, tuple(drivers))
        if key not in driven:
            driven[key] = drive(setup, drivers)
        return driven[key]

    monkeypatch.setattr(simple_driver, "drive_laps", drive_once)
    monkeypatch.setattr(checking, "_DETAILS", ((float("inf"), 0.2),))
    monkeypatch.setattr(checking, "_SAMPLES", ((float("inf"), 400),))
    monkeypatch.setattr(reward_map, "_DOTS_PER_INCH", 40)


@pytest.fixture
def check_of(race_with: Callable[..., RaceSetup], against: Track, coarsely: None) -> Callable[..., Check]:
    """Check a reward function given as text, completely."""

    def build(text: str, time_limit_s: float = 60.0) -> Check:
        setup = with_others(race_with(text, time_limit_s))
        check = Check(setup=setup, against=against, discount=0.99, aws=[])
        try_named_situations(check)
        if not check.failures:
            look_closer(check)
        return check

    return build
