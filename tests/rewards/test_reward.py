import hashlib
import os
import pickle
import signal
import subprocess
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.rewards.params import (
    BATCH_COLUMNS,
    COLUMNS,
    OBJECT_COLUMNS,
    TrackParams,
    batch_params,
    row_keys,
    rows,
    scalar_params,
    select,
)
from deepracer_exp.rewards.prints import RewardPrints
from deepracer_exp.rewards.reward import RewardFailed, RewardFunction
from deepracer_exp.rewards.source import RewardSource
from deepracer_exp.training.signals import Interruption

WAYPOINTS = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0)]
ROAD = [TrackParams(WAYPOINTS, 3.4, False)]
KEYS = {
    **dict.fromkeys(("x", "y", "heading", "distance_from_center", "projection_distance", "progress"), float),
    **dict.fromkeys(("steps", "speed", "steering_angle", "track_width", "track_length", "sim_time"), float),
    **dict.fromkeys(("all_wheels_on_track", "is_left_of_center", "is_reversed", "is_crashed"), bool),
    **dict.fromkeys(("is_offtrack", "object_in_camera"), bool),
    **dict.fromkeys(("waypoints", "closest_waypoints", "closest_objects", "objects_location"), list),
    **dict.fromkeys(("objects_left_of_center", "objects_speed", "objects_heading"), list),
    **dict.fromkeys(("objects_distance_from_center", "objects_distance"), list),
}


def columns(n: int, dtype: type = np.float64) -> dict[str, np.ndarray]:
    made = {key: np.arange(n).astype(dtype) for key in BATCH_COLUMNS}
    made["steps"] = np.full(n, 7)
    made["closest_waypoints"] = np.tile(np.array([0, 1], np.int32), (n, 1))
    return made


def function(
    body: str,
    n_cars: int = 3,
    time_limit_s: float = 5.0,
    prints: RewardPrints | None = None,
    **overrides: float,
) -> RewardFunction:
    """Build a reward function from the text of a module, or of a function's body if there is no `def`."""
    text = body if "def " in body else f"def reward_function(params):\n    {body}\n"
    digest = hashlib.sha256(text.encode()).hexdigest()
    source = RewardSource("mine", "/somewhere/mine.py", text, digest, dict(overrides), overrides)
    return RewardFunction(source, n_cars, time_limit_s, prints)


def least_s(text: str) -> float:
    """Return a time limit that only code which hangs passes, on however slow a machine."""
    return 0.05 if text.startswith("while True") else 5.0


def failure(reward: RewardFunction, active: np.ndarray | None = None) -> RewardFailed:
    with pytest.raises(RewardFailed) as caught:
        reward(columns(reward.n_cars), ROAD, active)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_the_params_are_the_27_keys_of_the_service_as_plain_python(dtype: type) -> None:
    row = next(iter(rows(select(columns(2, dtype), None))))
    params = scalar_params(row, ROAD[0])
    assert {key: type(value) for key, value in params.items()} == KEYS
    assert len(KEYS) == 27
    assert all(type(index) is int for index in params["closest_waypoints"])
    assert all(type(point) is tuple and type(point[0]) is float for point in params["waypoints"])
    assert set(COLUMNS) | set(TrackParams._fields) < set(KEYS)
    assert params["closest_objects"] == [0, 0]
    assert not params["is_crashed"]
    assert [v for k, v in params.items() if k.startswith("objects_")] == [[]] * 6


def test_batch_params_hold_the_same_keys_and_values_and_the_progress_before() -> None:
    selected = select(columns(3), None)
    batch = batch_params(selected, ROAD[0], np.array(WAYPOINTS))
    for car, row in enumerate(rows(selected)):
        for key, value in scalar_params(row, ROAD[0]).items():
            here = batch[key] if key in TrackParams._fields else batch[key][car]
            np.testing.assert_array_equal(here, np.reshape(value, here.shape) if value == [] else value)
    assert set(batch) == set(KEYS) | {"previous_progress", "objects_mask"}
    np.testing.assert_array_equal(batch["previous_progress"], np.arange(3))
    assert {value.shape[1] for key, value in batch.items() if key.startswith("objects_")} == {0}


