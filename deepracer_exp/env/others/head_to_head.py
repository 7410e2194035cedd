"""Head-to-head races: each of the learner's cars races a rival that a frozen policy drives."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch.distributions import Categorical

from deepracer_exp.config.driving import ObservationConfig, RandomizationConfig
from deepracer_exp.env.observation import build_parts
from deepracer_exp.env.race import Race
from deepracer_exp.env.randomization.car_randomization import CarStreams, Purpose
from deepracer_exp.env.rules import Bools, Floats, Ids
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.env.state import checked_array
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.rewards.source import NO_REWARD

from .rival import RaceRival

Weights = Mapping[str, np.ndarray]
"""Tensors of a policy by name, as NumPy arrays, which processes and checkpoints exchange without PyTorch's pickle."""

_STATUS, _PROGRESS = PACKED["episode_status"], PACKED["progress"]
_LAP, _PAUSE, _CRASHED, _GOING = (
    STATUS_CODE[status] for status in ("lap_complete", "pause", "crashed", "in_progress")
)


def rival_setup(setup: RaceSetup, observation: ObservationConfig) -> RaceSetup:
    """Return the setup of a race's rivals: the same cars, tracks and conditions, with their policy's observation.

    Raises:
        BadInput: one of the user's own parts of the observation cannot be used.
    """
    return replace(
        setup,
        observation=observation,
        observation_parts=build_parts(observation),
        reward=NO_REWARD,
        # An episode is as long as the learner's.
        episode=replace(setup.episode, max_steps=0),
    )


def weights_of(policy: torch.nn.Module) -> Weights:
    """Return copies of a policy's weights."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in policy.state_dict().items()}


@dataclass(frozen=True, kw_only=True, eq=False)
class Rivals:
    """Everything that rivals need in another process; picklable."""

    setup: RaceSetup
    """The rivals' race, of `rival_setup`."""
    policy: torch.nn.Module
    """The layers; their weights are not used."""
    weights: tuple[Weights, ...]
    """Weights of the policies from which each episode draws its rival's."""

    def policies(self, weights: Sequence[Weights]) -> list[torch.nn.Module]:
        """Return a policy for each set of weights."""
        policies = []
        for tensors in weights:
            policy = copy.deepcopy(self.policy)
            policy.load_state_dict(
                {name: torch.from_numpy(values.copy()) for name, values in tensors.items()}
            )
            policies.append(policy.requires_grad_(False))
        return policies


