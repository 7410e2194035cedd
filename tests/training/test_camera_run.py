"""Trainings from pictures: what holds of runs with features holds of them."""

from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime
import psutil
import pytest
import torch
from mlflow.models import Model
from tensordict import TensorDict

import deepracer_exp.env.gym_env  # noqa: F401 - registers DeepRacer-v0
from deepracer_exp import load_policy
from tests.conftest import IN_PROCESS

CAMERA = (
    *("observation=camera_small", "collector.cars=4", "algorithm.frames_per_iteration=128"),
    *("algorithm.batch_size=64", "algorithm.epochs=2", "budget.env_steps=256", "checkpoints.every=null"),
)
SMALL = ("observation.camera.width=80", "observation.camera.height=60")


@pytest.mark.parametrize(
    "overrides",
    [
        ("network.critic=pictures", "network.shared_trunk=true", "observation.camera.color=rgb"),
        (
            *("observation=stereo", "network=medium", "network.hidden=[32]", "network.critic=pictures"),
            *("action_space=continuous", *SMALL),
        ),
        (
            *("observation.camera.width=100", "observation.camera.height=84", "network=deep"),
            "observation.camera.frames=2",
        ),
        ("observation=lidar", "network.critic=pictures", "observation.lidar.kind=sectors"),
        ("observation=camera_lidar", "network=attention", *SMALL, "network.shared_trunk=true"),
    ],
    ids=" ".join,
)
def test_every_kind_of_picture_and_network_trains_and_is_raced(trained, call, overrides):
    ended = trained(*CAMERA, *overrides)
    assert ended.code == 0, ended.stderr
    losses = [row["value_loss"] for row in ended.metrics]
    assert len(set(losses)) == len(losses)
    assert all(np.isfinite(row["grad_norm"]) and row["grad_norm"] > 0 for row in ended.metrics)
    raced = call("evaluate", str(ended.folder), "evaluation.trials=1", "evaluation.time_s=2")
    assert raced.code == 0, raced.stderr


SENSORS = ("observation=camera_lidar", *SMALL)

# The service's reach of 1 m ends before the walls of the default track.
FAR_LIDAR = ("observation=lidar", "observation.lidar.reach_m=12")


@pytest.mark.parametrize("sensors", [(), SENSORS, FAR_LIDAR], ids=["camera", "both", "lidar"])
def test_the_stored_policy_and_its_onnx_file_see_the_same(trained, call, tmp_path, sensors):
    ended = trained(*CAMERA, *sensors, "action_space=discrete")
    exported = call("export", str(ended.folder), "format=onnx", "-o", str(tmp_path / "policy.onnx"))
    assert exported.code == 0, exported.stderr
    env = gymnasium.make_vec("DeepRacer-v0", num_envs=6, overrides=sensors or ["observation=camera_small"])
    seen, _ = env.reset()
    if not isinstance(seen, dict):
        seen = {"lidar" if sensors else "pixels": seen}
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"), providers=["CPUExecutionProvider"])
    theirs = session.run(["policy"], seen)[0]
    given = TensorDict({key: torch.from_numpy(values) for key, values in seen.items()}, [6])
    with torch.no_grad():
        ours = load_policy(ended.folder).get_dist(given).probs.numpy()
    assert np.abs(theirs - ours).max() < 0.01  # products in bfloat16
    assert np.abs(theirs[0] - theirs[-1]).max() > 0


def test_the_memory_of_pictures_is_shown_before_the_run_and_refused_with_what_fits(
    trained, copied, call, monkeypatch
):
    started, resumed = trained(*CAMERA), call("resume", copied(*CAMERA).name, "budget.env_steps=384")
    for ended in (started, resumed):
        (line,) = (line for line in ended.stderr.splitlines() if line.startswith("pictures: "))
        assert "0.0 GB of memory for the 128 steps" in line
    free = psutil.virtual_memory()._replace(available=8 * 2**30)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    big = "algorithm.frames_per_iteration=10000000"
    refused = call("train", *IN_PROCESS, "observation=camera", "name=big", big)
    refused.assert_refused("up to ")
    assert int(refused.complaint.split("up to ")[1].split(",")[0]) < 10_000_000


