"""The compiled inner loop does what TorchRL's loss, autograd and PyTorch's Adam do."""

import itertools
import math

import pytest
import torch
from torch import nn
from torchrl.modules import MLP
from torchrl.objectives import ClipPPOLoss

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.inner_loop import InnerLoop
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import MLPConfig
from deepracer_exp.errors import RunFailed

from .test_ppo import drive, make, parameters, train

ACTIVATIONS = ("relu", "tanh", "elu", "silu")


def networks_of(activation: str, actions: int | None, hidden: tuple[int, ...] = (16, 12)):
    network = MLPConfig(hidden=hidden, activation=activation, shared_trunk=False, initial_std=0.5)
    return build_actor_critic(network, ObservationShape(4), actions, torch.Generator().manual_seed(3))


def batch_of(networks, spread: float):
    """Return steps whose probabilities have changed since: some ratios are clipped on either side."""
    steps = drive(networks).reshape(-1)
    generator = torch.Generator().manual_seed(5)
    noise = torch.randn(len(steps), generator=generator)
    steps["action_log_prob"] = steps["action_log_prob"] + spread * noise
    steps["advantage"] = torch.randn(len(steps), 1, generator=generator)
    steps["value_target"] = 3 * torch.randn(len(steps), 1, generator=generator)
    return steps


@pytest.mark.parametrize("loss_type", ["huber", "mean squared error"])
@pytest.mark.parametrize(("activation", "actions"), list(itertools.product(ACTIVATIONS, (3, None))))
def test_its_gradient_and_losses_are_those_of_autograd(activation, actions, loss_type):
    networks = networks_of(activation, actions)
    _, ppo = make(actions=actions, loss_type=loss_type, entropy_coeff=0.02, max_grad_norm=0.0)
    ppo = PPO(networks, ppo.config, ppo.schedule, 0)
    steps = batch_of(networks, spread=0.3)
    losses = ppo.loss(steps)
    (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
    expected = {name: parameter.grad.clone() for name, parameter in networks.named_parameters()}
    names = {parameter: name for name, parameter in networks.named_parameters()}
    columns = [steps[key] for key in ("observation", "action", "action_log_prob")]
    columns += [steps[key].squeeze(-1) for key in ("advantage", "value_target")]
    (row,) = ppo._inner_loop.run(columns, len(steps), 0.0, 0.02).tolist()
    for parameter, gradient in ppo._inner_loop.gradients.items():
        wanted = expected[names[parameter]]
        assert (torch.from_numpy(gradient) - wanted).norm() <= 1e-5 * wanted.norm()
    assert 0.2 < losses["clip_fraction"] < 0.8
    kl = losses["mean_ratio"] - 1 + losses["kl_approx"]
    norm = math.sqrt(sum(gradient.square().sum() for gradient in expected.values()))
    keys = ("loss_objective", "loss_critic", "entropy", "clip_fraction")
    assert row == pytest.approx([*(losses[key].item() for key in keys), kl.item(), norm], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("actions", [3, None])
def test_many_updates_end_where_those_of_torchrls_loss_do(actions):
    networks, ppo = make(actions=actions)
    same, plain = make(actions=actions, compiled=False)
    assert plain._inner_loop is None
    assert (str(ppo), str(plain)) == ("PPO, compiled", "PPO, by its loss in autograd")
    train(networks, ppo, 5)
    train(same, plain, 5)
    assert (parameters(networks) - parameters(same)).norm() < 1e-3 * parameters(same).norm()
    assert int(ppo.state_dict()["optimizer"]["state"][0]["step"]) == int(
        plain.state_dict()["optimizer"]["state"][0]["step"]
    )


@pytest.mark.parametrize("actions", [3, None])
def test_two_threads_make_the_same_steps_bit_for_bit(actions):
    (networks, alone), (same, shared) = make(actions=actions), make(actions=actions)
    shared.threads = 2
    train(networks, alone, 5)
    train(same, shared, 5)
    assert torch.equal(parameters(networks), parameters(same))


def test_a_scale_at_its_lower_limit_stays_there():
    networks, ppo = make(actions=None)
    scale = networks.policy_head[0].module[-1].state_independent_scale
    with torch.no_grad():
        scale.fill_(-12.0)
    train(networks, ppo, 1)
    assert scale.tolist() == [-12.0, -12.0]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_step_that_is_not_finite_is_not_made_and_named(threads):
    networks, ppo = make()
    ppo.threads = threads
    batch = drive(networks)
    steps, _ = ppo._prepare(batch)
    steps["advantage"][3] = math.inf
    before = parameters(networks).clone()
    with pytest.raises(RunFailed, match="the gradient step was not made"):
        ppo._epoch(ppo._inner_loop, steps, torch.arange(64), 64, 1e-3, 0.0)
    assert torch.equal(parameters(networks), before)


class Squared(MLP):
    def forward(self, *inputs):
        return super().forward(*inputs).square()


@pytest.mark.parametrize(
    "own",
    [
        nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 8), nn.Tanh(), nn.Linear(8, 1)),
        nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 1), nn.Tanh()),
        Squared(4, 1, num_cells=[8], activation_class=nn.ReLU),
        MLP(4, 1, num_cells=[8], activation_class=nn.ReLU, activate_last_layer=True),
        MLP(4, 1, num_cells=[8], activation_class=nn.ELU, activation_kwargs={"alpha": 2.0}),
        MLP(4, 1, num_cells=[8], activation_class=nn.ReLU, bias_last_layer=False),
        MLP(4, 1, num_cells=[8], activation_class=nn.GELU),
    ],
    ids=["two activations", "no sequence of ours", "forward", "activated end", "alpha", "no bias", "gelu"],
)
def test_another_network_is_left_to_autograd(own):
    networks, _ = make()
    assert InnerLoop.fits(networks)
    networks.value_head.module = own
    assert not InnerLoop.fits(networks)


def test_what_it_does_not_fit_is_left_to_autograd():
    class Own(PPO):
        def loss(self, minibatch):
            return super().loss(minibatch)

    networks, ppo = make()
    assert ppo._inner_loop is not None
    assert Own(networks, ppo.config, ppo.schedule, 0)._inner_loop is None
    assert make(shared=True)[1]._inner_loop is None
    assert not InnerLoop.fits(make(shared=True)[0])
    assert isinstance(ppo._loss, ClipPPOLoss)
