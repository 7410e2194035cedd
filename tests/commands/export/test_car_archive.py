"""Archives for the physical car: the car's own converters read them, and the car then does what the policy does."""

import functools
import io
import json
import sys
import tarfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import nn

from deepracer_exp.aws.models.car_archive import check_weights, name_on_car
from deepracer_exp.aws.models.graph_def import HEAD, INPUTS, POLICY, read_weights
from deepracer_exp.aws.models.model_metadata import read_model_metadata
from deepracer_exp.commands.export.car_export import CarArchive, car_actions, car_archive
from deepracer_exp.commands.export.onnx import DeployedPolicy
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import ContinuousActions, build_action_space
from deepracer_exp.env.real_car import check_car
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.checkpoints import networks_of

SMALL = ("observation=camera", "network=cnn_small")
LEFT = ("action_space.steering_angle.low=-25", "action_space.steering_angle.high=27")
SHORT = (
    *("observation=camera", "action_space=grid", "collector.cars=4", "algorithm.frames_per_iteration=64"),
    *("algorithm.batch_size=32", "algorithm.epochs=1", "budget.env_steps=64", "checkpoints.every=null"),
)
FRAMES = 100


class Exported(NamedTuple):
    policy: DeployedPolicy
    archive: CarArchive

    @property
    def files(self) -> dict[str, bytes]:
        return self.archive.files

    @property
    def metadata(self) -> dict:
        return json.loads(self.files["model_metadata.json"])


def exported(*overrides: str) -> Exported:
    experiment, _ = compose_experiment(overrides)
    actions = build_action_space(experiment.action_space)
    generator = torch.Generator().manual_seed(0)
    networks = networks_of(experiment, generator)
    layers = [module for module in networks.policy_head.modules() if isinstance(module, nn.Linear)]
    with torch.no_grad():  # a fresh head's outputs hardly differ
        layers[-1].weight.mul_(300.0)
        layers[-1].bias.normal_(generator=generator)
    return Exported(DeployedPolicy(networks, actions).eval(), car_archive(networks, experiment))


small = functools.cache(exported)


def test_an_archive_has_the_metadata_at_its_root_and_one_graph_and_is_the_same_each_time():
    one = small(*SMALL)
    with tarfile.open(fileobj=io.BytesIO(one.archive.content()), mode="r:gz") as packed:
        members = packed.getmembers()
    assert [member.name for member in members] == ["model_metadata.json", "agent/model.pb"]
    assert all(member.isreg() and member.mtime == member.uid == member.gid == 0 for member in members)
    assert exported(*SMALL).archive.content() == one.archive.content()
    assert one.metadata["training_algorithm"] == "clipped_ppo"
    assert one.metadata["sensor"] == ["FRONT_FACING_CAMERA"]
    assert not {"lidar_config", "neural_network"} & one.metadata.keys()  # the service has no cnn_small
    read = read_model_metadata("model_metadata.json", one.files["model_metadata.json"])
    assert np.array_equal(np.array([read.low, read.high]), one.policy.table.numpy())


