"""run.env and experiments/NAME of deepracer-for-cloud, and training_params.yaml of a trained model."""

import re
from pathlib import Path

import pytest

from deepracer_exp.aws.models.job_settings import read_training_params
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.config.custom_files.job_overrides import job_overrides
from deepracer_exp.config.custom_files.model_files import read_custom_files
from deepracer_exp.errors import BadInput

from .conftest import METADATA, REWARD, composed

# The keys of deepracer-for-cloud's template for run.env.
RUN_ENV = {
    "DR_RUN_ID": "0",
    "DR_WORLD_NAME": "Oval_track",
    "DR_RACE_TYPE": "TIME_TRIAL",
    "DR_CAR_NAME": "FastCar",
    "DR_CAR_COLOR": "Red",
    "DR_DISPLAY_NAME": "$DR_CAR_NAME",
    "DR_ENABLE_DOMAIN_RANDOMIZATION": "False",
    "DR_EVAL_NUMBER_OF_TRIALS": "3",
    "DR_EVAL_OFF_TRACK_PENALTY": "5.0",
    "DR_TRAIN_CHANGE_START_POSITION": "True",
    "DR_TRAIN_REVERSE_DIRECTION": "False",
    "DR_TRAIN_ALTERNATE_DRIVING_DIRECTION": "False",
    "DR_TRAIN_START_POSITION_OFFSET": "0.0",
    "DR_TRAIN_ROUND_ROBIN_ADVANCE_DIST": "0.05",
    "DR_TRAIN_MULTI_CONFIG": "False",
    "DR_TRAIN_MIN_EVAL_TRIALS": "5",
    "DR_TRAIN_BEST_MODEL_METRIC": "progress",
    "DR_LOCAL_S3_MODEL_PREFIX": "rl-deepracer-sagemaker",
    "DR_LOCAL_S3_PRETRAINED": "False",
    "DR_LOCAL_S3_CUSTOM_FILES_PREFIX": "custom_files",
    "DR_LOCAL_S3_REWARD_KEY": "$DR_LOCAL_S3_CUSTOM_FILES_PREFIX/reward_function.py",
    "DR_OA_NUMBER_OF_OBSTACLES": "6",
    "DR_H2B_BOT_CAR_SPEED": "0.2",
}


@pytest.fixture
def drfc(tmp_path, custom_files):
    """Write a folder of deepracer-for-cloud: its three files and run.env."""

    def write(run_env: dict[str, str], folder: str = "drfc") -> Path:
        path = tmp_path / folder
        path.mkdir(parents=True, exist_ok=True)
        custom_files(folder=f"{folder}/custom_files")
        lines = [f"{key}={value}" for key, value in (RUN_ENV | run_env).items()]
        (path / "run.env").write_text("\n".join(["# of deepracer-for-cloud", "", *lines]))
        return path

    return write


def test_a_folder_of_deepracer_for_cloud_trains_on_its_track_from_its_starts(drfc):
    changed = {
        "DR_WORLD_NAME": "2022_reinvent_champ",
        "DR_TRAIN_REVERSE_DIRECTION": "True",
        "DR_TRAIN_START_POSITION_OFFSET": "0.3",
        "DR_TRAIN_ROUND_ROBIN_ADVANCE_DIST": '"0.1"  # of the lap',
    }
    experiment, notes = composed(drfc(changed))
    assert (experiment.track.name, experiment.track.direction) == ("2022_reinvent_champ", "reversed")
    assert (experiment.episode.start_offset, experiment.episode.start_advance) == (0.3, 0.1)
    assert (experiment.car.name, experiment.algorithm.batch_size) == ("deepracer_v5", 64)
    assert experiment.reward.file.endswith("drfc/custom_files/reward_function.py")
    assert (
        "run.env: used as track=2022_reinvent_champ, track.direction=reversed, episode.start_advance=0.1, "
        "episode.start_offset=0.3" in notes
    )


