import copy
import multiprocessing
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.collectors.collector import Collector
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.env.setup import build_setup
from tests.training.conftest import workers_start_early  # noqa: F401 - a fixture


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """No process is left when the test ends; asked for last, it looks before other fixtures close what is open."""
    before = set(multiprocessing.active_children())
    yield
    assert set(multiprocessing.active_children()) == before


class Driver:
    """Opens collectors of one experiment, and has the policy that drives in them."""

    def __init__(self, folder: Path, *overrides: str, frames: int):
        experiment, _ = compose_experiment(["experiment=tiny", *overrides])
        self._config, self._setup, self._folder = experiment.collector, build_setup(experiment), folder
        self._frames = frames
        shapes = observation_shape(experiment.observation), self._setup.actions.n
        generator = torch.Generator().manual_seed(1)
        self.policy = build_actor_critic(experiment.network, *shapes, generator).policy
        self._weights = copy.deepcopy(self.policy.state_dict())
        self._opened = []

    def open(self, state=None) -> Collector:
        self.policy.load_state_dict(self._weights)
        opened = Collector(self._config, self._setup, self.policy, self._frames, self._folder, state=state)
        self._opened.append(opened)
        return opened

    def learn(self, collection: Collector, turn: int) -> None:
        """Change the weights as an update would, in a way that depends on the turn alone."""
        generator = torch.Generator().manual_seed(turn)
        with torch.no_grad():
            for name, parameter in self.policy.named_parameters():
                noise = torch.randn(parameter.shape, generator=generator)
                parameter.copy_(self._weights[name] + 0.3 * noise)
        collection.publish_policy()

    def collect(self, collection: Collector, turns: range) -> list:
        batches = []
        for turn in turns:
            if turn:
                self.learn(collection, turn)
            batches.append(collection.next_batch().exclude("collector").clone())
        return batches

    def close(self) -> None:
        for collection in self._opened:
            collection.close()


@pytest.fixture
def driver_of(tmp_path: Path) -> Iterator[Callable[..., Driver]]:
    """Have the cars of experiment=tiny driven, so many steps a batch."""
    made = []

    def make(*overrides: str, frames: int = 8 * 20) -> Driver:
        made.append(Driver(tmp_path, *overrides, frames=frames))
        return made[-1]

    yield make
    for driver in made:
        driver.close()
