from dataclasses import replace

import pytest
import torch

from deepracer_exp.agents.actor_critic import SensorNet
from deepracer_exp.agents.convolutions import PART
from deepracer_exp.config.compose import compose_option
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import CNNConfig

GREY = (1, 120, 160)


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def sensor_net(name="cnn_small", picture=GREY, half_precision=False, **changes):
    torch.manual_seed(0)
    config = replace(compose_option("network", name, CNNConfig), **changes)
    net = SensorNet(config, ObservationShape(11, picture), 3)
    net.half_precision = half_precision
    return net


def outputs_and_gradients(net, pictures, forward):
    """Return outputs and, flat, the gradients of a loss that weighs each output of each picture differently."""
    outputs = forward(pictures)
    weights = torch.linspace(0.5, 1.5, outputs.numel()).view_as(outputs)
    gradients = torch.autograd.grad((weights * outputs).sum(), list(net.parameters()))
    return outputs.detach(), torch.cat([gradient.flatten() for gradient in gradients])


def plainly(net):
    """Return the network's layers one after the other, as they are configured, in float32."""
    return lambda pictures: net.perceptron(net.convolutions(pictures / 255).flatten(1))


def relative_error(values, expected):
    return float((values - expected).norm() / expected.norm())


@pytest.mark.parametrize(
    ("name", "picture", "changes"),
    [
        ("cnn_small", GREY, {}),
        ("cnn_small", GREY, {"activation": "silu"}),
        ("cnn_small", (3, 48, 64), {}),
        ("cnn_small", (2, 50, 66), {}),  # not whole blocks
        ("cnn_small", (1, 60, 81), {"strides": (3, 2, 1)}),
        ("cnn_small", (1, 48, 64), {"strides": (8, 1, 1), "kernels": (16, 2, 2)}),
        ("cnn_small", (1, 32, 32), {"strides": (1, 2, 1)}),
        ("medium", GREY, {"hidden": (32,)}),  # a kernel of two and a half blocks
        ("attention", GREY, {}),
        ("deep", GREY, {}),
    ],
)
def test_a_network_of_pictures_computes_what_its_layers_say(name, picture, changes):
    net = sensor_net(name, picture, **changes)
    pictures = torch.randint(0, 256, (3, *picture), dtype=torch.uint8)
    expected, expected_gradients = outputs_and_gradients(net, pictures, plainly(net))
    outputs, gradients = outputs_and_gradients(net, pictures, net)
    with torch.no_grad():
        assert torch.equal(net(pictures), outputs)
    assert relative_error(outputs, expected) < 1e-5
    assert relative_error(gradients, expected_gradients) < 1e-5


@pytest.mark.parametrize("name", ["cnn_small", "shallow"])
def test_half_precision_is_as_near_to_the_layers_as_rounding_allows(name):
    net = sensor_net(name, half_precision=True)
    pictures = torch.randint(0, 256, (8, *GREY), dtype=torch.uint8)
    expected, expected_gradients = outputs_and_gradients(net, pictures, plainly(net))
    with torch.autocast("cpu", torch.bfloat16):
        rounded, rounded_gradients = outputs_and_gradients(
            net, pictures, lambda pictures: plainly(net)(pictures).float()
        )
    outputs, gradients = outputs_and_gradients(net, pictures, net)
    assert relative_error(outputs, expected) < 1.2 * relative_error(rounded, expected) < 0.03
    assert (
        relative_error(gradients, expected_gradients)
        < 1.2 * relative_error(rounded_gradients, expected_gradients)
        < 0.08
    )


@pytest.mark.parametrize("half_precision", [False, True])
def test_pictures_in_parts_on_threads_give_the_same_bits(threads, half_precision):
    net = sensor_net(picture=(1, 32, 32), strides=(4, 1, 1), kernels=(8, 2, 2), half_precision=half_precision)
    pictures = torch.randint(0, 256, (2 * PART + 3, 1, 32, 32), dtype=torch.uint8)
    convolutions = sum(weight.numel() for weight in net.convolutions.parameters())
    expected, expected_gradients = outputs_and_gradients(net, pictures, plainly(net))
    found = []
    for number in (1, 3):
        threads(number)
        outputs, gradients = outputs_and_gradients(net, pictures, net)
        assert relative_error(outputs, expected) < (0.03 if half_precision else 1e-5)
        assert relative_error(gradients, expected_gradients) < (0.05 if half_precision else 1e-5)
        found.append(gradients[:convolutions])
    assert torch.equal(*found)


def test_two_losses_of_the_same_outputs_have_their_gradients():
    net = sensor_net(picture=(1, 32, 32), strides=(4, 1, 1), kernels=(8, 2, 2))
    outputs = net(torch.randint(0, 256, (5, 1, 32, 32), dtype=torch.uint8))
    weights = list(net.parameters())
    both = torch.autograd.grad(outputs.sum() + outputs.square().sum(), weights, retain_graph=True)
    first = torch.autograd.grad(outputs.sum(), weights, retain_graph=True)
    second = torch.autograd.grad(outputs.square().sum(), weights)
    for whole, one, other in zip(both, first, second, strict=True):
        assert torch.allclose(whole, one + other, rtol=1e-4, atol=1e-6)


def test_frozen_layers_get_no_gradients():
    net = sensor_net(picture=(1, 32, 32), strides=(4, 1, 1), kernels=(8, 2, 2))
    net.convolutions.requires_grad_(False)
    net.convolutions[2].weight.requires_grad_(True)
    net(torch.randint(0, 256, (5, 1, 32, 32), dtype=torch.uint8)).sum().backward()
    assert [weight.grad is not None for weight in net.convolutions.parameters()] == [
        weight.requires_grad for weight in net.convolutions.parameters()
    ]
