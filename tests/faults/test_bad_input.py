"""What the user gave cannot be used: one line, exit code 2, no folder."""

import json
import pickle
import resource
from importlib import import_module
from pathlib import Path

import numpy as np
import psutil
import pytest

SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["track=reinvent_bse"], ["track=reinvent_bse", "did you mean reinvent_base?"]),
        (["network=mpl"], ["network=mpl", "did you mean mlp?"]),
        (["algorithm.learning_rate=1"], ["algorithm.learning_rate: no such key"]),
        (["collector.proceses=2"], ["collector.proceses: no such key", "did you mean", "processes?"]),
        (["tarck=reinvent_base"], ["tarck", "did you mean track?"]),
        (["seed=now"], ['seed="now"', "integer"]),
        (["algorithm.lr=fast"], ['algorithm.lr="fast"', "number"]),
        (["algorithm.lr=-1"], ["algorithm.lr=-1", "greater than 0"]),
        (["reward.constants.SPEED=2"], ["reward.constants.SPEED", "no such constant"]),
        (["algorithm.batch_size=2048"], ["algorithm.batch_size=2048", "algorithm.frames_per_iteration=1024"]),
        (["collector.cars=2000"], ["algorithm.frames_per_iteration=1024", "collector.cars=2000"]),
        (["algorithm.episodes_per_iteration=5"], ["frames_per_iteration=1024", "episodes_per_iteration=5"]),
        (["collector.processes=3"], ["collector.processes=3", "collector.mode=in_process"]),
        (["budget.env_steps=null"], ["env_steps", "iterations", "minutes"]),
        (["=1"], ["=1"]),
        (["seed=[1"], ["seed=[1"]),
    ],
)
def test_values_that_cannot_be_used_are_refused_in_one_line(train_here, overrides, words):
    train_here(*overrides).assert_bad_input(*words)


def test_cars_that_do_not_fit_into_memory_are_refused_in_one_line(train_here):
    import_module("deepracer_exp.training.run")  # its libraries need memory, too
    # A column of the batch is larger than what is left, so that little is filled before the refusal.
    overrides = "collector.cars=100", "algorithm.frames_per_iteration=10000000"
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + 2**28, hard))
    try:
        refused = train_here(*overrides)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    refused.assert_refused(f"{', '.join(overrides)}: needs more memory than there is")
    assert refused.summary["status"] == "failed"


def _route(folder: Path, name: str, kind: str) -> str:
    path = folder / name
    match kind:
        case "shape":
            np.save(path, np.zeros((10, 5)))
        case "nan":
            np.save(path, np.full((10, 6), np.nan))
        case "text array":
            np.save(path, np.array([["left"] * 6] * 10))
        case "pickled":
            np.save(path, np.array([{"no": "numbers"}], dtype=object), allow_pickle=True)
        case "plain pickle":
            path.write_bytes(pickle.dumps(np.zeros((10, 6))))
        case "text":
            path.write_text("once round the block\n")
        case "empty":
            path.write_bytes(b"")
        case "incomplete":
            np.save(path, np.zeros((10, 6)))
            path.write_bytes(path.read_bytes()[:200])
    return str(path)


@pytest.mark.parametrize(
    "kind",
    ["missing", "shape", "nan", "text array", "pickled", "plain pickle", "text", "empty", "incomplete"],
)
def test_a_route_that_is_none_is_refused_with_its_name(train_here, tmp_path, kind):
    path = _route(tmp_path, "route.npy", kind)
    train_here(f"track.file={path}").assert_bad_input("route.npy")


