"""Frozen graphs of TensorFlow 1 (`.pb`), a car's format for policies; written and read without TensorFlow.

Such a file is one GraphDef in the wire format of protobuf. Its weights are nodes `Const`. Source of the field numbers:
tensorflow/core/framework/{graph,node_def,attr_value,tensor,tensor_shape,versions}.proto. Nodes have the names that they
have in the service's graphs, of which a console training of 2020 left a `.meta`.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepracer_exp.errors import BadInput
from deepracer_exp.files import read_bytes

from .protobuf import field, read_fields, varint

Tensor = NDArray[np.float32]

INPUTS = "main_level/agent/main/online/network_0"
"""Scope of the inputs, and of the value network, which a car does not need."""
POLICY_NETWORK = "main_level/agent/main/online/network_1"
HEAD = f"{POLICY_NETWORK}/ppo_head_0"
POLICY = f"{HEAD}/policy"
"""The output: probabilities of the actions, or the mean of [steering, speed], where a range is -1 to 1."""

GRAPH_BYTES = 2**28
"""Twice the service's largest graph, that of DEEP_CONVOLUTIONAL_NETWORK with its 56,000 inputs of a dense layer."""
_TANGENT = f"{HEAD}/Tanh"
_MOST_NODES = 20_000
"""The service's whole training graph has 3,730 nodes, a frozen one about 60."""
_MOST_FIELDS = 200_000

_FLOAT, _INT32 = 1, 3  # types.proto
_PRODUCER = 27  # TensorFlow 1.11 to 1.15, as in the service's files


def policy_graph(
    tensors: Mapping[str, Tensor],
    sensors: Mapping[str, Sequence[int]],
    strides: Sequence[int],
    bounds: tuple[Tensor, Tensor] | None = None,
    tangent: tuple[Tensor, Tensor] | None = None,
) -> bytes:
    """Return the frozen graph of a policy: raw sensors in (pictures 0 to 255, LIDAR as it is), `POLICY` out.

    Args:
        tensors: of the policy network by the service's names, kernels [h, w, in, out] or [in, out] and biases;
            `ppo_head_0/policy_fc` of a discrete action space, `policy_mean` of a continuous one. Others are left out.
        sensors: shapes of the inputs, (height, width, channels) or (readings,), by name, in the order of the
            metadata's `sensor`.
        strides: of each convolution.
        bounds: lowest and highest value of each continuous output, (2,) each; None: it is not clipped.
        tangent: factor and shift of the hyperbolic tangent of each continuous output, (2,) each; None: the output is
            taken without it.
    """
    graph = _Graph()
    flattened = {}
    # First and in that order: OpenVINO 2024 on the car takes its shapes for the graph's inputs one after the other.
    for sensor, shape in sensors.items():
        placeholder = f"{INPUTS}/{sensor}/{sensor}"
        graph.node(placeholder, "Placeholder", dtype=_type(_FLOAT), shape=field(7, _dimensions((-1, *shape))))
    for sensor, shape in sensors.items():
        scope = f"{POLICY_NETWORK}/{sensor}"
        raw = f"{INPUTS}/{sensor}/{sensor}"
        scaled = graph.operate(f"{scope}/truediv", "RealDiv", raw, 255.0 if len(shape) == 3 else 1.0)
        centered = graph.operate(f"{scope}/sub", "Sub", scaled, 0.0)
        flattened[sensor] = _embed(graph, tensors, scope, centered, shape, strides)
    # The service's embedders are in alphabetical order.
    parts = [flattened[sensor] for sensor in sorted(flattened)]
    if len(parts) > 1:
        axis = graph.constant(f"{POLICY_NETWORK}/merger/axis", np.int32(-1))
        types = {"T": _type(_FLOAT), "Tidx": _type(_INT32), "N": field(3, len(parts))}
        parts = [graph.node(f"{POLICY_NETWORK}/merger", "ConcatV2", *parts, axis, **types)]
    hidden = parts[0]
    for name in _layers(tensors, f"{POLICY_NETWORK}/middleware_fc_embedder"):
        hidden = _activate(graph, name, _dense(graph, tensors, name, hidden))
    discrete = f"{HEAD}/policy_fc/kernel" in tensors
    output = _dense(graph, tensors, f"{HEAD}/policy_{'fc' if discrete else 'mean'}", hidden)
    if tangent is not None:
        output = graph.node(_TANGENT, "Tanh", output, T=_type(_FLOAT))
        factor, shift = tangent
        if (factor != 1).any() or shift.any():
            output = graph.operate(f"{HEAD}/mul", "Mul", output, factor)
            output = graph.operate(f"{HEAD}/add", "Add", output, shift)
    if bounds is not None:
        output = graph.operate(f"{HEAD}/Maximum", "Maximum", output, bounds[0])
        output = graph.operate(f"{HEAD}/Minimum", "Minimum", output, bounds[1])
    graph.node(POLICY, "Softmax" if discrete else "Identity", output, T=_type(_FLOAT))
    return graph.content()