def test_params_about_others_are_lists_for_one_car_and_arrays_for_many() -> None:
    n, count = 3, 4
    flags = ("is_crashed", "object_in_camera", "objects_left_of_center", "objects_mask")
    sizes = {"is_crashed": (n,), "object_in_camera": (n,), "closest_objects": (n, 2)}
    random, given = np.random.default_rng(0), {}
    for key in (*OBJECT_COLUMNS, "objects_mask"):
        shape = (n, count, 2) if key == "objects_location" else sizes.get(key, (n, count))
        given[key] = random.random(shape) < 0.5 if key in flags else random.random(shape)
    given["closest_objects"] = np.array([[0, 1], [2, 3], [3, 0]])
    selected = select({**columns(n), **given}, np.array([0, 2]))
    batch = batch_params(selected, ROAD[0], np.array(WAYPOINTS))
    for place, row in enumerate(rows(selected)):
        params = scalar_params(row, ROAD[0], row_keys(selected))
        assert {key: type(value) for key, value in params.items()} == KEYS
        assert type(params["closest_objects"][0]) is int
        for key in OBJECT_COLUMNS:
            np.testing.assert_array_equal(batch[key][place], params[key])
            np.testing.assert_array_equal(params[key], given[key][2 * place])
    assert batch["objects_mask"].shape == (2, count)


def test_cars_that_are_not_active_get_nothing_and_are_not_called() -> None:
    reward = function("return 1 / (params['x'] - 1)")
    np.testing.assert_array_equal(reward(columns(3), ROAD, np.array([True, False, True])), [-1.0, 0.0, 1.0])
    np.testing.assert_array_equal(reward(columns(3), ROAD, np.zeros(3, bool)), np.zeros(3))


@pytest.mark.parametrize(
    "value", ["True", "3", "2.5", "-1e5", "1e5", "np.float32(2)", "np.array(3)", "Fraction(1, 2)"]
)
def test_whatever_float_turns_into_a_bounded_number_is_a_reward(value: str) -> None:
    head = "import numpy as np\nfrom fractions import Fraction\n"
    result = function(f"{head}def reward_function(params):\n    return {value}\n")(columns(3), ROAD)
    assert result.dtype == np.float64
    assert result[0] == float(eval(value, {"np": np, "Fraction": Fraction}))  # noqa: S307


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return None", "returned None; accepted: a finite number from -100000 to 100000"),
        ("return '1.0'", "returned '1.0'; accepted: a finite"),
        ("return b'1'", "returned b'1'"),
        ("return float('nan')", "returned nan"),
        ("return -100000.1", "returned -100000.1"),
        ("return 10 ** 400", "returned 1000"),
        ("return [1.0]", "returned [1.0]"),
        ("return 1 / 0", "raised ZeroDivisionError: division by zero in line 2 of /somewhere/mine.py"),
        ("raise ValueError('two\\nlines')", "raised ValueError: two lines in line 2"),
        ("raise ValueError('x' * 1000000)", "raised ValueError: xxx"),
        ("import sys; sys.exit(0)", "raised SystemExit: 0 in line 2"),
        (
            "raise type('E', (Exception,), {'__str__': lambda _: 1 / 0})",
            "raised an error that cannot be printed in",
        ),
        ("return reward_function(params)", "raised RecursionError"),
    ],
)
def test_a_bad_reward_fails_the_run_in_one_line(body: str, message: str) -> None:
    error = failure(function(body), np.array([False, True, True]))
    assert isinstance(error, RunFailed)
    assert str(error).startswith(f"reward mine: reward_function {message}")
    assert str(error).endswith("(car 1, step 7)")
    assert len(str(error)) < 500


def test_the_failure_keeps_car_and_params_as_they_were_given() -> None:
    body = "params['waypoints'].clear(); speed = params.pop('speed'); return None if speed == 2 else 1.0"
    error = failure(function(body))
    assert error.car == 2
    assert error.params is not None
    assert error.params["speed"] == 2.0
    assert error.params["waypoints"] == WAYPOINTS
    again = pickle.loads(pickle.dumps(error))  # noqa: S301 - as between processes
    assert (str(again), again.params, again.car) == (str(error), error.params, 2)


def test_the_line_is_that_of_the_reward_file_even_if_a_library_raised() -> None:
    text = "import json\n\n\ndef reward_function(params):\n    return json.loads('{')\n"
    assert "in line 5 of /somewhere/mine.py" in str(failure(function(text)))


CTRL_C = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"


@pytest.mark.processes
def test_ctrl_c_is_the_users() -> None:
    with pytest.raises(KeyboardInterrupt):
        function(f"{CTRL_C}; return 1.0")(columns(3), ROAD)


def test_a_second_sigterm_while_the_reward_runs_is_not_its_fault() -> None:
    reward = function(f"{CTRL_C.replace('SIGINT', 'SIGTERM')}; return 1.0")
    with Interruption():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            reward(columns(3), ROAD)


