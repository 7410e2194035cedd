import re
from functools import cache
from pathlib import Path

import pytest
import yaml

from deepracer_exp.aws.models import hyperparameters, model_metadata
from deepracer_exp.config.compose import Composition, compose_experiment, expand_grid
from deepracer_exp.config.custom_files.file_overrides import FileOverrides, with_custom_files
from deepracer_exp.config.custom_files.model_files import TAKEN, read_custom_files
from deepracer_exp.config.experiment import Experiment
from deepracer_exp.config.learning import PPOConfig, SACConfig
from deepracer_exp.config.overrides import override_line, parse_single
from deepracer_exp.config.parse import parse_config, parse_experiment
from deepracer_exp.config.stored import with_overrides
from deepracer_exp.errors import BadInput
from tests.conftest import refused

from .conftest import CONTINUOUS, HYPERPARAMETERS, METADATA


@cache
def default_experiment() -> Experiment:
    return compose_experiment([])[0]


def composed(folder: Path, *overrides: str) -> tuple[Experiment, Composition]:
    return compose_experiment([f"custom_files={folder}", *overrides])


def overrides_of(folder: Path, *overrides: str) -> FileOverrides:
    """Return what the files stand for, without composing it."""
    return with_custom_files([override_line("custom_files", str(folder)), *overrides])


def refusal(folder: Path) -> str:
    return refused(overrides_of, folder)


# --- What is taken


def test_the_files_of_deepracer_for_cloud_make_an_experiment(custom_files):
    folder = custom_files()
    experiment, composition = composed(folder)
    algorithm = experiment.algorithm
    assert (algorithm.lr, algorithm.batch_size, algorithm.epochs) == (3e-4, 64, 5)
    assert (algorithm.discount, algorithm.entropy_coeff, algorithm.loss_type) == (0.99, 0.01, "huber")
    assert (algorithm.episodes_per_iteration, algorithm.frames_per_iteration) == (20, None)
    assert experiment.budget.iterations == 1000
    assert experiment.action_space.kind == "discrete"
    assert [(a.steering_angle, a.speed) for a in experiment.action_space.actions] == [
        (angle, 0.6) for angle in (-30, -15, 0, 15, 30)
    ]
    assert experiment.reward.file == str(folder / "reward_function.py")
    assert composition.overrides == (f"custom_files={folder}",)
    assert composition.names == {"reward": "my model", "action_space": "my model"}
    # The folder is no longer needed for its values.
    assert parse_experiment(yaml.safe_load(composition.yaml())) == experiment
    assert experiment.action_space.file is None


def test_ranges_make_a_continuous_action_space(custom_files):
    space = composed(custom_files(metadata=CONTINUOUS))[0].action_space
    assert space.kind == "continuous"
    assert (space.steering_angle.low, space.steering_angle.high) == (-30, 30)
    assert (space.speed.low, space.speed.high) == (1, 2)


@pytest.mark.parametrize("stored", [False, True], ids=["new", "changed"])
def test_the_actions_of_a_file_are_kept_and_not_its_path(custom_files, stored):
    file = custom_files() / "model_metadata.json"
    override = f"action_space.file={file}"
    if stored:
        composition = with_overrides(
            compose_experiment(["action_space=continuous"])[1].mapping, {}, [override]
        )
        name = composition.choices["action_space"]
    else:
        composition = compose_experiment([override])[1]
        name = composition.names["action_space"]
    file.unlink()
    space = parse_experiment(yaml.safe_load(composition.yaml())).action_space
    assert (name, space.file) == ("model_metadata", None)
    assert [action.steering_angle for action in space.actions] == [-30, -15, 0, 15, 30]


@pytest.mark.parametrize("left", ["hyperparameters", "metadata", "reward"])
def test_one_file_is_enough_and_leaves_the_rest_as_it_was(custom_files, left):
    without = {key: None for key in ("hyperparameters", "metadata", "reward") if key != left}
    experiment, _ = composed(custom_files(**without))
    default = default_experiment()
    same = {
        "hyperparameters": ("reward", "action_space"),
        "metadata": ("reward", "algorithm", "budget"),
        "reward": ("action_space", "algorithm", "budget"),
    }[left]
    for group in same:
        assert getattr(experiment, group) == getattr(default, group)
    assert experiment != default


def test_a_missing_hyperparameter_is_the_services_and_reported(custom_files):
    experiment, composition = composed(custom_files({"lr": 1e-4}))
    algorithm = experiment.algorithm
    assert (algorithm.lr, algorithm.batch_size, algorithm.epochs, algorithm.discount) == (1e-4, 64, 10, 0.999)
    assert algorithm.loss_type == "mean squared error"
    assert experiment.budget.iterations is None
    (note,) = [note for note in composition.notes if "service's default" in note]
    for key in set(TAKEN) - {"lr", "term_cond_max_episodes"}:
        assert f"{key}=" in note


