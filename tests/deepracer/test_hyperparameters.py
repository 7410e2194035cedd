import json
import os
from pathlib import Path

import pytest

from deepracer_exp.deepracer.hyperparameters import KEYS, Hyperparameters, read_hyperparameters
from deepracer_exp.errors import BadInput

# deepracer-for-cloud's own file.
DRFC = {
    "batch_size": 64,
    "beta_entropy": 0.01,
    "discount_factor": 0.99,
    "e_greedy_value": 0.05,
    "epsilon_steps": 10000,
    "exploration_type": "categorical",
    "loss_type": "huber",
    "lr": 0.0003,
    "num_episodes_between_training": 20,
    "num_epochs": 5,
    "stack_size": 1,
    "term_cond_avg_score": 350.0,
    "term_cond_max_episodes": 1000,
    "sac_alpha": 0.2,
}


def write(folder: Path, content: object) -> Path:
    path = folder / "hyperparameters.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(folder: Path, content: object) -> Hyperparameters:
    return read_hyperparameters(write(folder, content))


def refusal(path: Path) -> str:
    with pytest.raises(BadInput) as caught:
        read_hyperparameters(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    assert "accepted: " in message
    return message


def test_every_key_of_deepracer_for_clouds_file_is_read(tmp_path):
    found = read(tmp_path, DRFC)
    assert set(DRFC) == set(KEYS) == set(found.given)
    assert {key: getattr(found, key) for key in KEYS} == DRFC
    assert found.beyond_console() == ()


def test_a_key_that_is_missing_has_the_services_default(tmp_path):
    found = read(tmp_path, {"lr": 1e-4})
    assert found == Hyperparameters(lr=1e-4, given=("lr",))
    assert (found.batch_size, found.num_epochs, found.discount_factor) == (64, 10, 0.999)
    assert (found.loss_type, found.num_episodes_between_training) == ("mean squared error", 20)


def test_numbers_may_be_text_and_words_of_any_case(tmp_path):
    text = {key: str(value).upper() for key, value in DRFC.items()}
    assert read(tmp_path, text) == read(tmp_path, DRFC)


def test_of_a_key_that_is_there_twice_the_last_counts(tmp_path):
    assert read(tmp_path, '{"lr": 1e-3, "lr": 2e-4}').lr == 2e-4


def test_unknown_keys_are_ignored_and_told(tmp_path):
    found = read(tmp_path, {"momentum": [0.9], **DRFC})
    assert found.given[0] == "momentum"
    assert found.lr == DRFC["lr"]


def test_a_byte_order_mark_is_no_fault(tmp_path):
    path = tmp_path / "hyperparameters.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(DRFC).encode())
    assert read_hyperparameters(path).num_epochs == 5


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("batch_size", 100, ("batch_size",)),
        ("batch_size", 1024, ("batch_size",)),
        ("num_epochs", 2, ("num_epochs",)),
        ("lr", 0.01, ("lr",)),
        ("num_episodes_between_training", 200, ("num_episodes_between_training",)),
        ("batch_size", 512, ()),
    ],
)
def test_what_only_the_console_refuses_is_told(tmp_path, key, value, told):
    found = read(tmp_path, DRFC | {key: value})
    assert getattr(found, key) == value
    assert found.beyond_console() == told


@pytest.mark.parametrize(
    ("key", "value", "accepted"),
    [
        ("batch_size", 0, "a number from 1 to 1e+06"),
        ("batch_size", 64.5, "a whole number from 1"),
        ("batch_size", "many", "a number from 1"),
        ("batch_size", True, "a number from 1"),
        ("batch_size", None, "a number from 1"),
        ("num_epochs", [10], "a number from 1 to 1000"),
        ("lr", 0, "a number from 1e-10 to 1"),
        ("lr", -1e-3, "a number from 1e-10 to 1"),
        ("lr", float("nan"), "a number from 1e-10 to 1"),
        ("lr", float("inf"), "a number from 1e-10 to 1"),
        ("beta_entropy", 1.5, "a number from 0 to 1"),
        ("discount_factor", 99, "a number from 0 to 1"),
        ("loss_type", "hubber", "did you mean huber?"),
        ("loss_type", 1, "huber, mean squared error"),
        ("exploration_type", "greedy", "categorical, e-greedy"),
        ("num_episodes_between_training", -20, "a number from 1"),
        ("e_greedy_value", "much", "a number from 0 to 1"),
        ("term_cond_max_episodes", 0, "a number from 1"),
        ("term_cond_avg_score", {}, "a number from"),
        ("sac_alpha", 2, "a number from 0 to 1"),
        ("stack_size", "x", "a number from 1"),
        ("epsilon_steps", 0.5, "a number from 1"),
    ],
)
def test_a_value_that_cannot_be_used_is_named_with_what_would_do(tmp_path, key, value, accepted):
    message = refusal(write(tmp_path, DRFC | {key: value}))
    assert f": {key}: " in message
    assert accepted in message


@pytest.mark.parametrize(
    "text", ["", "{", '{"lr": 1e-3', "[]", "3", '"lr"', "null", "{'lr': 1}", "[" * 10**5]
)
def test_what_is_no_json_object_is_refused(tmp_path, text):
    refusal(write(tmp_path, text))


def test_what_is_no_text_is_refused(tmp_path):
    path = tmp_path / "hyperparameters.json"
    path.write_bytes(b"\xff\xfe{}")
    assert "UTF-8" in refusal(path)


def test_a_huge_file_is_refused_without_being_read_whole(tmp_path):
    path = tmp_path / "hyperparameters.json"
    with path.open("wb") as file:
        file.truncate(10**12)  # sparse
    assert "larger than 1 MiB" in refusal(path)


def test_what_is_no_plain_file_is_refused(tmp_path):
    refusal(tmp_path / "missing.json")
    assert "is a folder" in refusal(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    assert "is a pipe" in refusal(tmp_path / "pipe")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_refused(tmp_path):
    path = write(tmp_path, DRFC)
    path.chmod(0)
    assert "Permission denied" in refusal(path)