@pytest.mark.parametrize(("threads", "most"), [(1, 1), (0, 2)])
def test_an_update_takes_the_cores_that_are_the_trainings_own(call, monkeypatch, threads, most):
    # Two trials of a sweep, or two trainings, that each update on all cores take five times as long.
    asked, set_threads = [], torch.set_num_threads
    monkeypatch.setattr("deepracer_exp.training.trainer.cores", lambda: 2)
    monkeypatch.setattr(torch, "set_num_threads", lambda count: (asked.append(count), set_threads(count)))
    ended = call("train", *IN_PROCESS, *CAMERA, "budget.env_steps=128", f"collector.threads={threads}")
    assert ended.code == 0, ended.stderr
    assert max(asked) == most


def test_the_report_shows_what_the_policy_sees_along_a_lap(trained, call, tmp_path):
    ended = trained(*CAMERA)
    page = tmp_path / "report.html"
    assert call("analyze", str(ended.folder), "-o", str(page)).code == 0
    html = page.read_text(encoding="utf-8")
    assert "What it sees" in html
    assert html.count("data:image/png;base64,") == 16


def test_a_clone_keeps_what_the_networks_were_made_for(copied, call):
    parent = copied(*CAMERA)
    cloned = call("clone", parent.name, "budget.env_steps=128")
    assert cloned.code == 0, cloned.stderr
    for changes, words in (
        (["observation.camera.width=100"], ["camera.width: 80 -> 100"]),
        (SENSORS, ["cannot be changed in a clone", "lidar"]),
    ):
        call("clone", parent.name, *changes).assert_refused(*words)


@pytest.mark.processes
def test_a_promoted_model_says_that_it_reads_pictures(call, mlflow_here):
    evaluated = ("checkpoints.every=1", "evaluation.trials=1", "evaluation.time_s=1", "budget.env_steps=128")
    ended = call("train", *IN_PROCESS, *CAMERA, *evaluated, "tracking=mlflow", "name=eye")
    assert ended.code == 0, ended.stderr
    promoted = call("runs", "promote", ended.folder.name)
    assert promoted.code == 0, promoted.stderr
    version = mlflow_here.get_model_version_by_alias("eye", "champion")
    logged = mlflow_here.get_logged_model(version.source.removeprefix("models:/"))
    folder = Path(logged.artifact_location.removeprefix("file://"))
    (spec,) = Model.load(str(folder / "MLmodel")).signature.inputs.inputs
    assert (spec.name, spec.type, spec.shape) == ("pixels", np.dtype(np.uint8), (-1, 1, 60, 80))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("observation=camera", "network=mlp_small"), ("network", "features", "cnn_small")),
        (("network=shallow",), ("network", "pictures", "observation=camera")),
        (("observation=camera_small", "network=deep"), ("network.kernels", "80x60")),
        (("observation=lidar", "network=mlp_small"), ("network", "features", "network=lidar")),
        (("observation=lidar", "network=deep"), ("network", "pictures", "network=lidar")),
        (("observation=camera", "network=lidar"), ("network.filters", "cnn_small")),
        (("network=lidar",), ("network", "observation=lidar")),
        (("observation=camera_lidar", "network.lidar_joins_after=1"), ("lidar_joins_after", "0 to 0")),
        (("observation=lidar", "observation.lidar.sectors=7"), ("observation.lidar.sectors", "7")),
        (("observation=lidar", "observation.lidar.reach_m=13"), ("observation.lidar.reach_m", "13")),
        (("observation=camera_small", "network.shared_trunk=true"), ("shared_trunk", "features")),
        (("observation=camera_small", "network.strides=[1]"), ("network", "strides")),
    ],
)
def test_a_network_that_cannot_read_what_is_seen_is_refused_in_one_line(call, overrides, words):
    call("train", *overrides).assert_bad_input(*words)
