import dataclasses
from functools import cache
from pathlib import Path

import pytest

from deepracer_exp.config.compose import Composition, compose_experiment
from deepracer_exp.config.custom_files.imported_options import import_files
from deepracer_exp.config.custom_files.model_files import read_custom_files
from tests.conftest import refused

from .conftest import CONTINUOUS, METADATA, REWARD

pytestmark = pytest.mark.usefixtures("here")


def bring(folder: Path, name: str) -> list[str]:
    _, composition = compose_experiment([f"custom_files={folder}"])
    return [str(path) for path in import_files(read_custom_files(str(folder)), name, composition.mapping)]


@cache
def default_composition() -> Composition:
    return compose_experiment([])[1]


def refusal(folder: Path, name: str) -> str:
    # Its values are not what is refused.
    message = refused(import_files, read_custom_files(str(folder)), name, default_composition().mapping)
    assert message.startswith(("--name ", "conf"))
    return message


def everything(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("metadata", [METADATA, CONTINUOUS])
def test_the_imported_experiment_is_the_one_of_the_files(custom_files, metadata, here):
    folder = custom_files(metadata=metadata)
    assert bring(folder, "mine") == [
        "conf/reward/mine.py",
        "conf/reward/mine.yaml",
        "conf/action_space/mine.yaml",
        "conf/algorithm/mine.yaml",
        "conf/experiment/mine.yaml",
    ]
    files, _ = compose_experiment([f"custom_files={folder}"])
    imported, composition = compose_experiment(["experiment=mine"])
    copy = here / "conf/reward/mine.py"
    assert imported == dataclasses.replace(
        files, name="mine", reward=dataclasses.replace(files.reward, name="mine", file=str(copy))
    )
    assert copy.read_text() == REWARD
    for group in ("reward", "action_space", "algorithm", "experiment"):
        assert composition.choices[group] == "mine"


def test_an_imported_experiment_has_the_track_the_starts_and_the_car_of_the_files(custom_files):
    folder = custom_files(metadata=METADATA | {"version": 4})
    (folder / "run.env").write_text(
        "DR_WORLD_NAME=Bowtie_track\nDR_TRAIN_REVERSE_DIRECTION=True\nDR_TRAIN_CHANGE_START_POSITION=False\n"
    )
    bring(folder, "mine")
    files, _ = compose_experiment([f"custom_files={folder}"])
    imported, composition = compose_experiment(["experiment=mine"])
    assert (imported.track, imported.episode, imported.car) == (files.track, files.episode, files.car)
    assert (composition.choices["track"], composition.choices["car"]) == ("Bowtie_track", "deepracer_v4")
    assert (imported.track.direction, imported.episode.start_advance) == ("reversed", 0.0)


def test_an_imported_option_combines_with_others(custom_files):
    bring(custom_files(), "mine")
    experiment, _ = compose_experiment(
        ["reward=mine", "action_space=console", "reward.constants.WEIGHT=3", "track=Oval_track"]
    )
    assert experiment.reward.constants == {"WEIGHT": 3}
    experiment, _ = compose_experiment(["experiment=mine", "algorithm.lr=1e-5", "reward=racing_line"])
    assert (experiment.algorithm.lr, experiment.algorithm.batch_size) == (1e-5, 64)
    assert (experiment.reward.name, experiment.reward.file) == ("racing_line", None)


@pytest.mark.parametrize(
    ("left", "group"), [("hyperparameters", "algorithm"), ("metadata", "action_space"), ("reward", "reward")]
)
def test_one_file_makes_one_option_and_an_experiment(custom_files, left, group):
    folder = custom_files(**{key: None for key in ("hyperparameters", "metadata", "reward") if key != left})
    written = bring(folder, "a.b")
    assert {Path(path).parent.name for path in written} == {group, "experiment"}
    composition = compose_experiment(["experiment=a.b"])[1]
    assert composition.choices[group] == "a.b"


@pytest.mark.parametrize("name", ["../x", "", "a/b", "-x", "a b", "x" * 81, "123", "1e5", "null", "x.yaml"])
def test_what_is_no_plain_name_is_refused(custom_files, name, here):
    assert "name" in refusal(custom_files(), name)
    assert everything(here) == []


@pytest.mark.parametrize("name", ["reward/mine.py", "reward/mine.yaml", "experiment/mine.yaml"])
def test_a_file_that_is_there_is_named_and_left_alone(custom_files, here, own, name):
    path = own(name, "# mine\n")
    before = everything(here)
    assert f"conf/{name} exists already" in refusal(custom_files(), "mine")
    assert everything(here) == before
    assert path.read_text() == "# mine\n"
    assert "action_space/console.yaml exists already" in refusal(custom_files(), "console")


@pytest.mark.parametrize("blocked", ["conf", "conf/algorithm", "conf/experiment"])
def test_nothing_is_left_of_an_import_that_fails(custom_files, here, blocked):
    path = here / blocked
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("a file where a folder should be")
    before = everything(here)
    assert "cannot be written" in refusal(custom_files(), "mine")
    assert everything(here) == before


def test_a_folder_with_a_line_break_in_its_name_makes_no_other_yaml(custom_files):
    folder = custom_files(folder="my\nseed: 7\n#")
    files = read_custom_files(str(folder))
    import_files(files, "mine", compose_experiment([f"custom_files='{folder}'"])[1].mapping)
    assert compose_experiment(["experiment=mine"])[0].seed == 0
