import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.modules import IndependentNormal

from deepracer_exp.collectors.car_worker import NOISE, SamplingPolicy, _drawn


@pytest.fixture
def noise():
    return torch.randn(200_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_actions_are_drawn_as_often_as_their_probabilities_say(noise):
    wanted = torch.tensor([0.5, 0.0, 0.3, 0.15, 0.05])
    distribution = Categorical(probs=wanted.expand(len(noise), -1))
    action, log_prob = _drawn(distribution, noise[:, :1])
    assert torch.equal(log_prob, distribution.log_prob(action))
    found = torch.bincount(action, minlength=5) / len(noise)
    assert found[1] == 0
    assert (found - wanted).abs().max() < 0.005


def test_steering_and_speed_have_the_mean_and_deviation_of_the_policy(noise):
    loc, scale = torch.tensor([0.25, -1.0]), torch.tensor([0.5, 0.125])
    distribution = IndependentNormal(loc.expand(len(noise), 2), scale.expand(len(noise), 2))
    action, log_prob = _drawn(distribution, noise)
    assert torch.equal(log_prob, distribution.log_prob(action))
    assert action.dtype == torch.float32
    assert (action.mean(0) - loc).abs().max() < 0.005
    assert (action.std(0) / scale - 1).abs().max() < 0.01


@pytest.mark.parametrize("network", ["mlp_small", "mlp_small_shared"])
@pytest.mark.parametrize("space", ["discrete", "continuous"])
def test_it_writes_an_action_and_its_probability_as_the_policy_does(driver_of, network, space):
    torch.manual_seed(0)  # the bound below is of these values
    policy = driver_of(f"network={network}", f"action_space={space}").policy
    features = next(p for p in policy.parameters() if p.ndim == 2).shape[1]
    seen = TensorDict({"observation": torch.randn(8, features)}, [8])
    plain = policy(seen.clone())
    noise = torch.randn(8, 1 if space == "discrete" else 2, dtype=torch.float64)
    drawn = SamplingPolicy(policy)(seen.clone().set(NOISE, noise))
    assert set(drawn.keys()) == {"observation", NOISE, "action", "action_log_prob"}
    for key in ("action", "action_log_prob"):
        assert (drawn[key].shape, drawn[key].dtype) == (plain[key].shape, plain[key].dtype), key
    log_prob = policy.get_dist(seen.clone()).log_prob(drawn["action"])
    torch.testing.assert_close(drawn["action_log_prob"], log_prob, rtol=0, atol=2e-6)
