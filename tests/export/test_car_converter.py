"""The car's converter, OpenVINO, runs an archive's graph and decides as the policy."""

import sys

import numpy as np
import pytest
import torch

from benchmarks.camera import read_frames
from deepracer_exp.export.car_archive import CarArchive
from deepracer_exp.export.car_converter import Conversion, compare_in_openvino, has_openvino
from tests.export.test_car_archive import LEFT, exported

KINDS = [
    ("experiment=real_car",),
    ("observation=camera", "action_space=discrete"),
    ("experiment=real_car", "network=shallow", *LEFT),
    ("observation=camera", "algorithm=sac", "action_space=continuous", *LEFT),
]


@pytest.fixture(scope="module")
def frames(reference):
    """Every fifth of the real frames, as the car shows them to a model."""
    return torch.from_numpy(np.rint(read_frames(reference / "camera_frames")[::5]).astype(np.uint8))[:, None]


@pytest.mark.parametrize("overrides", KINDS, ids=" ".join)
def test_an_archive_decides_on_the_real_frames_as_the_policy(overrides, frames):
    pytest.importorskip("openvino")
    one = exported(*overrides)
    found = compare_in_openvino(one.archive, one.policy, [frames])
    assert len(found.same) == len(frames) > 50
    # Weights in half precision: two actions that are nearly as likely may change places.
    assert found.same.mean() >= 0.98
    assert 0 < found.difference < 0.03
    with torch.no_grad():
        assert one.policy(frames)[1].std(dim=0).max() > 0.1  # not one answer to everything


def test_readings_of_a_lidar_are_fed_beside_the_pictures():
    pytest.importorskip("openvino")
    one = exported("observation=camera_lidar", "network=cnn_small")
    generator = torch.Generator().manual_seed(0)
    pictures = torch.randint(0, 256, (8, 1, 120, 160), generator=generator, dtype=torch.uint8)
    seen = [pictures, torch.rand((8, 64), generator=generator)]
    # A picture without its readings would be far off.
    assert compare_in_openvino(one.archive, one.policy, seen).difference < 0.05


def test_an_archive_of_another_policy_is_noticed(frames):
    pytest.importorskip("openvino")
    one, other = (exported("experiment=real_car", *more) for more in ((), LEFT))
    mixed = CarArchive(other.archive.content, one.archive.metadata, [])
    assert not compare_in_openvino(mixed, one.policy, [frames]).same.any()


def test_whether_the_converter_is_installed_is_asked_of_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert not has_openvino()


def test_words_count_pictures():
    assert Conversion(np.arange(1200) < 1199, 0.0).words() == "same action on 1,199 of 1,200 pictures"