def test_the_folder_of_a_trained_model_is_understood(custom_files):
    folder = custom_files()
    (folder / "ip").mkdir()
    (folder / "model").mkdir()
    (folder / "hyperparameters.json").rename(folder / "ip/hyperparameters.json")
    (folder / "model_metadata.json").rename(folder / "model/model_metadata.json")
    files = read_custom_files(str(folder))
    assert files.learning["batch_size"] == 64
    assert len(files.action_space["actions"]) == 5
    assert "model/model_metadata.json" in overrides_of(folder).notes[0]
    assert "ip/hyperparameters.json" in overrides_of(folder).notes[0]


def test_a_grid_of_folders_is_a_run_each(custom_files):
    folders = [str(custom_files(folder=name)) for name in ("one", "two")]
    runs = expand_grid([f"custom_files={','.join(folders)}"])
    assert [parse_single(line).value() for (line,) in runs] == folders


def test_the_last_of_two_folders_counts(custom_files):
    first, second = custom_files(folder="one"), custom_files(metadata=None, folder="two")
    assert composed(first, f"custom_files={second}")[1].names == {"reward": "two"}
    experiment, composition = composed(first, "custom_files=null")
    assert experiment == default_experiment()
    assert "custom_files" not in composition.mapping


# --- Nothing is dropped without a word


@pytest.mark.parametrize("key", hyperparameters.KEYS)
def test_every_hyperparameter_is_taken_or_named(custom_files, key):
    other = {
        "batch_size": 128,
        "num_epochs": 4,
        "lr": 2e-4,
        "beta_entropy": 0.02,
        "discount_factor": 0.9,
        "loss_type": "mean squared error",
        "num_episodes_between_training": 40,
        "exploration_type": "e-greedy",
        "e_greedy_value": 0.1,
        "epsilon_steps": 5000,
        "stack_size": 4,
        "term_cond_max_episodes": 77,
        "term_cond_avg_score": 1.0,
        "sac_alpha": 0.5,
    }[key]
    before = overrides_of(custom_files())
    after = overrides_of(custom_files(HYPERPARAMETERS | {key: other}))
    named = [note for note in after.notes if f"{key}={other}: not applicable: " in note]
    assert len(named) == (key not in TAKEN)
    new = set(after.lines) - set(before.lines)
    assert new == ({override_line(TAKEN[key], other)} if key in TAKEN else set())


SAC_FILE = {"batch_size": 32, "lr": 2e-4, "discount_factor": 0.98, "loss_type": "mean squared error"} | {
    "exploration_type": "additive_noise",
    "num_episodes_between_training": 20,
    "sac_alpha": 0.35,
}


@pytest.mark.parametrize("metadata", [CONTINUOUS | {"training_algorithm": "sac"}, None])
def test_files_of_sac_train_with_sac_and_name_what_has_no_effect_or_differs(custom_files, metadata):
    found = overrides_of(folder := custom_files(SAC_FILE, metadata))
    algorithm = compose_experiment([f"custom_files={folder}"])[0].algorithm
    assert isinstance(algorithm, SACConfig)
    assert algorithm.alpha == 0.35
    assert (algorithm.lr, algorithm.batch_size, algorithm.discount) == (2e-4, 32, 0.98)
    notes = " ".join(found.notes)
    assert "used as algorithm=sac, algorithm.lr=0.0002" in notes
    assert "algorithm.learn_alpha=false" in notes
    assert "num_episodes_between_training=20: not applicable" in notes
    assert "exploration_type" not in notes
    assert "sac_alpha=0.35: not applicable" not in notes


def test_an_algorithm_beside_files_of_sac_wins(custom_files):
    folder = custom_files(SAC_FILE, CONTINUOUS | {"training_algorithm": "sac"})
    experiment, composition = compose_experiment([f"custom_files={folder}", "algorithm=ppo"])
    assert isinstance(experiment.algorithm, PPOConfig)
    assert any("sac_alpha=0.35: not used, because of algorithm=ppo" in note for note in composition.notes)


def test_imported_files_of_sac_become_options_of_the_same_training(custom_files, call):
    folder = custom_files(SAC_FILE, CONTINUOUS | {"training_algorithm": "sac"})
    direct = compose_experiment([f"custom_files={folder}"])[0].algorithm
    assert call("import", str(folder), "--name", "soft").code == 0
    shown = yaml.safe_load(call("train", "experiment=soft", "--cfg").stdout)
    assert parse_config(shown["algorithm"], SACConfig) == direct


def test_every_key_of_the_metadata_is_taken_or_named(custom_files):
    notes = overrides_of(custom_files()).notes
    for key in model_metadata.KEYS:
        named = any(re.match(rf"model_metadata.json: {key}\b.*: not applicable: ", note) for note in notes)
        assert named == (key not in ("action_space", "action_space_type", "training_algorithm", "version"))
    assert "model_metadata.json: version=5: used as car=deepracer_v5" in notes