@pytest.mark.parametrize("text", [None, "", "knots", "knots: [[0, 0]", "knots: [[0, 0]]", "- 1"])
def test_a_route_of_knots_that_is_none_is_refused_with_its_name(train_here, tmp_path, text):
    path = tmp_path / "route.yaml"
    if text is not None:
        path.write_text(text)
    train_here(f"track.file={path}").assert_bad_input("route.yaml")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (None, ""),
        ("", ""),
        ("{", ""),
        ("[]", ""),
        ("{}", "action_space"),
        ('{"action_space": []}', "action_space"),
        ('{"action_space": [{"steering_angle": "left", "speed": 1}]}', "steering_angle"),
        ('{"action_space": [{"steering_angle": 10}]}', "speed"),
        ('{"action_space": [{"steering_angle": NaN, "speed": 1}]}', "steering_angle"),
        (json.dumps({"action_space": [{"steering_angle": 0, "speed": -1}]}), "speed"),
    ],
)
def test_a_model_metadata_that_is_none_is_refused_with_its_name(train_here, tmp_path, text, word):
    path = tmp_path / "model_metadata.json"
    if text is not None:
        path.write_text(text)
    train_here(f"action_space.file={path}").assert_bad_input("model_metadata.json", word)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, []),
        ("", ["reward_function"]),
        ("def reward_function(params)\n    return 1.0\n", ["line 1"]),
        ("def rewardfunction(params):\n    return 1.0\n", ["did you mean", "reward_function"]),
        ("def reward_function():\n    return 1.0\n", ["line 1", "one argument"]),
        (
            "import no_such_module\ndef reward_function(params):\n    return 1.0\n",
            ["no_such_module", "line 1"],
        ),
        ("import sys\nsys.exit(0)\ndef reward_function(params):\n    return 1.0\n", ["SystemExit", "line 2"]),
        ("1 / 0\ndef reward_function(params):\n    return 1.0\n", ["ZeroDivisionError", "line 1"]),
        ("while True:\n    pass\ndef reward_function(params):\n    return 1.0\n", ["time limit of 0.2 s"]),
        ("reward_function = 3\n", ["reward_function is 3"]),
    ],
)
def test_a_reward_file_that_is_none_is_refused_with_its_name(train_here, tmp_path, text, words):
    path = tmp_path / "my_reward.py"
    if text is not None:
        path.write_text(text)
    train_here(f"reward.file={path}", "reward.time_limit_s=0.2").assert_bad_input("my_reward.py", *words)


def test_a_folder_in_the_place_of_a_file_is_refused(train_here, tmp_path):
    for key in ("track.file", "action_space.file", "reward.file"):
        train_here(f"{key}={tmp_path}").assert_bad_input(str(tmp_path))


@pytest.mark.parametrize("runs_dir", ["taken", "taken/deeper"])
@pytest.mark.parametrize("tracking", ["off", "mlflow"])
def test_runs_dir_that_is_a_file_is_refused(train_here, tmp_path, runs_dir, tracking):
    (tmp_path / "taken").write_text("")
    train_here(f"runs_dir={runs_dir}", f"tracking={tracking}").assert_bad_input(f"runs_dir={runs_dir}")
    assert (tmp_path / "taken").read_text() == ""


@pytest.mark.parametrize(
    ("grid", "word"),
    [("reward.file=good.py,missing.py", "missing.py"), ("seed=1,two", 'seed="two"')],
    ids=["file", "value"],
)
def test_a_grid_with_one_that_cannot_be_used_runs_nothing(train_here, tmp_path, grid, word):
    (tmp_path / "good.py").write_text("def reward_function(params):\n    return 1.0\n")
    train_here("-m", grid).assert_bad_input(word)


def test_bad_input_shows_its_traceback_with_debug(train_here):
    ended = train_here("reward.file=missing.py", "debug=true")
    assert ended.code == 2
    assert "Traceback" in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("deepracer-exp: ")


def test_an_unknown_option_is_refused_by_the_command_itself(start):
    """The same in a process of its own: nothing else may write to stderr there."""
    ended = start("train", "track=reinvent_bse").end()
    ended.assert_bad_input("did you mean reinvent_base?")
    assert ended.stderr.count("\n") == 1