@pytest.mark.processes
@pytest.mark.parametrize(
    "body",
    [
        "\n    while True:\n        pass",
        "\n    while True:\n        try: params['x']\n        except Exception: pass",
    ],
)
def test_a_reward_that_hangs_is_stopped_by_the_time_limit(body: str) -> None:
    error = failure(function(body, time_limit_s=0.05))
    limit = "the time limit of 0.05 s of CPU for one step"
    assert f"reward_function took longer than {limit} in line" in str(error)
    assert error.car == 0


@pytest.mark.processes
def test_a_reward_that_sleeps_for_ever_is_stopped_too() -> None:
    # A look itself takes 20 to 80 us of CPU here, and tenfold in a sandbox; what counts as waiting is 1 ms.
    error = failure(function("\n    import time\n    time.sleep(600)", time_limit_s=0.4))
    assert "reward_function took longer than 4 s without computing: 10 times the time limit" in str(error)


@pytest.mark.processes
def test_a_busy_machine_never_fails_a_good_reward() -> None:
    """Each call waits longer than its limit, as on a machine that has no time for it, but computes next to nothing."""
    reward = function("import time; time.sleep(0.2); return 1.0", time_limit_s=0.1)
    np.testing.assert_array_equal(reward(columns(3), ROAD), np.ones(3))


@pytest.mark.processes
def test_time_in_which_the_whole_process_was_stopped_does_not_count() -> None:
    # Again and again: on a busy machine the first signal may come before the stop.
    subprocess.Popen(["sh", "-c", f"for _ in $(seq 60); do sleep 1; kill -CONT {os.getpid()} || exit; done"])
    body = "import os, signal; os.kill(os.getpid(), signal.SIGSTOP); return 1.0"
    np.testing.assert_array_equal(function(body, n_cars=1, time_limit_s=0.05)(columns(1), ROAD), [1.0])


def test_timer_and_handler_found_are_put_back() -> None:
    def mine(*_: object) -> None:
        raise AssertionError("must not fire")

    handler = signal.signal(signal.SIGALRM, mine)
    began_s = time.monotonic()
    timer = signal.setitimer(signal.ITIMER_REAL, 1000.0)
    try:
        function("return 1.0")(columns(3), ROAD)
        failure(function("raise ValueError"))
        assert signal.getsignal(signal.SIGALRM) is mine
        left_s, _ = signal.getitimer(signal.ITIMER_REAL)
        most_s = 1000.0 - (time.monotonic() - began_s)
        assert most_s - 0.1 <= left_s <= 1000.0
    finally:
        signal.signal(signal.SIGALRM, handler)
        signal.setitimer(signal.ITIMER_REAL, *timer)


def test_what_a_reward_does_to_its_params_reaches_neither_the_next_call_nor_the_caller() -> None:
    body = (
        "seen = (len(params), len(params['waypoints']), *params['closest_waypoints'],"
        " *params['closest_objects'], len(params['objects_speed']))\n"
        "    params['waypoints'].append((9.0, 9.0)); params['closest_waypoints'][0] = 99\n"
        "    params['closest_objects'][1] = 5; params['objects_speed'].append(1.0); params.clear()\n"
        "    return seen == (27, 4, 0, 1, 0, 0, 0)"
    )
    given, road = columns(3), [TrackParams(list(WAYPOINTS), 3.4, False)]
    reward = function(body)
    for _ in range(2):
        np.testing.assert_array_equal(reward(given, road), np.ones(3))
    assert road[0].waypoints == WAYPOINTS
    np.testing.assert_array_equal(given["closest_waypoints"], columns(3)["closest_waypoints"])


def test_module_globals_persist_for_a_car_and_never_pass_to_another() -> None:
    text = "calls = []\ndef reward_function(params):\n    calls.append(1)\n    return len(calls)\n"
    reward = function(text)
    reward(columns(3), ROAD)
    reward(columns(3), ROAD, np.array([False, True, False]))
    np.testing.assert_array_equal(reward(columns(3), ROAD), [2.0, 3.0, 2.0])


def test_constants_are_those_of_the_config() -> None:
    text = "WEIGHT = 1.0\nTWICE = WEIGHT * 2\ndef reward_function(params):\n    return TWICE\n"
    np.testing.assert_array_equal(function(text)(columns(3), ROAD), [2.0] * 3)
    np.testing.assert_array_equal(function(text, WEIGHT=4.5)(columns(3), ROAD), [9.0] * 3)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "import nonsense_of_mine",
            "raised ModuleNotFoundError: No module named 'nonsense_of_mine' in line 1",
        ),
        ("import sys; sys.exit(3)", "raised SystemExit: 3 in line 1"),
        ("while True: pass", "took longer than the time limit"),
    ],
)
def test_a_module_that_cannot_be_run_is_bad_input(text: str, message: str) -> None:
    with pytest.raises(BadInput) as caught:
        function(f"{text}\ndef reward_function(params): return 1.0\n", time_limit_s=least_s(text))
    assert str(caught.value).startswith(f"/somewhere/mine.py: cannot be run: {message}")


