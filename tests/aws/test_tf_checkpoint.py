"""Checkpoints of TensorFlow are what TensorFlow writes, and what is damaged is refused."""

import contextlib

import numpy as np
import pytest

from deepracer_exp.aws.models.protobuf import field
from deepracer_exp.aws.models.tf_checkpoint import (
    Entry,
    masked_crc32c,
    read_index,
    read_tensors,
    write_checkpoint,
    write_index,
)
from deepracer_exp.errors import BadInput
from tests.conftest import REFERENCE

INDEX = REFERENCE / "aws_checkpoint/model/11_Step-38428.ckpt.index"
SCOPE = "main_level/agent/main/online"
SHAPES = {
    "FRONT_FACING_CAMERA/Conv2d_0": (8, 8, 1, 32),
    "FRONT_FACING_CAMERA/Conv2d_2": (4, 4, 32, 64),
    "FRONT_FACING_CAMERA/Conv2d_4": (3, 3, 64, 64),
    "middleware_fc_embedder/Dense_0": (11264, 512),
}
HEADS = {"network_0": ("v_values_head_0/output", 1), "network_1": ("ppo_head_0/policy_fc", 9)}


def tensors(seed=0, sizes=((3, 3, 1, 8), (8,), (17, 5), ())):
    random = np.random.default_rng(seed)
    return {f"a/layer_{n}/kernel": random.random(size).astype(np.float32) for n, size in enumerate(sizes)}


@pytest.mark.skipif(not INDEX.is_file(), reason=f"no index at {INDEX}")
def test_the_services_index_is_read_exactly_and_written_byte_for_byte():
    raw = INDEX.read_bytes()
    entries = read_index(raw, str(INDEX))
    expected = {}
    for network, (head, outputs) in HEADS.items():
        for layer, shape in (SHAPES | {head: (512, outputs)}).items():
            expected[f"{SCOPE}/{network}/{layer}/kernel"] = shape
            expected[f"{SCOPE}/{network}/{layer}/bias"] = shape[-1:]
        expected[f"{SCOPE}/{network}/gradients_from_head_0-0_rescalers"] = ()
    assert {name: entry.shape for name, entry in entries.items()} == expected
    assert max(entry.offset + entry.size for entry in entries.values()) == 46_736_688
    one = entries[f"{SCOPE}/network_1/gradients_from_head_0-0_rescalers"]
    assert one.crc == masked_crc32c(np.float32(1).tobytes())
    assert write_index(entries) == raw


def test_what_is_written_is_read_again():
    given = tensors(sizes=((3, 3, 1, 8), (8,), (17, 5), (), *((2,),) * 40))
    index, data = write_checkpoint(given)
    found = read_tensors(read_index(index, "index"), data, "data")
    assert {name: value.tobytes() for name, value in found.items()} == {
        name: value.tobytes() for name, value in given.items()
    }
    assert all(found[name].shape == given[name].shape for name in given)


def test_no_damaged_index_is_read_as_another():
    raw, _ = write_checkpoint(tensors())
    whole = read_index(raw, "index")
    random = np.random.default_rng(0)
    for at in random.integers(0, len(raw), 60):
        damaged = bytearray(raw)
        damaged[at] ^= 1 << random.integers(8)
        with contextlib.suppress(BadInput):
            assert read_index(bytes(damaged), "index") == whole  # padding
    for length in range(0, len(raw), 7):
        with pytest.raises(BadInput, match="index: "):
            read_index(raw[:length], "index")


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"a": Entry((2**20, 2**20), 0, 2**42, 0)}, "describes"),
        ({"a": Entry((8,), 0, 16, 0)}, "16 bytes for a tensor of shape"),
        ({"a": Entry((4,), 0, 16, 0), "b": Entry((4,), 0, 16, 0)}, "not where the one before ends"),
        ({"a": Entry((4,), 16, 16, 0)}, "not where the one before ends"),
        ({f"t{n:04d}": Entry((), 4 * n, 4, 0) for n in range(1001)}, "more than 1,000"),
    ],
)
def test_an_index_that_promises_what_it_cannot_hold_is_refused(entries, words):
    with pytest.raises(BadInput, match=words):
        read_index(write_index(entries), "index")


def test_a_data_file_that_is_not_the_indexs_is_refused():
    index, data = write_checkpoint(tensors())
    with pytest.raises(BadInput, match="data: has"):
        read_tensors(read_index(index, "index"), data[:-1], "data")
    with pytest.raises(BadInput, match="data: a/layer_0/kernel: corrupt"):
        read_tensors(read_index(index, "index"), bytes([data[0] ^ 1]) + data[1:], "data")


def test_a_number_in_a_message_is_as_long_as_protobuf_has_it():
    assert field(4, 23_358_084) == bytes.fromhex("2084d5910b")  # from the service's index
    assert field(1, -1) == bytes.fromhex("08ffffffffffffffffff01")


def test_tensorflow_reads_what_is_written(tmp_path):
    tensorflow = pytest.importorskip("tensorflow")
    given = tensors()
    index, data = write_checkpoint(given)
    (tmp_path / "model.ckpt.index").write_bytes(index)
    (tmp_path / "model.ckpt.data-00000-of-00001").write_bytes(data)
    reader = tensorflow.train.load_checkpoint(str(tmp_path / "model.ckpt"))
    assert set(reader.get_variable_to_shape_map()) == set(given)
    assert all(np.array_equal(reader.get_tensor(name), value) for name, value in given.items())
