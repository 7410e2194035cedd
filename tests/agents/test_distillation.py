import copy
import dataclasses

import pytest
import torch
from torch.distributions import kl_divergence

from deepracer_exp.agents.ppo import Distillation

from .test_ppo import KINDS, drive, make, parameters, train


def taught(shared=False, actions=3, seed=0, iterations=20):
    networks, ppo = make(shared, actions, seed)
    teacher, of_teacher = make(False, actions, seed=7)
    train(teacher, of_teacher, 3)
    config = dataclasses.replace(ppo.config, teacher_iterations=iterations, teacher_batch_size=32)
    return networks, Distillation(networks, config, ppo.schedule, seed, teacher.policy), teacher


@pytest.mark.parametrize(("shared", "actions"), KINDS)
def test_it_comes_to_act_as_the_teacher_would_like_best(shared, actions):
    networks, pupil, teacher = taught(shared, actions)
    before = parameters(teacher).clone()
    losses = [pupil.update(drive(networks, seed=seed), seed, 0.0).policy_loss for seed in range(20)]
    assert losses[-1] < 0.3 * losses[0]
    seen = drive(networks, seed=99).select("observation")
    with torch.no_grad():
        theirs, ours = teacher.policy.get_dist(seen), networks.policy.get_dist(seen)
        if actions:
            assert (theirs.probs.argmax(-1) == ours.probs.argmax(-1)).float().mean() > 0.85
        else:
            assert (theirs.mean - ours.mean).abs().mean() < 0.1
            assert (ours.base_dist.stddev < theirs.base_dist.stddev).all()
        assert torch.isfinite(kl_divergence(theirs, ours)).all()
    assert torch.equal(parameters(teacher), before)


def test_after_its_iterations_it_is_ppo_bit_for_bit():
    networks, pupil, _ = taught(iterations=1)
    pupil.update(drive(networks), 0, 0.0)
    same, ppo = make(seed=3)
    ppo.load_state_dict(copy.deepcopy(pupil.state_dict()))
    for iteration in (1, 2):
        batch = drive(networks, seed=iteration)
        assert pupil.update(batch.clone(), iteration, 0.0) == ppo.update(batch.clone(), iteration, 0.0)
    assert torch.equal(parameters(networks), parameters(same))