def _embed(
    graph: "_Graph",
    tensors: Mapping[str, Tensor],
    scope: str,
    x: str,
    shape: Sequence[int],
    strides: Sequence[int],
) -> str:
    """Add the layers of one sensor and return the node with its flat output."""
    following = iter(strides)
    for name in _layers(tensors, scope):
        kernel = tensors[f"{name}/kernel"]
        if kernel.ndim == 4:
            stride = next(following)
            x = graph.node(
                f"{name}/Conv2D",
                "Conv2D",
                x,
                graph.weight(f"{name}/kernel", kernel),
                T=_type(_FLOAT),
                data_format=field(2, "NHWC"),
                dilations=_integers(1, 1, 1, 1),
                padding=field(2, "VALID"),
                strides=_integers(1, stride, stride, 1),
                use_cudnn_on_gpu=field(5, 1),
            )
            x = _activate(graph, name, _add_bias(graph, tensors, name, x))
            height, width, _ = shape
            shape = (
                (height - kernel.shape[0]) // stride + 1,
                (width - kernel.shape[1]) // stride + 1,
                kernel.shape[3],
            )
        else:
            # On a picture, a dense layer applies to each pixel, or to all of them together.
            places = shape[:-1] if kernel.shape[0] == shape[-1] else ()
            x = _reshape(graph, f"{name}/Reshape", x, shape, kernel.shape[0])
            x = _activate(graph, name, _dense(graph, tensors, name, x))
            shape = *places, kernel.shape[1]
    return _reshape(graph, f"{scope}/Flatten/flatten/Reshape", x, shape, math.prod(shape))


def _layers(tensors: Mapping[str, Tensor], scope: str) -> list[str]:
    """Return the names of a scope's layers in their order: `Conv2d_0`, `Conv2d_2`, ..."""
    numbers = {}
    for name in tensors:
        match = re.fullmatch(re.escape(scope) + r"/[A-Za-z0-9]+_(\d+)/kernel", name)
        if match:
            numbers[name.removesuffix("/kernel")] = int(match[1])
    return sorted(numbers, key=numbers.__getitem__)


def _reshape(graph: "_Graph", name: str, x: str, shape: Sequence[int], size: int) -> str:
    """Return a node with rows of `size`."""
    if tuple(shape) == (size,):
        return x
    to = graph.constant(f"{name}/shape", np.array([-1, size], np.int32))
    return graph.node(name, "Reshape", x, to, T=_type(_FLOAT), Tshape=_type(_INT32))


def _dense(graph: "_Graph", tensors: Mapping[str, Tensor], name: str, x: str) -> str:
    weight = graph.weight(f"{name}/kernel", tensors[f"{name}/kernel"])
    no = field(5, 0)
    x = graph.node(f"{name}/MatMul", "MatMul", x, weight, T=_type(_FLOAT), transpose_a=no, transpose_b=no)
    return _add_bias(graph, tensors, name, x)


def _add_bias(graph: "_Graph", tensors: Mapping[str, Tensor], name: str, x: str) -> str:
    bias = graph.weight(f"{name}/bias", tensors[f"{name}/bias"])
    types = {"T": _type(_FLOAT), "data_format": field(2, "NHWC")}
    return graph.node(f"{name}/BiasAdd", "BiasAdd", x, bias, **types)


def _activate(graph: "_Graph", layer: str, x: str) -> str:
    scope, number = re.fullmatch(r"(.*/)\w+_(\d+)", layer).groups()  # type: ignore[union-attr]
    name = f"{scope}BatchnormActivationDropout_{int(number) + 1}_activation"
    return graph.node(name, "Relu", x, T=_type(_FLOAT))


