"""Our networks' parameters as tensors of the service's TensorFlow models: their names and layouts.

Source: deepracer-simapp, `rl_coach/architectures/tensorflow_components` (embedder, general_network, heads, savers), and
the index of a checkpoint of the AWS console.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from tensordict.nn import AddStateIndependentNormalScale
from torch import nn

from deepracer_exp.aws.archives import natural
from deepracer_exp.aws.models.model_metadata import CAMERAS, LIDARS
from deepracer_exp.errors import BadInput

from .actor_critic import CONTINUOUS_ACTION_SIZE, INITIAL_STD, ActorCritic, PolicyNetworks, SensorNet
from .soft_actor_critic import BoundedGaussian

Array = npt.NDArray[np.float32]

ONLINE = "main_level/agent/main/online"
VALUE, POLICY = f"{ONLINE}/network_0", f"{ONLINE}/network_1"
"""Scopes of the two networks; the graph's inputs are in the first."""
VALUE_HEAD = f"{VALUE}/v_values_head_0/output"
POLICY_HEAD = f"{POLICY}/ppo_head_0"
_LOG_STD = f"{POLICY_HEAD}/policy_log_std"
SAC_HIDDEN = 256
"""Units of the hidden layer of the head of the service's SAC policy (deepracer-simapp, `heads/sac_head.py`)."""
_SAC_POLICY = re.compile(r"main_level/agent(?:_\d+)?/policy/(?:online|global)/network_0/(.+)")
_SAC_HEAD = "sac_policy_head_0/"
_RESCALER = "gradients_from_head_0-0_rescalers"
"""A gradient scale that the service keeps among the weights of each network; always 1."""
_LOG_STD_RANGE = (-20.0, 3.0)
"""Range to which the service clips the logarithm of the standard deviation."""
_UNUSED = re.compile(r"/target/|/(?:Adam(?:_1)?|Variable|global_step)$|(?:^|/)beta[12]_power$")
"""Tensors that are not weights of the driving networks: target networks, optimizer, counters."""


class _Layer(NamedTuple):
    name: str
    """The service's name, without `/kernel` and `/bias`."""
    module: nn.Linear | nn.Conv2d
    inputs: npt.NDArray[np.int64] | None = None
    """Our index of each of the service's inputs; None: the same order."""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the service's tensors by name."""
        outputs, inputs, *places = self.module.weight.shape
        places = [] if "/Dense_" in self.name else places
        return {f"{self.name}/kernel": (*places, inputs, outputs), f"{self.name}/bias": (outputs,)}

    def to_service(self) -> tuple[Array, Array]:
        weight = self.module.weight.detach().numpy()
        if weight.ndim == 4:  # OIHW -> HWIO
            weight = weight.transpose(2, 3, 1, 0)
            kernel = weight[0, 0] if "/Dense_" in self.name else weight
        else:
            kernel = weight.T if self.inputs is None else weight.T[self.inputs]
        return np.ascontiguousarray(kernel), self.module.bias.detach().numpy().copy()  # type: ignore[union-attr]

    def from_service(self, kernel: Array, bias: Array) -> None:
        weight = kernel.reshape(1, 1, *kernel.shape) if kernel.ndim == 2 else kernel
        if isinstance(self.module, nn.Conv2d):
            weight = weight.transpose(3, 2, 0, 1)
        elif self.inputs is None:
            weight = kernel.T
        else:
            weight = np.empty_like(kernel)
            weight[self.inputs] = kernel
            weight = weight.T
        with torch.no_grad():
            # Copies, because arrays over a file's bytes are read-only.
            self.module.weight.copy_(torch.from_numpy(weight.copy()))
            self.module.bias.copy_(torch.from_numpy(bias.copy()))  # type: ignore[union-attr]


