"""Frozen graphs: what is written is read back, and anything else is refused."""

import multiprocessing
from typing import NamedTuple

import numpy as np
import pytest

from deepracer_exp.aws.models.graph_def import (
    HEAD,
    INPUTS,
    POLICY,
    POLICY_NETWORK,
    policy_graph,
    read_weights,
)
from deepracer_exp.aws.models.protobuf import field, read_fields
from deepracer_exp.errors import BadInput
from tests.conftest import REFERENCE, refused
from tests.memory import traced

MODEL = REFERENCE / "aws_checkpoint" / "model"
SENSORS = {"STEREO_CAMERAS": (20, 24, 2), "LIDAR": (6,)}


def weights(*, continuous: bool = False) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    camera, lidar = (f"{POLICY_NETWORK}/{sensor}" for sensor in SENSORS)
    middleware = f"{POLICY_NETWORK}/middleware_fc_embedder"
    shapes = {
        f"{camera}/Conv2d_0": (4, 4, 2, 8),  # 20x24 -> 9x11
        f"{camera}/Conv2d_2": (3, 3, 8, 8),  # -> 7x9
        f"{camera}/Conv2d_4": (3, 3, 8, 4),  # -> 5x7
        f"{lidar}/Dense_0": (6, 5),
        f"{lidar}/Dense_2": (5, 5),
        **{f"{middleware}/Dense_{number}": (6, 6) for number in range(2, 22, 2)},
        f"{middleware}/Dense_0": (5 * 7 * 4 + 5, 6),
        f"{HEAD}/{'policy_mean' if continuous else 'policy_fc'}": (6, 2 if continuous else 1),
    }
    tensors = {}
    for name, shape in shapes.items():
        tensors[f"{name}/kernel"] = random.standard_normal(shape).astype(np.float32)
        tensors[f"{name}/bias"] = random.standard_normal(shape[-1]).astype(np.float32)
    return tensors


def graph(**options) -> bytes:
    return policy_graph(weights(**options), SENSORS, (2, 1, 1))


class Node(NamedTuple):
    name: str
    op: str
    inputs: list[str]
    attributes: dict[str, bytes]


def nodes(content: bytes) -> list[Node]:
    found = []
    for number, node in read_fields(memoryview(content)):
        if number == 1:
            parts = list(read_fields(node))
            name, op, *inputs = (bytes(value).decode() for kind, value in parts if kind <= 3)
            entries = [dict(read_fields(value)) for kind, value in parts if kind == 5]
            attributes = {bytes(each[1]).decode(): bytes(each.get(2, b"")) for each in entries}
            found.append(Node(name, op, inputs, attributes))
    return found


@pytest.mark.parametrize("continuous", [False, True])
def test_weights_are_read_back_as_they_were_written(continuous):
    tensors = weights(continuous=continuous)
    back = read_weights("model.pb", graph(continuous=continuous))
    assert back.keys() == tensors.keys()
    assert all(np.array_equal(back[name], tensors[name]) for name in tensors)


def test_nodes_have_the_services_names_and_follow_their_inputs():
    known: dict[str, str] = {}
    for name, op, inputs, _ in nodes(graph()):
        assert name not in known
        assert set(inputs) <= known.keys()
        known[name] = op
    assert list(known)[:2] == [f"{INPUTS}/STEREO_CAMERAS/STEREO_CAMERAS", f"{INPUTS}/LIDAR/LIDAR"]
    camera = f"{POLICY_NETWORK}/STEREO_CAMERAS"
    assert known[f"{camera}/truediv"] == "RealDiv"
    assert known[f"{camera}/sub"] == "Sub"
    assert known[f"{camera}/Conv2d_4/Conv2D"] == "Conv2D"  # Grad-CAM tools ask for it
    assert known[f"{camera}/BatchnormActivationDropout_5_activation"] == "Relu"
    assert list(known)[-1] == POLICY
    assert known[POLICY] == "Softmax"
    assert nodes(graph(continuous=True))[-1].op == "Identity"


def test_layers_are_in_the_order_of_their_numbers_and_sensors_in_that_of_their_names():
    inputs = {node.name: node.inputs for node in nodes(graph())}
    assert inputs[f"{POLICY_NETWORK}/merger"][0].startswith(f"{POLICY_NETWORK}/LIDAR/")
    middleware = f"{POLICY_NETWORK}/middleware_fc_embedder"
    before = f"{middleware}/BatchnormActivationDropout_9_activation"
    assert inputs[f"{middleware}/Dense_10/MatMul"][0] == before


def test_a_layer_of_each_pixel_and_one_of_all_pixels_are_told_apart():
    tensors = weights()
    camera = f"{POLICY_NETWORK}/STEREO_CAMERAS"
    tensors |= {
        f"{camera}/Dense_6/kernel": np.ones((4, 3), np.float32),
        f"{camera}/Dense_6/bias": np.ones(3, np.float32),
    }
    merged = f"{POLICY_NETWORK}/middleware_fc_embedder/Dense_0/kernel"
    tensors[merged] = np.ones((5 * 7 * 3 + 5, 6), np.float32)
    each = dict(zip(*_reshapes(tensors), strict=True))
    assert each[f"{camera}/Dense_6/Reshape"] == [-1, 4]
    assert each[f"{camera}/Flatten/flatten/Reshape"] == [-1, 105]
    tensors[f"{camera}/Dense_6/kernel"] = np.ones((5 * 7 * 4, 3), np.float32)
    tensors[merged] = np.ones((3 + 5, 6), np.float32)
    assert dict(zip(*_reshapes(tensors), strict=True)) == {f"{camera}/Dense_6/Reshape": [-1, 140]}


