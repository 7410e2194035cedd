"""Agents that differ by a number, for checkpoints of them."""

import torch

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.schedules import PresetSchedule
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape

TINY, _ = compose_experiment(["experiment=tiny"])


def make_agent(seed: int) -> PPO:
    """Return an agent of the tiny experiment whose weights are all this number, whatever the process's threads."""
    shapes = observation_shape(TINY.observation), build_action_space(TINY.action_space).n
    networks = build_actor_critic(TINY.network, *shapes, torch.Generator().manual_seed(seed))
    with torch.no_grad():
        for parameter in networks.parameters():
            parameter.fill_(seed)
    return PPO(networks, TINY.algorithm, PresetSchedule(TINY.lr_schedule), seed)
