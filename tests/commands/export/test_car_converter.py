"""The car's converter, OpenVINO, runs an archive's graph and decides as the policy."""

import sys
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from benchmarks.camera import read_frames
from deepracer_exp.aws.models.graph_def import INPUTS, POLICY
from deepracer_exp.commands.export.car_converter import (
    Conversion,
    add_converted,
    compare_in_openvino,
    has_openvino,
)
from tests.commands.export.test_car_archive import LEFT, SHORT, exported, unpacked

KINDS = [
    ("experiment=real_car",),
    ("observation=camera", "action_space=discrete"),
    ("observation=camera", "algorithm=sac", "action_space=continuous", *LEFT),
]


@pytest.fixture(scope="module")
def frames(reference):
    """The real frames, as the car shows them to a model."""
    return torch.from_numpy(np.rint(read_frames(reference / "camera_frames")).astype(np.uint8))[:, None]


@pytest.mark.parametrize("overrides", KINDS, ids=" ".join)
def test_an_archive_decides_on_the_real_frames_as_the_policy(overrides, frames):
    pytest.importorskip("openvino")
    one = exported(*overrides)
    found = compare_in_openvino(one.archive, one.policy, [frames])
    assert len(found.same) == len(frames) == 306
    assert found.same.all()
    assert 0 < found.difference < 0.005  # of a probability or of a range; weights in half precision
    with torch.no_grad():
        assert one.policy(frames)[1].std(dim=0).max() > 0.1  # not one answer to everything


@pytest.mark.parametrize("observation", ["camera", "camera_lidar"])
def test_the_converted_graph_has_the_names_and_the_layout_that_the_car_reads(observation):
    openvino = pytest.importorskip("openvino")
    one = exported(f"observation={observation}", "network=cnn_small")
    files = add_converted(one.archive).files
    assert list(files) == ["model_metadata.json", "agent/model.pb", "agent/model.xml", "agent/model.bin"]
    # The car converts again what is of another version.
    assert ElementTree.fromstring(files["agent/model.xml"]).get("version") == "11"
    model = openvino.Core().read_model(files["agent/model.xml"], files["agent/model.bin"])
    shapes = {"FRONT_FACING_CAMERA": [1, 120, 160, 1], "LIDAR": [1, 64]}
    sensors = one.metadata["sensor"]
    assert [each.get_any_name() for each in model.inputs] == [f"{INPUTS}/{name}/{name}:0" for name in sensors]
    assert [list(each.shape) for each in model.inputs] == [shapes[name] for name in sensors]
    (output,) = model.outputs
    assert f"{POLICY}:0" in output.names
    assert list(output.shape) == [1, 2]


def test_the_command_packs_the_converted_graph_and_says_what_to_install_for_it(trained, call, monkeypatch):
    pytest.importorskip("openvino")
    run = trained(*SHORT)
    for format in ("car", "car-openvino"):
        ended = call("export", str(run.folder), f"format={format}", "-o", f"{format}.tar.gz")
        assert ended.code == 0, ended.stderr
    assert "agent/model.xml and agent/model.bin: a car with OpenVINO 2024" in ended.stdout
    plain, converted = (unpacked(ended.cwd / f"{name}.tar.gz") for name in ("car", "car-openvino"))
    assert list(plain) == ["model_metadata.json", "agent/model.pb"]
    assert list(converted) == [*plain, "agent/model.xml", "agent/model.bin"]
    assert plain.items() <= converted.items()
    monkeypatch.setitem(sys.modules, "openvino", None)
    call("export", str(run.folder), "format=car-openvino").assert_bad_input(
        "format=car-openvino: needs the package openvino; install the project with its extra: "
        "pip install 'deepracer-exp[car]'"
    )


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
    mixed = one.archive._replace(files=other.archive.files)
    assert not compare_in_openvino(mixed, one.policy, [frames]).same.any()


def test_whether_the_converter_is_installed_is_asked_of_its_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert not has_openvino()


def test_words_count_pictures():
    assert Conversion(np.arange(1200) < 1199, 0.0).words() == "same action on 1,199 of 1,200 pictures"
