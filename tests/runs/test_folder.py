import errno
import json
import os
import re

import pytest
import yaml

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import load_reward_source
from deepracer_exp.runs.folder import RunFolder, git_commit
from tests.conftest import refused


@pytest.fixture
def folder(tmp_path):
    return RunFolder.create(str(tmp_path / "runs"), "some", "track-reward-seed0")


def test_two_runs_of_the_same_second_have_folders_of_their_own(tmp_path):
    folders = [RunFolder.create(str(tmp_path), "some", "label") for _ in range(3)]
    assert len({folder.path for folder in folders}) == 3
    assert all(folder.path.is_dir() for folder in folders)


@pytest.mark.parametrize("label", ["a/b", "../../up", "name with spaces", "Zürich", "a\nb", "~", ""])
def test_no_label_leads_out_of_the_experiments_folder(tmp_path, label):
    folder = RunFolder.create(str(tmp_path), "some", label)
    assert folder.path.parent == tmp_path / "some"
    assert re.fullmatch(r"[A-Za-z0-9._-]+", folder.name)


def test_it_is_described_by_what_composed_it(folder):
    experiment, composition = compose_experiment(["experiment=tiny", "seed=7"])
    reward = load_reward_source(experiment.reward)
    folder.describe(composition, reward, experiment, {"track": "reinvent_base"})
    again, _ = compose_experiment(yaml.safe_load((folder.path / "overrides.yaml").read_text()))
    assert again == experiment
    assert yaml.safe_load((folder.path / "config.yaml").read_text()) == composition.mapping
    provenance = json.loads((folder.path / "provenance.json").read_text())
    assert provenance["seed"] == 7
    assert provenance["names"] == {"track": "reinvent_base"}
    assert provenance["reward"]["sha256"] == reward.sha256
    assert {"torch", "torchrl", "mujoco", "python"} <= set(provenance["versions"])
    assert provenance["git_commit"] == git_commit()


def test_secrets_of_a_uri_are_not_written(folder):
    uri = "https://user:hunter2@example.org"
    experiment, composition = compose_experiment([f"tracking.uri='{uri}'"])
    folder.describe(composition, load_reward_source(experiment.reward), experiment, {})
    for path in folder.path.iterdir():
        assert "hunter2" not in path.read_text()


def test_a_file_is_there_whole_or_not_at_all(folder, monkeypatch):
    folder.write("summary.json", "old")

    def full(self, content):
        with self.open("wb") as file:
            file.write(content[:2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        folder.write("summary.json", "new")
    assert (folder.path / "summary.json").read_text() == "old"
    assert sorted(path.name for path in folder.path.iterdir()) == [".running", "summary.json"]


def test_a_folder_that_cannot_be_made_is_bad_input(tmp_path):
    (tmp_path / "file").write_text("")
    assert "runs_dir=" in refused(RunFolder.create, str(tmp_path / "file"), "some", "label")


def test_no_other_process_may_train_in_a_folder_until_it_is_released(folder):
    with pytest.raises(BadInput, match="a process is training in it"):
        RunFolder(folder.path)
    folder.release()
    RunFolder(folder.path).release()
    assert not list(folder.path.iterdir())