def to_service(networks: PolicyNetworks, sensors: Sequence[str]) -> dict[str, Array]:
    """Convert the parameters to the service's tensors, by name.

    `sensors` are the names of the camera and the LIDAR as in model_metadata.json.

    Kernels of convolutions are [height, width, in, out] and those of dense layers [in, out]; pictures are flattened row
    by row with all channels of a pixel together; the readings of sensors follow each other in the order of their names.
    Convolutions of 1x1 at the end of a picture's layers are the service's dense layers of an embedder, which it applies
    to each pixel. A trunk that both share is written twice. If the value network's inputs differ from the policy's,
    only the policy's tensors are returned, as for soft actor-critic, whose mean has the name of PPO's and comes before
    the hyperbolic tangent.

    Raises:
        BadInput: the networks have layers that the service's do not.
    """
    layers, scale = _layers(networks, sensors)
    tensors = {}
    for layer in layers:
        tensors[f"{layer.name}/kernel"], tensors[f"{layer.name}/bias"] = layer.to_service()
    if isinstance(networks.policy_head[0].module, BoundedGaussian):
        for part in ("kernel", "bias"):
            both = tensors[f"{POLICY_HEAD}/policy_mean/{part}"]
            tensors[f"{POLICY_HEAD}/policy_mean/{part}"] = both[..., :CONTINUOUS_ACTION_SIZE].copy()
    for scope in sorted({_scope(name) for name in tensors}):
        tensors[f"{scope}/{_RESCALER}"] = np.ones((), np.float32)
    if scale is not None:
        log_std = scale.state_independent_scale.detach().numpy()
        tensors[_LOG_STD] = log_std.reshape(1, -1).copy()
    return dict(sorted(tensors.items()))


def policy_of_sac(tensors: Mapping[str, Array], where: str) -> dict[str, Array]:
    """Return the policy among the tensors of the service's SAC, by the names that `to_service` gives to ours.

    The head of the service's policy begins with a hidden layer, here the last of the trunk; its means and the
    logarithms of its deviations come from a layer each, ours from one. A frozen graph has no deviations: they are
    `INITIAL_STD`.
    The critics are left out, because the service's see actions in degrees and metres per second, and so is the network
    for the value of a state, which ours have not.

    Args:
        tensors: by the service's names.
        where: file of the tensors, for messages.

    Raises:
        BadInput: there is no such policy, or its head has other layers.
    """
    policy: dict[str, Array] = {}
    for name, value in tensors.items():
        match = _SAC_POLICY.fullmatch(name)
        if match is None or _UNUSED.search(name):
            continue
        if match[1] in policy:
            raise BadInput(where, f"{name}: is of a second agent", "a model of one")
        policy[match[1]] = value
    head = {
        name.removeprefix(_SAC_HEAD): policy.pop(name) for name in [*policy] if name.startswith(_SAC_HEAD)
    }
    mean = head.get("policy_mean/kernel")
    if mean is None or mean.ndim != 2 or "policy_mean/bias" not in head:
        raise BadInput(
            where, f"has no {_SAC_HEAD}policy_mean", "a model of SAC, as its model_metadata.json says"
        )
    layers = sorted({name.rpartition("/")[0] for name in head} - {"policy_mean"}, key=natural)
    hidden = [layer for layer in layers if _outputs(head, layer) == len(mean) != mean.shape[1]]
    spread = [layer for layer in layers if _outputs(head, layer) == mean.shape[1]]
    if len(hidden) != 1 or len(spread) > 1 or len(layers) != len(hidden) + len(spread):
        raise BadInput(
            where, f"{_SAC_HEAD[:-1]}: has the layers {', '.join(layers)}", "a hidden layer and deviations"
        )
    matched = {f"{POLICY}/{name}": value for name, value in policy.items()}
    for part in ("kernel", "bias"):
        # Behind all others in the order of the layers.
        matched[f"{POLICY}/middleware_fc_embedder/Dense_1000000/{part}"] = head[f"{hidden[0]}/{part}"]
        means = head[f"policy_mean/{part}"]
        fresh = np.full_like(means, 0.0 if part == "kernel" else np.log(INITIAL_STD))
        deviations = head[f"{spread[0]}/{part}"] if spread else fresh
        matched[f"{POLICY_HEAD}/policy_mean/{part}"] = np.concatenate([means, deviations], axis=-1)
    return matched


def _outputs(tensors: Mapping[str, Array], layer: str) -> int:
    """Return the number of outputs of a dense layer, -1 for any other."""
    kernel, bias = tensors.get(f"{layer}/kernel"), tensors.get(f"{layer}/bias")
    is_dense = kernel is not None and bias is not None and kernel.ndim == 2 and bias.shape == kernel.shape[1:]
    return kernel.shape[1] if is_dense and kernel is not None else -1


