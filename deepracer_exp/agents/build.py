"""The algorithm of an experiment, and the networks that it trains."""

import torch

from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import (
    AlgorithmConfig,
    LRScheduleConfig,
    NetworkConfig,
    PPOConfig,
    SACConfig,
)
from deepracer_exp.config.own_class import OwnClass, build_own

from .actor_critic import ActorCritic, PolicyNetworks, build_actor_critic
from .algorithm import Algorithm
from .ppo import PPO
from .sac import SAC
from .schedules import build_schedule
from .soft_actor_critic import SoftActorCritic, build_soft_actor_critic

_CPU = torch.device("cpu")


def build_networks(
    network: NetworkConfig,
    algorithm: AlgorithmConfig,
    observed: ObservationShape,
    action_count: int | None,
    generator: torch.Generator | None,
) -> PolicyNetworks:
    """Build the networks of an algorithm; arguments and errors as for `build_actor_critic`."""
    if isinstance(algorithm, SACConfig):
        return build_soft_actor_critic(network, observed, action_count, generator)
    return build_actor_critic(network, observed, action_count, generator)


def build_agent(
    networks: PolicyNetworks,
    config: AlgorithmConfig,
    lr_schedule: LRScheduleConfig,
    seed: int,
    device: torch.device = _CPU,
) -> Algorithm:
    """Return the algorithm of the group `algorithm`, with its learning-rate schedule.

    It updates the networks in place, on `device`; a class of the user's own chooses that itself.

    Raises:
        BadInput: a class of the user's own cannot be used.
    """
    schedule = build_schedule(lr_schedule)
    if isinstance(config, SACConfig):
        assert isinstance(networks, SoftActorCritic)
        return SAC(networks, config, schedule, seed, device)
    assert isinstance(networks, ActorCritic)
    assert isinstance(config, PPOConfig)
    if config.target is None:
        return PPO(networks, config, schedule, seed, device)
    described = OwnClass(target=config.target, kwargs=config.kwargs)
    # Its constructor may draw weights; the global random state has no part in them.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        agent: Algorithm = build_own(
            described, "algorithm.target", Algorithm, networks, config, schedule, seed
        )
    return agent