def test_notes_name_unknown_keys_and_ignored_indices(custom_files):
    space = [dict(action, index=9) for action in METADATA["action_space"]]
    folder = custom_files(HYPERPARAMETERS | {"momentum": 1}, METADATA | {"foo": 2, "action_space": space})
    notes = overrides_of(folder).notes
    for part in ("hyperparameters.json: momentum: ignored", "model_metadata.json: foo: ignored", "index"):
        assert any(part in note for note in notes), part


def test_values_beyond_the_consoles_limits_are_used_and_noted(custom_files):
    found = overrides_of(custom_files(HYPERPARAMETERS | {"batch_size": 1024}))
    assert "algorithm.batch_size=1024" in found.lines
    assert any("batch_size=1024: used" in note for note in found.notes)


# --- What wins


@pytest.mark.parametrize("first", [True, False])
def test_a_value_given_wins_over_the_files_wherever_it_stands(custom_files, first):
    words = [f"custom_files={custom_files()}", "algorithm.lr=1e-5"]
    experiment, composition = compose_experiment(words[:: 1 if first else -1])
    assert experiment.algorithm.lr == 1e-5
    assert experiment.algorithm.batch_size == 64
    assert any("lr=0.0003: not used, because of algorithm.lr=1e-5" in n for n in composition.notes)


@pytest.mark.parametrize(
    ("override", "group"),
    [
        ("reward=racing_line", "reward"),
        ("reward.name=racing_line", "reward"),
        ("reward.file=other.py", "reward"),
        ("action_space=console", "action_space"),
        ("action_space.file=other.json", "action_space"),
        ("algorithm=ppo", "algorithm"),
        ("budget=short", "budget"),
        ("budget.iterations=3", "budget"),
    ],
)
def test_a_choice_given_takes_the_place_of_a_file(custom_files, override, group):
    found = overrides_of(custom_files(), override)
    lines = [line for line in found.lines if line != override]
    assert not any(re.match(rf"{group}\b", line) for line in lines)
    assert lines
    assert group not in found.names
    assert any(f"not used, because of {override}" in note for note in found.notes)


def test_the_actions_may_be_changed_within_the_files_kind(custom_files):
    experiment, _ = composed(custom_files(metadata=CONTINUOUS), "action_space.speed.high=3")
    assert (experiment.action_space.speed.low, experiment.action_space.speed.high) == (1, 3)
    with pytest.raises(BadInput, match="with action_space=continuous"):
        composed(custom_files(metadata=CONTINUOUS), "action_space.actions=[]")


@pytest.mark.parametrize(
    ("overrides", "frames", "episodes"),
    [
        ([], None, 20),
        (["algorithm.episodes_per_iteration=40"], None, 40),
        (["algorithm.frames_per_iteration=4096"], 4096, None),
        (["algorithm.frames_per_iteration=null"], None, 20),
    ],
)
def test_an_iteration_is_as_long_as_the_file_or_the_racer_says(custom_files, overrides, frames, episodes):
    algorithm = composed(custom_files(), *overrides)[0].algorithm
    assert (algorithm.frames_per_iteration, algorithm.episodes_per_iteration) == (frames, episodes)


def test_files_win_over_an_experiment_which_keeps_the_rest(custom_files):
    experiment, _ = composed(custom_files(), "experiment=tiny")
    assert (experiment.name, experiment.budget.env_steps) == ("tiny", 4096)
    assert (experiment.algorithm.batch_size, experiment.algorithm.frames_per_iteration) == (64, None)


# --- What is refused


def test_a_folder_without_any_file_is_refused_with_the_three_names(tmp_path):
    assert "holds nothing" in refusal(tmp_path)
    (tmp_path / "a\nb.txt").touch()
    assert "holds a b.txt; accepted: " in refusal(tmp_path)
    for name in ("reward_function.py", "model_metadata.json", "hyperparameters.json"):
        assert name in refusal(tmp_path)


def test_what_is_no_folder_is_refused(custom_files, tmp_path):
    assert f"custom_files {tmp_path / 'nowhere'}: cannot be read" in refusal(tmp_path / "nowhere")
    assert "Not a directory" in refusal(custom_files() / "reward_function.py")
    with pytest.raises(BadInput, match="custom_files='': no folder"):
        compose_experiment(["custom_files="])


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"hyperparameters": '{"lr": 1e-3'}, ["hyperparameters.json: not JSON"]),
        ({"hyperparameters": '{"lr": NaN}'}, ["hyperparameters.json: lr: NaN", "1e-10 to 1"]),
        ({"metadata": "{}"}, ["model_metadata.json: action_space: missing"]),
        (
            {"metadata": METADATA | {"training_algorithm": "sac"}},
            ["training_algorithm", "SAC has no discrete actions"],
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_its_key(custom_files, files, words):
    message = refusal(custom_files(**files))
    for word in words:
        assert word in message
