"""Our networks and the service's tensors are the same function."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from tensordict import TensorDict

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.service_weights import POLICY, VALUE, from_service, match_service, to_service
from deepracer_exp.config.driving import ObservationShape
from deepracer_exp.config.learning import CNNConfig
from deepracer_exp.errors import BadInput
from tests.conftest import refused

CAMERA = "FRONT_FACING_CAMERA"
SENSORS = {
    "camera": (CAMERA,),
    "stereo": ("STEREO_CAMERAS",),
    "camera and LIDAR": (CAMERA, "LIDAR"),
    # Its name comes before that of the camera.
    "camera and discretized LIDAR": (CAMERA, "DISCRETIZED_SECTOR_LIDAR"),
    "LIDAR before stereo": ("STEREO_CAMERAS", "SECTOR_LIDAR"),
}
NETWORK = CNNConfig(
    filters=(6, 5, 7),
    kernels=(8, 4, 1),
    strides=(4, 2, 1),
    hidden=(12, 9),
    activation="relu",
    critic="pictures",
    shared_trunk=False,
    initial_std=0.3,
    lidar_hidden=(8, 4),
)


def build(sensors, actions=5, seed=0, **changes):
    stereo = "STEREO_CAMERAS" in sensors
    observed = ObservationShape(11, (1 + stereo, 60, 80), 16 if len(sensors) > 1 else None)
    networks = build_actor_critic(
        replace(NETWORK, **changes), observed, actions, torch.Generator().manual_seed(seed)
    )
    with torch.no_grad():
        for parameter in networks.parameters():  # biases begin at zero
            parameter += 0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(seed))
    return networks


def services_output(tensors, scope, head, sensed):
    """Compute what the graph of the service does, from its own order of axes."""
    weights = lambda name: (tensors[f"{name}/kernel"], tensors[f"{name}/bias"])  # noqa: E731
    embedded = []
    for sensor in sorted(sensed):
        values = sensed[sensor]
        layers = sorted({name.split("/")[6] for name in tensors if f"{scope}/{sensor}/" in name})
        for layer in layers:
            kernel, bias = weights(f"{scope}/{sensor}/{layer}")
            if layer.startswith("Conv2d"):
                stride = {8: 4, 4: 2}[len(kernel)]
                windows = sliding_window_view(values, kernel.shape[:2], axis=(1, 2))[:, ::stride, ::stride]
                values = np.einsum("nhwcij,ijco->nhwo", windows, kernel, optimize=True) + bias
            else:
                values = values @ kernel + bias
            values = np.maximum(values, 0)
        embedded.append(values.reshape(len(values), -1))
    values = np.concatenate(embedded, axis=1)
    for number in (0, 2):
        kernel, bias = weights(f"{scope}/middleware_fc_embedder/Dense_{number}")
        values = np.maximum(values @ kernel + bias, 0)
    kernel, bias = weights(f"{scope}/{head}")
    return values @ kernel + bias


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("sensors", SENSORS.values(), ids=SENSORS)
def test_the_services_graph_of_our_tensors_gives_our_outputs(sensors, shared):
    networks = build(sensors, shared_trunk=shared)
    generator = torch.Generator().manual_seed(1)
    pictures = torch.randint(
        0, 256, (3, 1 + (sensors[0] != CAMERA), 60, 80), generator=generator, dtype=torch.uint8
    )
    readings = torch.rand(3, 16, generator=generator)
    steps = TensorDict({"pixels": pictures, "lidar": readings}, [3])
    for module in networks.modules():
        if hasattr(module, "half_precision"):
            module.half_precision = False
    sensed = {sensors[0]: pictures.permute(0, 2, 3, 1).numpy().astype(np.float64) / 255}
    if len(sensors) > 1:
        sensed[sensors[1]] = readings.numpy().astype(np.float64)
    tensors = to_service(networks, sensors)
    policy = services_output(tensors, POLICY, "ppo_head_0/policy_fc", sensed)
    value = services_output(tensors, VALUE, "v_values_head_0/output", sensed)
    with torch.no_grad():
        np.testing.assert_allclose(networks.policy(steps.clone())["logits"], policy, atol=1e-5)
        np.testing.assert_allclose(networks.value(steps.clone())["state_value"], value, atol=1e-5)


@pytest.mark.parametrize("actions", [5, None])
@pytest.mark.parametrize("sensors", SENSORS.values(), ids=SENSORS)
def test_the_way_there_and_back_changes_no_bit(sensors, actions):
    networks, others = build(sensors, actions), build(sensors, actions, seed=1)
    tensors = to_service(networks, sensors)
    from_service(tensors, others, sensors, "model")
    theirs = others.state_dict()
    assert all(torch.equal(value, theirs[name]) for name, value in networks.state_dict().items())


def test_tensors_of_a_newer_numbering_and_another_agent_are_found_by_order_and_shape():
    networks, others = build((CAMERA,)), build((CAMERA,), seed=1)
    numbers = {"Conv2d_0": "conv2d", "Conv2d_2": "conv2d_10", "Dense_0": "Dense_3", "Dense_2": "Dense_11"}
    renamed = {}
    for name, value in to_service(networks, (CAMERA,)).items():
        for ours, theirs in numbers.items():
            name = name.replace(ours, theirs)
        renamed[name.replace("/agent/", "/agent_0/")] = value
    from_service(renamed, others, (CAMERA,), "model")
    theirs = others.state_dict()
    assert all(torch.equal(value, theirs[name]) for name, value in networks.state_dict().items())


def test_a_frozen_graph_has_no_value_network_and_no_standard_deviation():
    networks, others = build((CAMERA,), None), build((CAMERA,), None, seed=1)
    before = {name: value.clone() for name, value in others.value_head.state_dict().items()}
    tensors = {name: value for name, value in to_service(networks, (CAMERA,)).items() if POLICY in name}
    del tensors[f"{POLICY}/ppo_head_0/policy_log_std"]
    from_service(tensors, others, (CAMERA,), "model")
    absent = match_service(tensors, others, (CAMERA,), "model")[1]
    assert absent == [VALUE, f"{POLICY}/ppo_head_0/policy_log_std"]
    assert all(torch.equal(value, before[name]) for name, value in others.value_head.state_dict().items())
    assert torch.equal(
        others.policy_head[0].module[0].perceptron[0].weight,
        networks.policy_head[0].module[0].perceptron[0].weight,
    )


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (f"{POLICY}/{CAMERA}/Conv2d_2/kernel", None, ("has no tensor", "Conv2d_2/kernel", "[4, 4, 6, 5]")),
        (f"{VALUE}/middleware_fc_embedder/Dense_0/bias", np.zeros(13), ("[13]", "accepted: [12]")),
        (f"{POLICY}/{CAMERA}/Conv2d_0/bias", np.full(6, np.nan), ("Conv2d_0/bias", "not finite")),
        (f"{VALUE}/{CAMERA}/Conv2d_0/bias".replace("agent", "agent_1"), np.zeros(6), ("second agent",)),
        ("main_level/agent/main/online/extra/kernel", np.zeros(3), ("extra/kernel", "no layer for")),
    ],
    ids=["missing", "shape", "NaN", "another agent", "foreign"],
)  # fmt: skip
def test_what_does_not_fit_is_named(name, value, words):
    tensors = to_service(build((CAMERA,)), (CAMERA,))
    tensors.pop(name, None)
    if value is not None:
        tensors[name] = value.astype(np.float32)
    message = refused(from_service, tensors, build((CAMERA,)), (CAMERA,), "model.ckpt")
    for word in ("model.ckpt: ", *words):
        assert word in message


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"activation": "elu"}, "relu"), ({"attention": 4}, "Attention"), ({"lidar_joins_after": 1}, "LIDAR")],
)
def test_layers_that_the_service_does_not_have_are_refused(changes, words):
    with pytest.raises(BadInput, match=words):
        to_service(build((CAMERA, "LIDAR"), **changes), (CAMERA, "LIDAR"))


def test_without_a_value_network_that_sees_there_are_the_policys_tensors_alone():
    tensors = to_service(build((CAMERA,), critic="features"), (CAMERA,))
    assert tensors
    assert all(name.startswith(POLICY) for name in tensors)