def test_keys_of_earlier_versions_count_where_the_new_ones_are_missing(drfc):
    folder = drfc({"DR_CHANGE_START_POSITION": "False", "DR_ALTERNATE_DRIVING_DIRECTION": "True"})
    experiment, _ = composed(folder)
    assert (experiment.episode.start_advance > 0, experiment.track.direction) == (True, "forward")
    lines = (folder / "run.env").read_text().splitlines()
    new = ("DR_TRAIN_CHANGE", "DR_TRAIN_ALTERNATE", "DR_TRAIN_ROUND")
    (folder / "run.env").write_text("\n".join(line for line in lines if not line.startswith(new)))
    experiment, notes = composed(folder)
    assert (experiment.episode.start_advance, experiment.track.direction) == (0.0, "alternate")
    assert not any("DR_CHANGE_START_POSITION" in note for note in notes)


@pytest.mark.parametrize(
    ("key", "value", "attribute", "expected"),
    [
        ("DR_TRAIN_CHANGE_START_POSITION", "False", "start_advance", 0.0),
        ("DR_TRAIN_START_POSITION_OFFSET", "1.0", "start_offset", 0.0),
    ],
)
def test_starts_are_those_of_the_service(drfc, key, value, attribute, expected):
    assert getattr(composed(drfc({key: value}))[0].episode, attribute) == expected


def test_each_key_is_used_or_named_with_the_reason(drfc):
    _, notes = composed(drfc({}))
    text = "\n".join(note for note in notes if note.startswith("run.env: "))
    used = {
        *("DR_WORLD_NAME", "DR_RACE_TYPE", "DR_ENABLE_DOMAIN_RANDOMIZATION", "DR_LOCAL_S3_PRETRAINED"),
        *("DR_TRAIN_CHANGE_START_POSITION", "DR_TRAIN_REVERSE_DIRECTION", "DR_TRAIN_START_POSITION_OFFSET"),
        *(
            "DR_TRAIN_ALTERNATE_DRIVING_DIRECTION",
            "DR_TRAIN_ROUND_ROBIN_ADVANCE_DIST",
            "DR_TRAIN_MULTI_CONFIG",
        ),
        "DR_LOCAL_S3_REWARD_KEY",
    }
    for key in RUN_ENV.keys() - used:
        alike = re.escape(re.sub(r"^(DR_[A-Z0-9]+_).+", r"\1*", key))
        assert re.search(rf"(^|[ ,])({key}|{alike})[:,]", text), key


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("DR_RACE_TYPE", "HEAD_TO_MODEL", "race=head_to_head"),
        ("DR_ENABLE_DOMAIN_RANDOMIZATION", "True", "randomization=sim2real"),
        ("DR_LOCAL_S3_PRETRAINED", "True", "the training starts fresh"),
    ],
)
def test_what_decides_and_is_not_applied_is_named(drfc, key, value, word):
    _, notes = composed(drfc({key: value}))
    (note,) = [note for note in notes if note.startswith(f"run.env: {key}=")]
    assert "not applied" in note
    assert word in note


def test_an_experiment_of_deepracer_for_cloud_is_a_folder_and_others_are_named(drfc):
    root = drfc({})
    drfc({"DR_WORLD_NAME": "Bowtie_track"}, "drfc/experiments/sprint-v1")
    experiment, notes = composed(root)
    assert list(experiment.tracks) == ["Oval_track"]
    own = f"custom_files={root}/experiments/sprint-v1"
    assert f"experiments/sprint-v1: not used; {own} trains it" in notes
    experiment, _ = composed(root / "experiments/sprint-v1")
    assert list(experiment.tracks) == ["Bowtie_track"]
    assert "experiments/sprint-v1/custom_files" in experiment.reward.file
    (root / "run.env").unlink()
    for path in (root / "custom_files").iterdir():
        path.unlink()
    with pytest.raises(BadInput, match=f"accepted: a folder with .*{own} trains it$"):
        read_custom_files(str(root))