@pytest.mark.parametrize(("kind", "reach", "numbers"), [("plain", 1.0, 64), ("sectors", 0.5, 8)])
def test_a_lidars_range_is_written_in_the_cars_own_keys(kind, reach, numbers):
    one = small("observation=camera_lidar", f"observation.lidar.kind={kind}")
    assert one.metadata["sensor"] == ["FRONT_FACING_CAMERA", "LIDAR" if kind == "plain" else "SECTOR_LIDAR"]
    assert one.metadata["lidar_config"] == {
        "num_values": 64,
        "min_angle": -150.0,
        "max_angle": 150.0,
        "min_distance": 0.15,
        "max_distance": reach,
        "clipping_distance": reach,
        "num_sectors": numbers,
    }
    kinds = {key: type(value) for key, value in one.metadata["lidar_config"].items()}
    assert {key for key, kind in kinds.items() if kind is int} == {"num_values", "num_sectors"}
    assert any("restart" in note for note in one.archive.notes)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), "observation: the car has no features"),
        (("observation=camera_small",), "observation.camera: 80x60; accepted: 160x120"),
        (("observation=lidar",), "observation.camera: null"),
        (
            (*SMALL, "action_space=continuous", "action_space.speed.low=4", "action_space.speed.high=4"),
            "low < high",
        ),
    ],
    ids=lambda value: " ".join(value) or "features" if isinstance(value, tuple) else "",
)
def test_what_the_car_would_refuse_or_misread_is_not_written(overrides, words):
    with pytest.raises(BadInput, match="; accepted: ") as refused:
        check_car(compose_experiment(overrides)[0])
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("low", "high"), [(-25.0, 27.0), (-27.0, 25.0), (5.0, 25.0), (-30.0, -10.0), (-30.0, 30.0)]
)
def test_a_car_that_divides_by_the_high_end_steers_as_the_policy_does(low, high):
    actions = ContinuousActions(np.array([low, 1.0]), np.array([high, 4.0]))
    metadata, rescaling = car_actions(actions)
    outputs = np.random.default_rng(0).normal(0, 2, (500, 2))
    for_car = outputs
    if rescaling is not None:
        factor, shift = rescaling
        for_car = np.clip(outputs * factor + shift, shift - factor, shift + factor)
    share = (np.clip(for_car, -1, 1) + 1) / 2
    commands = np.array(metadata.low) * (1 - share) + np.array(metadata.high) * share
    assert np.allclose(commands, np.stack(actions.commands(outputs), axis=1), atol=1e-12)
    assert np.abs(commands[:, 0] / metadata.high.steering_deg).max() <= 1.0  # or the servo refuses it
    assert (rescaling is None) == (low == -high)


def test_rescaled_steering_is_reported_and_keeps_the_other_weights():
    one, as_it_is = (small(*SMALL, "action_space=continuous", *more) for more in (LEFT, ()))
    assert one.metadata["action_space"]["steering_angle"] == {"low": -27.0, "high": 27.0}
    assert [note for note in one.archive.notes if "from -25 to 27 degrees is written as -27 to 27" in note]
    assert as_it_is.archive.notes == []
    weights, before = (read_weights("model.pb", each.files["agent/model.pb"]) for each in (one, as_it_is))
    changed = [name for name in weights if not np.array_equal(weights[name], before[name])]
    assert {name.split("/")[-2] for name in changed} == {"policy_mean"}


def test_a_graph_with_other_weights_is_not_written():
    graph = small(*SMALL).files["agent/model.pb"]
    weights = read_weights("model.pb", graph)
    check_weights(graph, weights)
    for other in ({name: value + 1 for name, value in weights.items()}, dict(list(weights.items())[1:])):
        with pytest.raises(RunFailed, match="not the network's"):
            check_weights(graph, other)


def test_an_archive_of_sac_writes_the_means_alone_and_cannot_be_taken_for_a_policy_of_ppo(tmp_path, call):
    one = small(*SMALL, "algorithm=sac", "action_space=continuous")
    weights = read_weights("model.pb", one.files["agent/model.pb"], has_tangent=True)
    assert weights[f"{HEAD}/policy_mean/kernel"].shape[1] == len(weights[f"{HEAD}/policy_mean/bias"]) == 2
    with pytest.raises(BadInput, match="policy of SAC"):
        read_weights("model.pb", one.files["agent/model.pb"])
    (tmp_path / "soft.tar.gz").write_bytes(one.archive.content())
    call("import", "soft.tar.gz", "--name", "soft").assert_bad_input("policy of SAC")


def test_models_are_named_as_the_car_names_them():
    assert name_on_car("my best.v2.tar.gz") == "my_best"