def from_service(
    tensors: Mapping[str, Array], networks: PolicyNetworks, sensors: Sequence[str], where: str
) -> None:
    """Load the service's tensors into networks; arguments and errors as for `match_service`."""
    layers, scale = _layers(networks, sensors)
    matched, _ = match_service(tensors, networks, sensors, where)
    with torch.no_grad():
        for layer in layers:
            if f"{layer.name}/kernel" in matched:
                layer.from_service(matched[f"{layer.name}/kernel"], matched[f"{layer.name}/bias"])
        if scale is not None and _LOG_STD in matched:
            clipped = np.clip(matched[_LOG_STD][0], *_LOG_STD_RANGE)
            scale.state_independent_scale.copy_(torch.from_numpy(clipped))


def match_service(
    tensors: Mapping[str, Array], networks: PolicyNetworks, sensors: Sequence[str], where: str
) -> tuple[dict[str, Array], list[str]]:
    """Find the tensor of each parameter.

    Tensors are matched by name, else by order and shape among the layers of their scope: newer versions of the service
    number layers differently.

    Args:
        tensors: by name; of any agent (`agent`, `agent_0`), online or global.
        networks: with separate trunks and the service's inputs; also on the device `meta`. Of SAC, whose tensors are
            those of `policy_of_sac`, the policy alone is matched.
        sensors: as for `to_service`.
        where: file of the tensors, for messages.

    Returns:
        The tensors by the names of `to_service`; and the parts without tensors, because a frozen graph lacks them or
        SAC has others: the value network by its scope, the standard deviation by its name.

    Raises:
        BadInput: a tensor is missing, has another shape, is not finite, or is none of these networks'.
    """
    layers, scale = _layers(networks, sensors)
    targets = {name: shape for layer in layers for name, shape in layer.shapes.items()}
    if scale is not None:
        targets[_LOG_STD] = (1, *scale.scale_shape)
    matched = _match(tensors, targets, where)
    missing = [name for name in targets if name not in matched]
    absent = [VALUE] if all(_scope(name) != VALUE for name in matched) else []
    absent += [_LOG_STD] * (_LOG_STD in missing)
    for name in missing:
        if name != _LOG_STD and _scope(name) not in absent:
            raise BadInput(where, f"has no tensor {name} of shape {list(targets[name])}")
    for name, value in matched.items():
        if not np.isfinite(value).all():
            raise BadInput(where, f"{name}: is not finite; choose another checkpoint")
    return matched, absent


def _match(
    tensors: Mapping[str, Array], targets: Mapping[str, tuple[int, ...]], where: str
) -> dict[str, Array]:
    """Return the tensors under the names of `targets`."""
    unmatched: dict[str, Array] = {}
    for name, value in tensors.items():
        ours = re.sub(r"^main_level/agent(?:_\d+)?/main/(?:online|global)/", f"{ONLINE}/", name)
        if _UNUSED.search(name) or ours.endswith(f"/{_RESCALER}"):
            continue
        if ours in unmatched:
            raise BadInput(where, f"{name}: is of a second agent", "a model of one")
        unmatched[ours] = value
    matched = {name: unmatched.pop(name) for name in targets if name in unmatched}
    for name, shape in targets.items():
        if name not in matched:
            alike = (key for key in sorted(unmatched, key=natural) if _unnumbered(key) == _unnumbered(name))
            match = next((key for key in alike if unmatched[key].shape == shape), None)
            if match is not None:
                matched[name] = unmatched.pop(match)
    for name, value in matched.items():
        if value.shape != targets[name]:
            raise BadInput(where, f"{name}: has the shape {list(value.shape)}", list(targets[name]))
    if unmatched:
        name = min(unmatched)
        raise BadInput(
            where,
            f"{name}: a tensor of shape {list(unmatched[name].shape)} that the network of these files has no layer for",
        )
    return matched


def _unnumbered(name: str) -> str:
    """Return a tensor's name without the number of its layer, `.../Conv2d_4/kernel` -> `.../conv2d/kernel`."""
    *scope, layer, kind = name.split("/")
    return "/".join([*scope, layer.lower().rstrip("0123456789_"), kind])