def test_a_reward_that_run_env_chooses_is_the_one_that_trains(drfc):
    key = {"DR_LOCAL_S3_REWARD_KEY": "$DR_LOCAL_S3_CUSTOM_FILES_PREFIX/reward_v2.py"}
    folder = drfc(key)
    with pytest.raises(
        BadInput, match=r"holds custom_files/reward_function.py but no reward_v2.py; accepted: "
    ):
        composed(folder)
    (folder / "custom_files/reward_v2.py").write_text(REWARD)
    experiment, notes = composed(folder)
    assert experiment.reward.file.endswith("custom_files/reward_v2.py")
    assert "custom_files/reward_function.py: not used, because of reward_v2.py" in notes


@pytest.mark.parametrize("key", ["../../secret.py", "/etc/x.py", "..", "a\\..\\b.py"])
def test_a_file_that_run_env_chooses_is_looked_for_in_the_folder_only(drfc, tmp_path, key):
    (tmp_path / "secret.py").write_text(REWARD)
    folder = drfc({"DR_LOCAL_S3_REWARD_KEY": key})
    experiment, _ = composed(folder, "reward=racing_line")
    assert experiment.reward.file is None
    assert all(
        Path(path).resolve().is_relative_to(folder) for path in read_custom_files(str(folder)).paths.values()
    )


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("DR_WORLD_NAME", "Ovel_track", ["no such world (did you mean Oval_track?)", "track=NAME"]),
        ("DR_RACE_TYPE", "TIME_TRAIL", ["accepted: TIME_TRIAL"]),
        ("DR_TRAIN_REVERSE_DIRECTION", "maybe", ["accepted: True, False"]),
        ("DR_TRAIN_ROUND_ROBIN_ADVANCE_DIST", "5%", ["accepted: a share of the lap, 0 to 1"]),
        ("DR_TRAIN_START_POSITION_OFFSET", "nan", ["accepted: a share of the lap, 0 to 1"]),
    ],
)
def test_a_value_that_cannot_be_used_is_named_with_its_key(drfc, key, value, words):
    with pytest.raises(BadInput) as error:
        composed(drfc({key: value}))
    for word in (f"run.env: {key}={value}", *words):
        assert word in str(error.value)


def test_a_line_that_is_none_is_named_and_a_track_beside_it_is_taken(drfc):
    folder = drfc({"DR_WORLD_NAME": "moon"})
    assert list(composed(folder, "track=Bowtie_track")[0].tracks) == ["Bowtie_track"]
    (folder / "run.env").write_text("DR_WORLD_NAME = Oval_track\n")
    with pytest.raises(
        BadInput, match=r"run.env: line 1: DR_WORLD_NAME = Oval_track; accepted: lines KEY=VALUE"
    ):
        read_custom_files(str(folder))


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("WORLD_NAME: Oval_track\nREVERSE_DIR: true\n", ["track='Oval_track'", "track.direction='reversed'"]),
        (
            "WORLD_NAME: ['Oval_track']\nREVERSE_DIR: 'False'\n",
            ["track='Oval_track'", "track.direction='forward'"],
        ),
        # deepracer-on-aws: the world's name and the direction, of which some worlds have one each.
        (
            "WORLD_NAME: 2022_april_open\nTRACK_DIRECTION_CLOCKWISE: true\n",
            ["track='2022_april_open_cw'", "track.direction='forward'"],
        ),
        (
            "WORLD_NAME: Oval_track\nTRACK_DIRECTION_CLOCKWISE: true\n",
            ["track='Oval_track'", "track.direction='reversed'"],
        ),
        (
            "WORLD_NAME: Oval_track\nTRACK_DIRECTION_CLOCKWISE: false\n",
            ["track='Oval_track'", "track.direction='forward'"],
        ),
    ],
)
def test_the_parameters_of_a_trained_model_say_where_it_was(tmp_path, text, lines):
    (tmp_path / "training_params.yaml").write_text(text)
    found, notes = job_overrides(read_training_params(str(tmp_path / "training_params.yaml")), {})
    assert found == lines
    shown = ", ".join(lines).replace("'", "")
    assert notes == [f"training_params.yaml: used as {shown}"]