def test_the_command_prints_what_the_car_makes_of_the_actions(trained, call):
    run = trained(*SHORT)
    ended = call("export", str(run.folder), "format=car", "-o", "my model.tar.gz")
    assert ended.code == 0, ended.stderr
    lines = ended.stdout.splitlines()
    assert lines[0] == "my model.tar.gz"
    assert any(line.startswith("  model        my_model on the car") for line in lines)
    metadata = json.loads(unpacked(ended.cwd / lines[0])["model_metadata.json"])
    fastest = max(action["speed"] for action in metadata["action_space"])
    assert f"-100% of full lock {fastest:7.2f} m/s  100% throttle" in ended.stdout
    (ended.cwd / "there.tar.gz").mkdir()
    for path in ("model.zip", "there.tar.gz"):
        call("export", str(run.folder), "format=car", "-o", path).assert_bad_input("ends in .tar.gz")


def unpacked(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as packed:
        return {member.name: packed.extractfile(member).read() for member in packed}


@pytest.mark.slow
def test_an_archive_that_is_imported_and_exported_again_is_the_same(tmp_path, call):
    one = exported("observation=camera_lidar", "network=deep", "action_space=continuous")
    (tmp_path / "one.tar.gz").write_bytes(one.archive.content())
    assert call("import", "one.tar.gz", "--name", "back").code == 0
    (run,) = (tmp_path / "runs" / "back").iterdir()
    assert call("export", str(run), "format=car", "-o", "two.tar.gz").code == 0
    assert (tmp_path / "two.tar.gz").read_bytes() == one.archive.content()


KINDS = [
    ("observation=camera", "network=shallow"),
    ("observation=camera", "network=shallow", "action_space=continuous"),
    ("observation=camera", "network=medium", "action_space=continuous", *LEFT),
    ("observation=camera_lidar", "network=deep"),
    ("observation=camera", "network=cnn_small", "network.critic=pictures", "network.shared_trunk=true"),
    ("observation=stereo", "network=shallow", "action_space=continuous"),
    ("observation=camera_lidar", "network=shallow"),
    ("observation=camera_lidar", "observation.lidar.kind=sectors", "action_space=continuous"),
    ("observation=camera_lidar", "observation.camera.stereo_m=0.06"),
    ("observation=camera", "network=shallow", "algorithm=sac", "action_space=continuous"),
    ("observation=camera", "network=cnn_small", "algorithm=sac", "action_space=continuous", *LEFT),
    ("observation=camera", "network=cnn_small", "algorithm=sac", "action_space=discrete"),
]


def frames(one: Exported) -> tuple[list[torch.Tensor], list[np.ndarray]]:
    """Return pictures and readings as the network sees them, and as the car passes them to the graph."""
    generator = torch.Generator().manual_seed(1)
    stereo = "STEREO_CAMERAS" in one.metadata["sensor"]
    light = torch.randint(20, 256, (FRAMES, 2 if stereo else 1, 6, 8), generator=generator).float()
    light = torch.nn.functional.interpolate(light, size=(120, 160)) - 20 * torch.rand(
        (FRAMES, 1, 120, 160), generator=generator
    )
    pictures = light.to(torch.uint8)
    seen, passed = [pictures], [pictures.permute(0, 2, 3, 1).float().numpy()]
    if "lidar_config" in one.metadata:
        readings = torch.rand((FRAMES, one.metadata["lidar_config"]["num_sectors"]), generator=generator)
        seen.append(readings)
        passed.append(readings.numpy())
    return seen, passed


def assert_same(one: Exported, theirs: np.ndarray, tolerance: float) -> None:
    """Hold what the graph gives against the policy, and the car's commands against its commands."""
    seen, _ = frames(one)
    with torch.no_grad():
        ours, commands = (each.numpy() for each in one.policy(*seen))
    metadata = one.archive.metadata
    if metadata.high is None:
        assert np.abs(theirs - ours).max() < tolerance
        steering_deg, speed_mps = np.array(metadata.actions)[theirs.argmax(axis=1)].T
    else:
        share = (np.clip(theirs, -1, 1) + 1) / 2
        steering_deg, speed_mps = (np.array(metadata.low) * (1 - share) + np.array(metadata.high) * share).T
        reach = np.array(metadata.high) - np.array(metadata.low)
        assert (np.abs(np.stack([steering_deg, speed_mps], axis=1) - commands) / reach).max() < tolerance
    assert np.mean(np.abs(steering_deg - commands[:, 0]) < 100 * tolerance) > 0.97  # or a tie of two actions
    assert np.mean(np.abs(speed_mps - commands[:, 1]) < 100 * tolerance) > 0.97
    assert ours.std(axis=0).max() > 0.005  # not one answer to everything


@pytest.mark.slow
@pytest.mark.parametrize("overrides", KINDS, ids=" ".join)
def test_openvino_reads_every_kind_of_archive_as_the_policy(tmp_path, overrides, monkeypatch):
    # It would report each conversion to its makers.
    monkeypatch.setitem(sys.modules, "openvino_telemetry", None)
    import openvino

    one = exported(*overrides)
    path = tmp_path / "model.pb"
    path.write_bytes(one.files["agent/model.pb"])
    found = openvino.convert_model(path)
    # The car pairs the graph's inputs with the shapes of its sensors in the order in which it finds them.
    names = [each.get_any_name() for each in found.inputs]
    assert names == [f"{INPUTS}/{sensor}/{sensor}:0" for sensor in one.metadata["sensor"]]
    _, passed = frames(one)
    model = openvino.convert_model(
        path,
        input=[(name, [1, *each.shape[1:]]) for name, each in zip(names, passed, strict=True)],
        output=f"{POLICY}:0",
    )
    compiled = openvino.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    theirs = np.concatenate([compiled([each[[row]] for each in passed])[0] for row in range(FRAMES)])
    assert_same(one, theirs, 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", KINDS, ids=" ".join)
def test_tensorflow_loads_every_kind_of_archive_and_makes_the_cars_tflite(tmp_path, overrides):
    tensorflow = pytest.importorskip("tensorflow", reason="opt-in: pip install tensorflow-cpu")
    tf = tensorflow.compat.v1
    one = exported(*overrides)
    path = tmp_path / "model.pb"
    path.write_bytes(one.files["agent/model.pb"])
    _, passed = frames(one)
    inputs = {
        f"{INPUTS}/{name}/{name}": each for name, each in zip(one.metadata["sensor"], passed, strict=True)
    }

    definition = tf.GraphDef.FromString(path.read_bytes())
    with tf.Graph().as_default() as graph:
        tf.import_graph_def(definition, name="")
        with tf.Session(graph=graph) as session:
            theirs = session.run(f"{POLICY}:0", {f"{name}:0": each for name, each in inputs.items()})
    assert_same(one, theirs, 1e-5)

    converter = tf.lite.TFLiteConverter.from_frozen_graph(  # as deepracer-custom-car calls it
        graph_def_file=str(path),
        input_arrays=list(inputs),
        input_shapes={name: [1, *each.shape[1:]] for name, each in inputs.items()},
        output_arrays=[POLICY],
    )
    converter.allow_custom_ops = True
    converter.optimizations = [tf.lite.Optimize.DEFAULT]
    converter.target_spec.supported_types = [tf.float16]
    interpreter = tf.lite.Interpreter(model_content=converter.convert())
    interpreter.allocate_tensors()
    places = {each["name"]: each["index"] for each in interpreter.get_input_details()}
    rows = []
    for row in range(FRAMES):
        for name, each in inputs.items():
            interpreter.set_tensor(places[name], each[[row]])
        interpreter.invoke()
        rows.append(interpreter.get_tensor(interpreter.get_output_details()[0]["index"])[0])
    assert_same(one, np.array(rows), 5e-3)