def _scope(name: str) -> str:
    return VALUE if name.startswith(f"{VALUE}/") else POLICY


def _layers(
    networks: PolicyNetworks, sensors: Sequence[str]
) -> tuple[list[_Layer], AddStateIndependentNormalScale | None]:
    """Return the layers in the order of the service, the value network's first, and the standard deviation."""
    policy = networks.policy_head[0].module
    value = networks.value_head.module if isinstance(networks, ActorCritic) else None
    scale, bounded = None, isinstance(policy, BoundedGaussian)
    if bounded:
        policy = policy.layers
    if isinstance(policy, nn.Sequential) and isinstance(policy[-1], AddStateIndependentNormalScale):
        policy, scale = policy
    trunk = None if networks.trunk is None else networks.trunk.module
    policy_head = f"{POLICY_HEAD}/{'policy_fc' if scale is None and not bounded else 'policy_mean'}"
    layers: list[_Layer] = []
    if isinstance(value, SensorNet) or (trunk is not None and isinstance(value, nn.Sequential)):
        layers += _trunk(trunk or value, VALUE, sensors)
        layers.append(_last(value, VALUE_HEAD))
    layers += _trunk(trunk or policy, POLICY, sensors)
    layers.append(_last(policy, policy_head))
    return layers, scale


def _last(module: nn.Module, name: str) -> _Layer:
    return _Layer(name, [layer for layer in module.modules() if isinstance(layer, nn.Linear)][-1])


def _trunk(net: nn.Module, scope: str, sensors: Sequence[str]) -> Iterator[_Layer]:
    """Yield the layers of a network up to its last hidden one."""
    if not isinstance(net, SensorNet):
        raise BadInput(
            "network: sees features or is a class of your own, and models of the service see a camera; accepted: a run "
            "with a camera and network=shallow, medium, deep or cnn_small"
        )
    readable = (nn.Conv2d, nn.Linear, nn.ReLU, nn.Sequential, nn.Identity, SensorNet)
    odd = [part for part in net.modules() if not isinstance(part, readable)]
    if odd:
        raise BadInput(
            f"network: has {type(odd[0]).__name__} layers; the service's networks have only convolutions, dense layers "
            "and network.activation=relu"
        )
    if not isinstance(net.embedder, nn.Identity):
        raise BadInput(
            "network.lidar_joins_after: not 0; in the service's networks the LIDAR joins right after the convolutions"
        )
    order: dict[str, npt.NDArray[np.int64]] = {}
    dense = [layer for layer in net.perceptron if isinstance(layer, nn.Linear)]
    readings = 0
    if net.has_lidar:
        (lidar,) = (name for name in sensors if name in LIDARS)
        alone = [layer for layer in net.lidar if isinstance(layer, nn.Linear)]
        for number, module in enumerate(alone):
            yield _Layer(f"{scope}/{lidar}/Dense_{2 * number}", module)
        readings = alone[-1].out_features
        order[lidar] = np.arange(dense[0].in_features - readings, dense[0].in_features)
    if net.has_picture:
        (camera,) = (name for name in sensors if name in CAMERAS)
        convolutions = [layer for layer in net.convolutions if isinstance(layer, nn.Conv2d)]
        seen, accepted = convolutions[0].in_channels, 2 if camera == "STEREO_CAMERAS" else 1
        if seen != accepted:
            raise BadInput(
                f"observation.camera: the policy sees {seen} channels; with {camera} the service's models see "
                f"{accepted}: color=grey, frames=1"
            )
        wide = [number for number, layer in enumerate(convolutions) if layer.kernel_size != (1, 1)]
        for number, convolution in enumerate(convolutions):
            kind = "Conv2d" if number <= max(wide, default=0) else "Dense"
            yield _Layer(f"{scope}/{camera}/{kind}_{2 * number}", convolution)
        pixels = np.arange(dense[0].in_features - readings)
        order[camera] = pixels.reshape(convolutions[-1].out_channels, -1).T.ravel()
    inputs = np.concatenate([order[name] for name in sorted(order)])
    hidden = dense[:-1] if isinstance(net.perceptron[-1], nn.Linear) else dense
    for number, module in enumerate(hidden):
        yield _Layer(f"{scope}/middleware_fc_embedder/Dense_{2 * number}", module, None if number else inputs)