class _RivalRace(Race):
    """The race of the rivals.

    Attributes:
        pace: factor on the speed that each rival's policy commands, (N,).
    """

    pace: Floats

    def _commands(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        steering_deg, speed_mps = super()._commands(action)
        return steering_deg, self.pace * speed_mps


class HeadToHead(Race):
    """The race of N learners, each against a rival on the same track, stepped together.

    It is a `Race` of the learners. An episode of both begins and ends with the learner's. A rival takes the likeliest
    actions of its policy, in a training at the pace that the episode draws. Where it leaves the track, it is put back
    and stands for `race.rivals.pause_s`.

    Attributes:
        rival: the race of the rivals; its car i is the rival of learner i.
    """

    others: RaceRival

    def __init__(
        self,
        setup: RaceSetup,
        n_cars: int,
        rivals: RaceSetup,
        threads: int = 1,
        first_car: int = 0,
        prints: RewardPrints | None = None,
        randomizations: Sequence[RandomizationConfig] | None = None,
        evaluated: bool = False,
    ):
        """Build the cars; call `drive_with` and then `reset` next.

        Args:
            setup: as for `Race`.
            n_cars: learners, and rivals.
            rivals: of `rival_setup`.
            threads: as for `Race`.
            first_car: as for `Race`; a rival has the number of its learner.
            prints: as for `Race`.
            randomizations: as for `Race`, of learners and rivals.
            evaluated: whether the caller puts rivals back, by `put_rivals_back`, and their pace is 1.
        """
        self.rival = _RivalRace(rivals, n_cars, threads, first_car, None, randomizations)
        self.rival.pace = np.ones(n_cars)
        assert isinstance(self.rival.others, RaceRival)
        self.rival.others.is_rival = True
        assert setup.others is not None
        self._training = None if evaluated else setup.others.rivals
        self._policies: Sequence[torch.nn.Module] = ()
        self._share = np.zeros(n_cars)
        self._rival_percent = np.zeros(n_cars)
        super().__init__(setup, n_cars, threads, first_car, prints, randomizations)

    def drive_with(self, policies: Sequence[torch.nn.Module]) -> None:
        """Let policies drive the rivals, in each episode one of them, drawn uniformly.

        They read the rivals' observation and write `action`. Episodes under way continue with the policy at the same
        share of the list.
        """
        self._policies = policies

    def seed(self, seed: int) -> None:
        """Start both cars over."""
        super().seed(seed)
        self.rival.seed(seed)
        self._streams = CarStreams(seed, self.cars.tolist(), Purpose.RIVALS)

    def reset(
        self,
        ids: Ids | None = None,
        course: np.ndarray | None = None,
        start_ndist: np.ndarray | None = None,
    ) -> None:
        """Start a new episode of both cars; `start_ndist` is where the one in front starts, the rest as for `Race`."""
        ids = self._everyone if ids is None else ids
        if not len(ids):
            return
        for race in (self, self.rival):
            race._start(ids, course, start_ndist)
        low, high = (1.0, 1.0) if self._training is None else self._training.pace
        for car, episode in zip(ids.tolist(), self.rules.episode[ids].tolist(), strict=True):
            self._share[car], pace = self._streams.stream(car, episode).random(2)
            self.rival.pace[car] = low + pace * (high - low)
        self._rival_percent[ids] = 0.0
        self._update_opponents(ids)
        for race in (self, self.rival):
            race._observe_started(ids)

    def step(self, action: np.ndarray) -> None:
        """Move both cars by one control period; the rules of both see where the other is now."""
        theirs = self._rivals_actions()
        self.rival._act(theirs)
        self._act(action)
        self._update_opponents(self._everyone)
        self.rival._update_observation(theirs)
        self._update_observation(action)
        if self._training is not None:
            self._put_lost_rivals_back(self._training.pause_s)

    def put_back(
        self,
        ids: Ids,
        percent: Floats,
        crashed: Bools | None = None,
        restarts: Bools | None = None,
        hold_s: Floats | None = None,
    ) -> None:
        """Put learners back, as `Race.put_back` does; while they are held, their rivals cannot run into them."""
        super().put_back(ids, percent, crashed, restarts, hold_s)
        self._update_opponents(ids)

    def put_rivals_back(
        self,
        ids: Ids,
        percent: Floats,
        crashed: Bools | None = None,
        restarts: Bools | None = None,
        hold_s: Floats | None = None,
    ) -> None:
        """Put rivals back, as `Race.put_back` does."""
        self.rival.put_back(ids, percent, crashed, restarts, hold_s)
        self._update_opponents(ids)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything the next steps of both cars depend on, except the rivals' policies."""
        return {
            **super().state_dict(),
            "rival": self.rival.state_dict(),
            "rival_share": self._share.copy(),
            "rival_pace": self.rival.pace.copy(),
            "rival_percent": self._rival_percent.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`, as `Race.load_state_dict` does."""
        super().load_state_dict(state)
        self.rival.load_state_dict(state["rival"])
        self._share = checked_array(state, "rival_share", self._share.shape)
        self.rival.pace = checked_array(state, "rival_pace", self._share.shape)
        self._rival_percent = checked_array(state, "rival_percent", self._rival_percent.shape)

    def _update_opponents(self, ids: Ids) -> None:
        """Show the cars `ids` and their rivals to each other."""
        assert isinstance(self.rival.others, RaceRival)
        mine, theirs = self._batch.read(), self.rival._batch.read()
        self.others.show(ids, theirs, self.rival.others.serving)
        self.rival.others.show(ids, mine, self.others.serving)

    def _rivals_actions(self) -> np.ndarray:
        policies, seen = self._policies, self.rival.seen
        which = (self._share * len(policies)).astype(np.intp)
        actions: np.ndarray | None = None
        with torch.no_grad():
            for number in np.unique(which).tolist():
                rows = np.flatnonzero(which == number)
                read = {key: torch.from_numpy(values[rows]) for key, values in seen.items()}
                acted = _likeliest(policies[number], TensorDict(read, [len(rows)])).numpy()
                if actions is None:
                    actions = np.empty((self.n_cars, *acted.shape[1:]), acted.dtype)
                actions[rows] = acted
        assert actions is not None, "`drive_with` gives the rivals a policy"
        return actions

    def _put_lost_rivals_back(self, pause_s: float) -> None:
        row = self.rival.trace
        status = row[:, _STATUS]
        lost = np.flatnonzero((status > _GOING) & (status != _PAUSE) & (status != _LAP))
        if len(lost):
            percent = np.maximum(self._rival_percent[lost], 0.0)
            held = np.full(len(lost), pause_s)
            self.put_rivals_back(lost, percent, status[lost] == _CRASHED, None, held)
        # Beyond the border another section may be closer: a rival continues from its last progress on the track.
        on_track = np.ones(self.n_cars, bool)
        on_track[lost] = False
        self._rival_percent = np.where(
            on_track, np.where(status == _LAP, 0.0, row[:, _PROGRESS]), self._rival_percent
        )


def _likeliest(policy: torch.nn.Module, seen: TensorDict) -> torch.Tensor:
    """Return a policy's likeliest actions, of a continuous one the means."""
    get_dist = getattr(policy, "get_dist", None)
    if get_dist is None:
        return policy(seen)["action"]
    # Calling the policy would compute log-probabilities as well, which takes as long as the rest.
    distribution = get_dist(seen)
    mode: torch.Tensor = (
        distribution.mode if isinstance(distribution, Categorical) else distribution.deterministic_sample
    )
    return mode
