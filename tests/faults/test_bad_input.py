"""What the user gave cannot be used: one line, exit code 2, no folder."""

import pickle
import resource

import numpy as np
import psutil
import pytest


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["seed=now"], ['seed="now"', "integer"]),
        (["reward.constants.SPEED=2"], ["reward.constants.SPEED", "no such constant"]),
        (["algorithm.batch_size=2048"], ["algorithm.batch_size=2048", "algorithm.frames_per_iteration=1024"]),
        (["=1"], ["=1"]),
        (["seed=[1"], ["seed=[1"]),
    ],
)
def test_values_that_cannot_be_used_are_refused_in_one_line(train_here, overrides, words):
    """What is no value of a key is tested where experiments are composed."""
    train_here(*overrides).assert_bad_input(*words)


def test_cars_that_do_not_fit_into_memory_are_refused_in_one_line(train_here):
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + 2**30, hard))
    try:
        refused = train_here("collector.cars=100", "algorithm.frames_per_iteration=10000000")
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    assert refused.code == 2, refused.stderr
    words = "collector.cars=100, algorithm.frames_per_iteration=10000000: needs more memory than there is"
    assert words in refused.complaint
    assert "Traceback" not in refused.stderr
    assert refused.summary["status"] == "failed"


REWARD = "def reward_function(params):\n    return 1.0\n"


@pytest.mark.parametrize(
    ("key", "name", "content", "word"),
    [
        ("track.file", "route.npy", pickle.dumps(np.zeros((10, 6))), "not a NumPy array file"),
        ("track.file", "route.yaml", b"knots: [[0, 0]]", "knots"),
        ("action_space.file", "model_metadata.json", b'{"action_space": []}', "action_space"),
        ("reward.file", "my_reward.py", None, "my_reward.py"),
        ("reward.file", "my_reward.py", b"def reward_function(params)\n    return 1.0\n", "line 1"),
        ("reward.file", "my_reward.py", f"import sys\nsys.exit(0)\n{REWARD}".encode(), "SystemExit"),
        ("reward.file", "my_reward.py", f"while True:\n    pass\n{REWARD}".encode(), "time limit of 1 s"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_that_cannot_be_used_is_refused_with_its_name(train_here, tmp_path, key, name, content, word):
    """What its reader refuses is tested with each reader."""
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    train_here(f"{key}={path}", "reward.time_limit_s=1").assert_bad_input(str(path), word)


def test_a_folder_in_the_place_of_a_file_is_refused(train_here, tmp_path):
    for key in ("track.file", "action_space.file", "reward.file"):
        train_here(f"{key}={tmp_path}").assert_bad_input(str(tmp_path))


def test_runs_dir_that_is_a_file_is_refused(train_here, tmp_path):
    (tmp_path / "taken").write_text("")
    for more in ((), ("tracking=mlflow",)):
        train_here("runs_dir=taken", *more).assert_bad_input("runs_dir=taken")
    train_here("runs_dir=taken/deeper").assert_bad_input("runs_dir=taken/deeper")
    assert (tmp_path / "taken").read_text() == ""


def test_a_grid_with_one_bad_file_runs_nothing(call, tmp_path):
    good = tmp_path / "good.py"
    good.write_text("def reward_function(params):\n    return 1.0\n")
    ended = call(
        "train",
        "-m",
        "experiment=tiny",
        "tracking=off",
        "collector=in_process",
        f"reward.file={good},missing.py",
    )
    ended.assert_bad_input("missing.py")


def test_a_grid_with_one_bad_value_runs_nothing(call):
    ended = call("train", "-m", "experiment=tiny", "tracking=off", "collector=in_process", "seed=1,two")
    ended.assert_bad_input('seed="two"')


def test_bad_input_shows_its_traceback_with_debug(train_here):
    ended = train_here("reward.file=missing.py", "debug=true")
    assert ended.code == 2
    assert "Traceback" in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("deepracer-exp: ")


def test_an_unknown_option_is_refused_by_the_command_itself(start, tmp_path):
    """The same in a process of its own: nothing else may write to stderr there."""
    ended = start("train", "track=reinvent_bse").end()
    ended.assert_bad_input("did you mean reinvent_base?")
    assert ended.stderr.count("\n") == 1