def test_a_callable_object_is_accepted_and_a_number_is_bad_input() -> None:
    text = "class R:\n    def __call__(self, params):\n        return 2.0\nreward_function = R()\n"
    np.testing.assert_array_equal(function(text)(columns(3), ROAD), [2.0] * 3)
    with pytest.raises(BadInput, match="reward_function is 5; accepted: a function"):
        function("def other(): pass\nreward_function = 5\n")


def test_prints_go_to_the_log_and_nowhere_else(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    prints = RewardPrints(tmp_path / "reward_prints.log")
    text = "print('made')\ndef reward_function(params):\n    print('x is', params['x'])\n    return 1.0\n"
    function(text, prints=prints)(columns(3), ROAD)
    function(text)(columns(3), ROAD)
    log = prints.path.read_text().splitlines()
    assert log == [f"car {i}: made" for i in range(3)] + [f"car {i}: x is {i}.0" for i in range(3)]
    assert capfd.readouterr() == ("", "")


def batch(body: str, **options: Any) -> RewardFunction:
    text = "import numpy as np\ndef reward_function(params):\n    return 1.0\ndef reward_batch(params):\n    "
    return function(text + body + "\n", **options)


def test_a_batch_function_is_called_once_for_all_active_cars() -> None:
    reward = batch("global calls; calls = globals().get('calls', 0) + 1; return params['x'] + 10 * calls")
    np.testing.assert_array_equal(reward(columns(3), ROAD), [10.0, 11.0, 12.0])
    np.testing.assert_array_equal(reward(columns(3), ROAD, np.array([True, False, True])), [20.0, 0.0, 22.0])


@pytest.mark.processes
@pytest.mark.parametrize(
    ("body", "car", "message"),
    [
        (
            "return None",
            None,
            "returned object of shape (); accepted: one number per car, shape (3,) (3 cars)",
        ),
        ("return params['x'][:2]", None, "returned float64 of shape (2,)"),
        ("return params['x'] * 1j", None, "returned complex128 of shape (3,)"),
        ("return [[1], [2, 3], 4]", None, "returned [[1], [2, 3], 4]"),
        ("return 1 / 0", None, "raised ZeroDivisionError: division by zero in line 5"),
        ("while True: pass", None, "took longer than the time limit of 0.05 s"),
        ("return np.array([1.0, 2.0, np.nan])", 2, "returned nan; accepted: a finite number"),
        ("return np.array([1.0, 1e6, np.nan])", 1, "returned 1000000.0; accepted: a finite number"),
    ],
)
def test_a_bad_batch_fails_the_run_in_one_line(body: str, car: int | None, message: str) -> None:
    error = failure(batch(body, time_limit_s=least_s(body)))
    assert str(error).startswith(f"reward mine: reward_batch {message}")
    assert error.car == car
    assert error.params is not None
    assert set(error.params) == set(KEYS) | ({"previous_progress", "objects_mask"} if car is None else set())
    if car is not None:
        assert error.params["x"] == float(car)
        assert str(error).endswith(f"(car {car}, step 7)")


def test_a_car_has_its_number_over_all_processes_in_errors_and_prints(tmp_path: Path) -> None:
    text = "def reward_function(params):\n    print(params['x'])\n    return 1 / (params['x'] - 1)\n"
    source = RewardSource("mine", "/somewhere/mine.py", text, "0" * 64, {}, {})
    prints = RewardPrints(tmp_path / "prints.log")
    error = failure(RewardFunction(source, 3, 5.0, prints, first_car=128))
    assert str(error).endswith("(car 129, step 7)")
    assert error.car == 1
    assert (tmp_path / "prints.log").read_text().splitlines() == ["car 128: 0.0", "car 129: 1.0"]


def test_a_batch_function_that_mutates_its_params_changes_nothing_outside() -> None:
    reward = batch(
        "total = params['x'] + params['waypoints'].sum();"
        " params['x'][:] = 9; params['waypoints'][:] = 9; return total"
    )
    given = columns(3)
    np.testing.assert_array_equal(reward(given, ROAD), reward(given, ROAD))
    np.testing.assert_array_equal(given["x"], [0.0, 1.0, 2.0])


@pytest.mark.parametrize("make", [function, batch])
def test_columns_that_are_missing_are_a_fault_of_the_caller(make: Callable[..., RewardFunction]) -> None:
    given = columns(3)
    del given["x"]
    with pytest.raises(KeyError, match="x"):
        make("return 1.0")(given, ROAD)