def test_of_several_workers_the_first_counts_and_the_others_are_named(tmp_path, drfc):
    text = "WORLD_NAME: [Oval_track, Bowtie_track]\nREVERSE_DIR: [true, false]\n"
    (tmp_path / "training_params.yaml").write_text(text)
    lines, notes = job_overrides(read_training_params(str(tmp_path / "training_params.yaml")), {})
    assert lines == ["track='Oval_track'", "track.direction='reversed'"]
    more = "further workers: not applied: track=[A,B] trains on several tracks"
    assert notes[1:] == [f"training_params.yaml: {more}"]
    _, notes = composed(drfc({"DR_TRAIN_MULTI_CONFIG": "True"}))
    assert f"run.env: {more}" in notes


def test_the_parameters_of_a_trained_model_are_none_of_its_custom_files(custom_files):
    folder = custom_files()
    (folder / "training_params.yaml").write_text("WORLD_NAME: Oval_track\n")
    assert composed(folder)[0].track.name == "reinvent_base"


# --- Files under other names


@pytest.mark.parametrize(
    ("usual", "other", "group"),
    [
        ("reward_function.py", "reward.py", "reward"),
        ("reward_function.py", "reward_v7.py", "reward"),
        ("hyperparameters.json", "hyperparams.json", "algorithm"),
        ("model_metadata.json", "model_metadata_cont.json", "action_space"),
    ],
)
def test_a_file_under_another_name_is_used_where_it_is_alone(custom_files, usual, other, group):
    folder = custom_files()
    expected, _ = composed(folder)
    (folder / usual).rename(folder / other)
    experiment, notes = composed(folder)
    if group == "reward":
        assert experiment.reward.file == str(folder / other)
    else:
        assert getattr(experiment, group) == getattr(expected, group)
    assert other in notes[0]
    # Beside the usual one it is named.
    (folder / usual).write_bytes((folder / other).read_bytes())
    assert f"{other}: not used, because of {usual}" in composed(folder)[1]


def test_none_of_several_rewards_is_chosen_for_the_racer(custom_files):
    folder = custom_files(reward=None)
    for name in ("reward_a.py", "reward_b.py"):
        (folder / name).write_text(REWARD)
    with pytest.raises(
        BadInput, match=r"holds reward_a.py, reward_b.py but no reward_function.py; accepted: "
    ):
        composed(folder)
    chosen = f"reward.file={folder / 'reward_b.py'}"
    experiment, notes = composed(folder, chosen)
    assert experiment.reward.file == str(folder / "reward_b.py")
    assert f"reward_a.py, reward_b.py: not used, because of {chosen}" in notes


# --- The car


@pytest.mark.parametrize(
    ("version", "car"), [("4", "deepracer_v4"), (5, "deepracer_v5"), (6, "deepracer_v6")]
)
def test_the_car_is_that_of_the_models_simulation_version(custom_files, version, car):
    folder = custom_files(metadata=METADATA | {"version": version})
    assert composed(folder)[0].car.name == car
    experiment, notes = composed(folder, "car=ideal")
    assert experiment.car.name == "ideal"
    assert f"model_metadata.json: version={version}: not used, because of car=ideal" in notes


@pytest.mark.parametrize("version", [None, 1, 3])
def test_a_version_without_a_car_of_ours_changes_none(custom_files, version):
    metadata = {key: value for key, value in METADATA.items() if key != "version"}
    metadata |= {} if version is None else {"version": version, "sensor": ["FRONT_FACING_CAMERA"]}
    experiment, notes = composed(custom_files(metadata=metadata))
    assert experiment.car == compose_experiment([])[0].car
    named = [
        note for note in notes if note.startswith(f"model_metadata.json: version={version}: not applicable: ")
    ]
    assert len(named) == (version is not None)