def _reshapes(tensors):
    content = policy_graph(tensors, SENSORS, (2, 1, 1))
    names = [node.name for node in nodes(content) if node.op == "Reshape"]
    sizes = []
    for name in names:
        after = content.split(f"{name}/shape".encode())[1]
        sizes.append(np.frombuffer(after[after.index(b"\xff\xff\xff\xff") :][:8], "<i4").tolist())
    return names, sizes


def read_damaged() -> tuple[list[str], int]:
    """Read sixty damaged graphs; return the refusals, and how many bytes were taken at most."""
    content, shapes = graph(), {name: value.shape for name, value in weights().items()}
    random = np.random.default_rng(1)
    refusals = []
    with traced() as peak:
        for number in range(60):
            damaged = bytearray(content)
            if number % 3 == 0:
                del damaged[random.integers(len(content)) :]
            else:
                at = random.integers(len(content), size=1 + number % 5)
                for place, byte in zip(at.tolist(), random.integers(256, size=len(at)).tolist(), strict=True):
                    damaged[place] = byte
            try:
                read = read_weights("model.pb", bytes(damaged))
            except BadInput as error:
                refusals.append(str(error))
            else:
                assert all(value.shape == shapes.get(name, value.shape) for name, value in read.items())
        return refusals, peak()


def test_a_damaged_graph_is_refused_in_one_line_or_has_the_same_tensors():
    # In a process of its own: of one with other tests memory is taken by more than the reader.
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        refusals, peak = pool.apply(read_damaged)
    assert peak < 20 * len(graph())
    assert len(refusals) > 20
    assert all(line.startswith("model.pb: ") and "accepted: a frozen graph" in line for line in refusals)


def tensor(
    *, kind: int = 1, shape: tuple[int, ...] = (2,), content: bytes = bytes(8), name: str = "a/kernel"
) -> bytes:
    sizes = b"".join(field(2, field(1, size)) for size in shape)
    value = field(8, field(1, kind) + field(2, sizes) + field(4, content))
    attribute = field(5, field(1, "value") + field(2, value))
    return field(1, field(1, name) + field(2, "Const") + attribute)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "holds no weights"),
        (b"\x1f\x8b" + bytes(50), "model.pb"),
        (tensor(shape=(2**31, 2**31)), "8 bytes for a tensor of shape"),
        (tensor(shape=(0,) * 9, content=b""), "0 bytes for a tensor of shape"),
        (tensor(shape=(3,)), "8 bytes for a tensor of shape [3]"),
        (tensor(kind=2), "a/kernel: is not of type float32"),
        (tensor() + tensor(), "two nodes a/kernel"),
        (tensor() + field(1, b"") * 20_001, "more than 20,000 nodes"),
        (tensor() + field(9, 0) * 200_001, "more than 200,000 fields"),
        (b"\x0a\xff\xff\xff\xff\xff\xff\xff\xff\x7f", "ends early"),
        (b"\xff" * 11, "holds a number of more than ten bytes"),
        (b"\x08\x01", "is not a protobuf message"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_frozen_graph_is_refused(content, words):
    message = refused(read_weights, "model.pb", content)
    assert "model.pb: " in message
    assert words in message


def test_a_tensor_of_one_element_may_be_listed_as_tensorflow_lists_it():
    value = np.float32(0.5)
    listed = field(8, field(1, 1) + field(2, field(2, field(1, 1))) + field(5, value.tobytes()))
    node = field(1, "a/bias") + field(2, "Const") + field(5, field(1, "value") + field(2, listed))
    assert read_weights("model.pb", field(1, node)) == {"a/bias": value}


@pytest.mark.skipif(not MODEL.is_dir(), reason=f"no checkpoint at {MODEL}")
def test_every_node_is_one_of_the_services_own_graph():
    (meta,) = MODEL.glob("*.meta")
    (content,) = (value for number, value in read_fields(memoryview(meta.read_bytes())) if number == 2)
    theirs = {node.name: node for node in nodes(content)}
    middleware, camera = f"{POLICY_NETWORK}/middleware_fc_embedder", f"{POLICY_NETWORK}/FRONT_FACING_CAMERA"
    tensors = {}
    for name, shape in {
        f"{camera}/Conv2d_0": (8, 8, 1, 32),
        f"{camera}/Conv2d_2": (4, 4, 32, 64),
        f"{camera}/Conv2d_4": (3, 3, 64, 64),
        f"{middleware}/Dense_0": (11264, 512),
        f"{HEAD}/policy_fc": (512, 9),
    }.items():
        tensors |= {
            f"{name}/kernel": np.zeros(shape, np.float32),
            f"{name}/bias": np.zeros(shape[-1:], np.float32),
        }
    written = nodes(policy_graph(tensors, {"FRONT_FACING_CAMERA": (120, 160, 1)}, (4, 2, 1)))
    assert len(written) > 30
    for name, op, inputs, attributes in written:
        like = theirs[name]
        if op == "Const":  # frozen
            assert like.op == {"y": "Const", "shape": "Pack"}.get(name.rsplit("/")[-1], "VariableV2")
            continue
        inputs_there = like.inputs
        if name == f"{HEAD}/policy_fc/MatMul":  # without the factor of 1 on gradients
            inputs_there = [f"{middleware}/BatchnormActivationDropout_1_activation", *inputs_there[1:]]
        of_training = ("_class", "_output_shapes")
        assert (op, inputs) == (like.op, inputs_there)
        assert attributes == {key: value for key, value in like.attributes.items() if key not in of_training}
