import json

import pytest

from deepracer_exp.aws.models.hyperparameters import read_hyperparameters
from deepracer_exp.aws.models.model_metadata import read_model_metadata
from deepracer_exp.commands.export.aws_files import aws_files
from deepracer_exp.commands.export.written import write_files
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.custom_files.model_files import read_custom_files, sensor_overrides
from deepracer_exp.env.action_space import build_action_space
from deepracer_exp.errors import BadInput

REWARD = "def reward_function(params):\n    return params['speed']\n"


def files(*overrides: str) -> tuple[dict[str, str], list[str]]:
    experiment, _ = compose_experiment(overrides)
    return aws_files(experiment, REWARD)


@pytest.mark.parametrize("space", ["console", "discrete", "grid_fine", "continuous"])
def test_what_is_exported_trains_the_same_when_it_comes_back(tmp_path, space):
    overrides = (
        *(f"action_space={space}", "algorithm.lr=5e-4", "algorithm.batch_size=128", "algorithm.epochs=7"),
        *("algorithm.discount=0.97", "algorithm.entropy_coeff=0.02", "budget.iterations=33"),
        *("algorithm.episodes_per_iteration=40", "algorithm.frames_per_iteration=null"),
        "algorithm.loss_type='mean squared error'",
    )
    texts, notes = files(*overrides)
    write_files(texts, tmp_path / "aws")
    sent, _ = compose_experiment(overrides)
    back, _ = compose_experiment([f"custom_files={tmp_path / 'aws'}"])
    assert back.algorithm == sent.algorithm
    assert back.budget.iterations == 33
    ours, theirs = (build_action_space(experiment.action_space) for experiment in (sent, back))
    assert type(ours) is type(theirs)
    for field in vars(ours):
        assert getattr(ours, field).tolist() == getattr(theirs, field).tolist()
    assert (tmp_path / "aws" / "reward_function.py").read_text() == REWARD
    assert notes == []


def test_files_of_sac_come_back_as_sac_with_the_same_hyperparameters(tmp_path):
    overrides = ("algorithm=sac", "action_space=continuous", "algorithm.alpha=0.3", "algorithm.lr=2e-4")
    texts, notes = files(*overrides)
    write_files(texts, tmp_path / "aws")
    back, _ = compose_experiment([f"custom_files={tmp_path / 'aws'}"])
    assert back.algorithm == compose_experiment(overrides)[0].algorithm
    assert json.loads(texts["model_metadata.json"])["training_algorithm"] == "sac"
    assert json.loads(texts["hyperparameters.json"])["exploration_type"] == "additive_noise"
    assert any("sac_alpha fixed" in note for note in notes)


def test_files_of_sac_with_a_list_of_actions_are_refused():
    with pytest.raises(BadInput, match=r"algorithm: SAC with a list of .* actions.*accepted: "):
        files("algorithm=sac", "action_space=discrete")


@pytest.mark.parametrize("car", ["deepracer_v4", "deepracer_v5", "deepracer_v6"])
def test_an_exported_model_comes_back_to_its_car(tmp_path, car):
    write_files(files(f"car={car}")[0], tmp_path / "aws")
    assert compose_experiment([f"custom_files={tmp_path / 'aws'}"])[0].car.name == car


@pytest.mark.parametrize(
    "overrides",
    [
        ("observation=camera",),
        ("observation=stereo",),
        ("observation=camera_lidar",),
        ("observation=camera_lidar", "observation.camera.stereo_m=0.06", "observation.lidar.kind=sectors"),
        (
            *(
                "observation=camera_lidar",
                "observation.lidar.kind=discretized",
                "observation.lidar.sectors=16",
            ),
            *("observation.lidar.values_per_sector=3", "observation.lidar.reach_m=4.5"),
        ),
    ],
)
def test_exported_sensors_name_the_overrides_that_have_them(tmp_path, overrides):
    write_files(files(*overrides)[0], tmp_path)
    named = sensor_overrides(read_model_metadata(tmp_path / "model_metadata.json"))
    assert named == list(overrides)
    note = f"the same sensors: {' '.join(overrides)}"
    assert any(line.endswith(note) for line in read_custom_files(str(tmp_path)).remarks())


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("algorithm.batch_size=1024", "batch_size", 512),
        ("algorithm.batch_size=100", "batch_size", 128),
        ("algorithm.batch_size=16", "batch_size", 32),
        ("algorithm.lr=0.01", "lr", 0.001),
        ("algorithm.epochs=20", "num_epochs", 10),
        ("algorithm.epochs=1", "num_epochs", 3),
    ],
)
def test_values_beyond_the_console_are_clipped_and_reported(tmp_path, override, key, value):
    texts, notes = files("algorithm.batch_size=64", override)
    write_files(texts, tmp_path)
    learning = read_hyperparameters(tmp_path / "hyperparameters.json")
    assert getattr(learning, key) == value
    assert learning.beyond_console() == ()
    assert any(note.startswith(f"hyperparameters.json: {key}={value}, the nearest to") for note in notes)


def test_steps_in_place_of_episodes_leave_the_services_own_number_and_are_reported():
    texts, notes = files("algorithm.batch_size=64")
    assert json.loads(texts["hyperparameters.json"])["num_episodes_between_training"] == 20
    assert "num_episodes_between_training=20" in notes[0]
    assert "8192 control steps" in notes[0]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["action_space=grid", "action_space.steering_levels=17"], "34 actions"),
        (
            ["action_space=continuous", "action_space.speed.low=0.3"],
            "speed from 0.3 to 4; the AWS console accepts 0.5",
        ),
    ],
)
def test_an_action_space_beyond_the_console_is_kept_and_reported(overrides, words):
    assert any(words in note for note in files(*overrides)[1])


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"file.*cannot be written"):
        write_files(files()[0], tmp_path / "file")
