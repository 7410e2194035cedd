"""What the service takes as a model of its own."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.service_weights import VALUE, to_service
from deepracer_exp.aws.models.model_metadata import NEURAL_NETWORKS, ModelMetadata, read_model_metadata
from deepracer_exp.aws.models.tf_checkpoint import read_index, read_tensors
from deepracer_exp.commands.export import aws_model as exporting
from deepracer_exp.commands.export.aws_files import aws_files, services_metadata
from deepracer_exp.commands.export.aws_model import aws_model
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.custom_files.model_files import sensor_overrides
from deepracer_exp.config.named import network_overrides
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.env.observation import observation_shape
from deepracer_exp.runs.checkpoints import StoredPolicy
from tests.conftest import refused

REWARD = "def reward_function(params):\n    return 1.0\n"
CAMERA = ("FRONT_FACING_CAMERA",)


def written(*overrides, score=None):
    experiment, _ = compose_experiment(overrides)
    shape = observation_shape(experiment.observation)
    networks = build_actor_critic(
        experiment.network, shape, build_action_space(experiment.action_space).n, torch.Generator()
    )
    counters = {"iteration": 12, "env_steps": 3456}
    return networks, *aws_model(experiment, StoredPolicy(networks, Path(), counters), REWARD, score)


@pytest.mark.parametrize("network", NEURAL_NETWORKS)
@pytest.mark.parametrize("sensors", [("STEREO_CAMERAS",), (*CAMERA, "SECTOR_LIDAR")], ids="+".join)
def test_the_network_of_a_model_is_the_one_that_its_metadata_names(network, sensors):
    metadata = ModelMetadata(sensor=sensors, neural_network=network)
    experiment, _ = compose_experiment([*sensor_overrides(metadata), *network_overrides(metadata)])
    assert services_metadata(experiment).neural_network == network
    assert json.loads(aws_files(experiment, REWARD)[0]["model_metadata.json"])["neural_network"] == network


def test_the_files_are_those_that_the_service_wants():
    networks, files, _ = written("observation=camera", "network=deep", "track=Oval_track", score=87.5)
    stem = "model/12_Step-3456.ckpt"
    assert set(files) == {
        *("model_metadata.json", "model/model_metadata.json", "reward_function.py", "hyperparameters.json"),
        *("training_params.yaml", "model/.coach_checkpoint", "model/deepracer_checkpoints.json"),
        *(f"{stem}.index", f"{stem}.data-00000-of-00001", f"{stem}.meta"),
    }
    metadata = read_model_metadata("model_metadata.json", files["model_metadata.json"])
    assert (metadata.sensor, metadata.neural_network) == (CAMERA, NEURAL_NETWORKS[2])
    assert files["model/.coach_checkpoint"] == b"12_Step-3456.ckpt"
    best = json.loads(files["model/deepracer_checkpoints.json"])["best_checkpoint"]
    assert (best["name"], best["avg_eval_metric"]) == ("12_Step-3456.ckpt", 87.5)
    params = yaml.safe_load(files["training_params.yaml"])
    assert (params["WORLD_NAME"], params["TRACK_DIRECTION_CLOCKWISE"]) == ("Oval_track", False)
    index = read_index(files[f"{stem}.index"], "index")
    held = read_tensors(index, files[f"{stem}.data-00000-of-00001"], "data")
    tensors = to_service(networks, CAMERA)
    assert held.keys() == tensors.keys()
    assert all(np.array_equal(held[name], value) for name, value in tensors.items())


def test_a_value_network_of_features_is_replaced_and_the_note_says_so():
    networks, files, notes = written(
        *("observation=camera", "network=shallow", "network.critic=features", "track.direction=reversed")
    )
    assert any(note.startswith("value network: ") for note in notes)
    index = next(content for name, content in files.items() if name.endswith(".index"))
    names = read_index(index, "index")
    assert {name for name in names if name not in to_service(networks, CAMERA)} == {
        name for name in names if name.startswith(f"{VALUE}/")
    }
    assert yaml.safe_load(files["training_params.yaml"])["TRACK_DIRECTION_CLOCKWISE"] is True


@pytest.mark.parametrize(("direction", "is_clockwise"), [("forward", False), ("reversed", True)])
def test_an_open_course_is_clockwise_against_its_waypoints(direction, is_clockwise):
    experiment, _ = compose_experiment(["track=Straight_track", f"track.direction={direction}"])
    params, _ = exporting._training_params(experiment)
    assert yaml.safe_load(params)["TRACK_DIRECTION_CLOCKWISE"] is is_clockwise


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), "observation: has no camera"),
        (("observation=camera_small",), "observation.camera: 80x60; accepted: 160x120"),
        (("observation=camera", "observation.camera.frames=2"), "the policy sees 2 channels"),
        (("observation=camera", "network=cnn_small"), "network: filters=[16, 32, 32]"),
        (("observation=camera", "network=attention"), "network: has Attention layers"),
        (("observation=lidar",), "observation: has no camera"),
        (
            ("observation=camera_lidar", "observation.lidar.reach_m=3"),
            "observation.lidar.reach_m=3: accepted: 1",
        ),
        (("observation=camera_lidar", "observation.lidar.yaw_deg=0"), "observation.lidar.yaw_deg=0"),
    ],
)
def test_what_the_service_does_not_have_is_refused_with_what_it_has(overrides, words):
    assert words in refused(written, *overrides)