class _Graph:
    """A GraphDef that grows node by node."""

    def __init__(self) -> None:
        self._nodes: list[bytes] = []

    def node(self, name: str, op: str, *inputs: str, **attributes: bytes) -> str:
        """Add a node and return its name."""
        entries = (field(5, field(1, key) + field(2, value)) for key, value in attributes.items())
        content = field(1, name) + field(2, op) + b"".join(field(3, each) for each in inputs)
        self._nodes.append(field(1, content + b"".join(entries)))
        return name

    def constant(self, name: str, value: NDArray | np.generic) -> str:
        """Add a constant, float32 or int32."""
        kind = _FLOAT if value.dtype == np.float32 else _INT32
        content = np.asarray(value, "<f4" if kind == _FLOAT else "<i4").tobytes()
        tensor = field(1, kind) + field(2, _dimensions(value.shape)) + field(4, content)
        return self.node(name, "Const", dtype=_type(kind), value=field(8, tensor))

    def weight(self, name: str, value: Tensor) -> str:
        """Add a constant that the service's software reads as it read the variable before it was frozen."""
        return self.node(f"{name}/read", "Identity", self.constant(name, value), T=_type(_FLOAT))

    def operate(self, name: str, op: str, x: str, y: float | Tensor) -> str:
        """Add an operation with a constant."""
        constant = self.constant(f"{name}/y", np.asarray(y, np.float32))
        return self.node(name, op, x, constant, T=_type(_FLOAT))

    def content(self) -> bytes:
        """Return the message."""
        return b"".join([*self._nodes, field(4, field(1, _PRODUCER))])


def _type(kind: int) -> bytes:
    return field(6, kind)


def _dimensions(shape: Sequence[int]) -> bytes:
    return b"".join(field(2, field(1, size)) for size in shape)


def _integers(*values: int) -> bytes:
    return field(1, field(3, b"".join(map(varint, values))))


def read_weights(
    path: str | Path, raw: bytes | None = None, *, has_tangent: bool = False
) -> dict[str, Tensor]:
    """Return the kernels and biases of a frozen graph by the names of their nodes.

    `raw` is its content if known, e.g. of a member of an archive. `has_tangent`: whether the policy's output may go
    through a hyperbolic tangent, as an exported SAC policy's does.

    Nothing is allocated from a size that the file declares: the tensors are views of its bytes, read-only.

    Raises:
        BadInput: it cannot be read, is larger than `GRAPH_BYTES`, or not a frozen graph; or has such an output, with
            which the weights alone are another policy.
    """
    accepted = "a frozen graph of TensorFlow 1 (.pb)"
    raw = read_bytes(path, accepted, GRAPH_BYTES) if raw is None else raw
    tensors: dict[str, Tensor] = {}
    try:
        fields = _Fields()
        nodes = 0
        for number, value in fields.of(memoryview(raw)):
            if number != 1:
                continue
            nodes += 1
            if nodes > _MOST_NODES:
                raise ValueError(f"more than {_MOST_NODES:,} nodes")
            name, tensor = _constant(fields, _message(value))
            if name == _TANGENT and not has_tangent:
                raise ValueError("holds a policy of SAC, whose weights cannot be used")
            if tensor is not None:
                if name in tensors:
                    raise ValueError(f"two nodes {name}")
                tensors[name] = tensor
        if not tensors:
            raise ValueError("holds no weights")
    except ValueError as error:
        raise BadInput(path, error, accepted) from error
    return tensors


class _Fields:
    """Reads the fields of messages, in total no more than a graph can have."""

    def __init__(self) -> None:
        self._left = _MOST_FIELDS

    def of(self, message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
        """Yield the number and the value of each field: a number, or the bytes of anything else."""
        for each in read_fields(message):
            self._left -= 1
            if self._left < 0:
                raise ValueError(f"more than {_MOST_FIELDS:,} fields")
            yield each


def _message(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("is not a protobuf message")
    return value


def _constant(fields: _Fields, node: memoryview) -> tuple[str, Tensor | None]:
    """Return a node's name, and its tensor if it is a weight."""
    name, op, content = "", "", None
    for number, value in fields.of(node):
        if number == 1:
            name = str(_message(value), "utf-8", "replace")
        elif number == 2:
            op = str(_message(value), "utf-8", "replace")
        elif number == 5:
            attribute = dict(fields.of(_message(value)))
            if attribute.get(1) == b"value":
                content = dict(fields.of(_message(attribute.get(2, 0)))).get(8)
    if op != "Const" or not name.endswith(("/kernel", "/bias")) or content is None:
        return name, None
    kind, shape, raw, listed = 0, list[int](), memoryview(b""), memoryview(b"")
    for number, value in fields.of(_message(content)):
        if number == 1 and isinstance(value, int):
            kind = value
        elif number == 2:
            for _, dimension in fields.of(_message(value)):
                size = dict(fields.of(_message(dimension))).get(1, 0)
                shape.append(size if isinstance(size, int) else -1)
        elif number == 4:
            raw = _message(value)
        elif number == 5:
            listed = _message(value)
    if kind != _FLOAT:
        raise ValueError(f"{name}: is not of type float32")
    raw = raw or listed  # a tensor with one element may be listed
    if not all(0 < size < 2**31 for size in shape) or len(shape) > 8 or 4 * math.prod(shape) != len(raw):
        raise ValueError(f"{name}: {len(raw)} bytes for a tensor of shape {shape}")
    return name, np.frombuffer(raw, "<f4").reshape(shape)
