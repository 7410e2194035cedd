import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.config.driving import RewardConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.rewards.source import (
    NO_REWARD,
    RewardSource,
    is_of_zoo,
    keeps_state,
    load_reward_source,
    source_with_constants,
    zoo_names,
)
from tests.conftest import refused

PLAIN = "def reward_function(params):\n    return 1.0\n"


def config(name: str = "progress_delta", file: str | None = None, **constants: float) -> RewardConfig:
    return RewardConfig(name=name, file=file, constants=constants, time_limit_s=5.0)


def from_text(folder: Path, text: str | bytes, **constants: float) -> RewardSource:
    file = folder / "mein Lohn ü.py"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_reward_source(config(file=str(file), **constants))


def refusal(folder: Path, text: str | bytes, **constants: float) -> str:
    return refused(from_text, folder, text, **constants)


@pytest.mark.parametrize("name", zoo_names())
def test_every_zoo_function_is_found_by_its_name(name: str) -> None:
    source = load_reward_source(config(name))
    assert source.name == name
    assert source.sha256 == hashlib.sha256(Path(source.path).read_bytes()).hexdigest()
    assert source_with_constants(source) == source.text


def test_an_unknown_name_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(BadInput, match=r"did you mean progress_delta\?.*racing_line"):
        load_reward_source(config("progres_delta"))


@pytest.mark.parametrize(
    "name", ["", "__init__", "../reward_zoo/progress_delta", "os.path", "progress_delta.py"]
)
def test_only_names_of_the_zoo_reach_a_file(name: str) -> None:
    with pytest.raises(BadInput, match="not in the reward zoo"):
        load_reward_source(config(name))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"# \xff\n", "not UTF-8 text (byte 2 is 0xff)"),
        ("x = 1\ndef reward_function(params:\n", "line 2: "),
        ("x = 1\nreturn 2\n", "line 2: 'return' outside function"),
        ("x = 1\ny = 2\0\n", "line 2: a null byte; this is not valid Python"),
        ("", "has no function reward_function(params)"),
        ("def rewardfunction(params): return 1\n", "(did you mean rewardfunction?)"),
        ("def reward_function(): return 1\n", "line 1: reward_function() must take one argument"),
        ("def reward_function(a, b): return 1\n", "reward_function(a, b) must take one argument"),
        ("def reward_function(a, *, b): return 1\n", "must take one argument"),
        ("async def reward_function(p): return 1\n", "not an async one"),
        (PLAIN + "def reward_batch(): return 1\n", "line 3: reward_batch() must take one argument"),
    ],
)
def test_what_cannot_be_a_reward_module_is_refused_in_one_line(
    tmp_path: Path, text: str | bytes, message: str
) -> None:
    assert message in refusal(tmp_path, text)


def test_a_file_replaces_the_name_and_is_not_run_by_being_read(tmp_path: Path) -> None:
    source = from_text(tmp_path, "raise SystemExit(1)\n" + PLAIN)
    assert (source.name, source.text) == ("mein Lohn ü", "raise SystemExit(1)\n" + PLAIN)
    for head in ("def reward_function(*args):", "def reward_function(params, k=1):"):
        from_text(tmp_path, f"{head}\n    return 1.0\n")


def test_constants_are_the_numbers_in_capitals_at_the_top_level(tmp_path: Path) -> None:
    text = (
        "A = 1\nB_2: float = -2.5\nlower = 3\n_HIDDEN = 4\nFLAG = True\nTEXT = 'x'\nSUM = 1 + 1\n"
        "C, D = 1, 2\nE = F = 3\n" + PLAIN + "    G = 5\n"
    )
    assert from_text(tmp_path, text).constants == {"A": 1, "B_2": -2.5}


def test_an_unknown_constant_is_refused_with_the_nearest_and_all(tmp_path: Path) -> None:
    message = refusal(tmp_path, "SPEED_WEIGHT = 1\nFLOOR = 2\n" + PLAIN, speed_weigth=1.0)
    assert "reward.constants.speed_weigth" in message
    assert "(did you mean SPEED_WEIGHT?): SPEED_WEIGHT, FLOOR" in message
    assert "none; a constant is" in refusal(tmp_path, PLAIN, X=1.0)


def test_constants_are_set_in_place_and_all_else_stays_as_it_was(tmp_path: Path) -> None:
    text = '"""Ünïcode."""\n"ü"; A = 1  # ü\nB: float = (-2.5)\nC = 3\n' + PLAIN
    source = from_text(tmp_path, text, A=7.0, B=1e-9)
    expected = text.replace("A = 1 ", "A = 7 ").replace("(-2.5)", "(1e-09)")
    assert source_with_constants(source) == expected
    assert source.text == text


def test_a_whole_constant_stays_whole_unless_the_value_is_not(tmp_path: Path) -> None:
    text = "A = 1\nB = 1.0\n" + PLAIN
    assert from_text(tmp_path, text, A=3.0, B=3).overrides == {"A": 3, "B": 3.0}
    assert "A = 3\nB = 3.0\n" in source_with_constants(from_text(tmp_path, text, A=3.0, B=3))
    assert "A = 0.5\n" in source_with_constants(from_text(tmp_path, text, A=0.5))


def test_windows_line_ends_and_byte_order_mark_do_no_harm(tmp_path: Path) -> None:
    source = from_text(tmp_path, b"\xef\xbb\xbfA = 1\r\nB = 2\r\n" + PLAIN.encode(), B=5.0)
    assert source_with_constants(source) == "A = 1\nB = 5\n" + PLAIN


@given(
    st.dictionaries(
        st.sampled_from("ABCD"), st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=4
    )
)
def test_the_text_with_constants_has_exactly_those_constants(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, float]
) -> None:
    folder = tmp_path_factory.mktemp("reward")
    text = "A = 1; B = 2.0\nC: int = +3\nD = - 4.0\n" + PLAIN
    written = source_with_constants(from_text(folder, text, **values))
    again = from_text(folder, written)
    assert again.constants == {"A": 1, "B": 2.0, "C": 3, "D": -4.0} | values


def test_a_function_of_the_zoo_is_known_by_its_text_whatever_its_constants() -> None:
    source = load_reward_source(config())
    name = next(iter(source.constants))
    other = load_reward_source(config(**{name: 7.5}))
    assert is_of_zoo(source.text)
    assert is_of_zoo(source_with_constants(other))
    assert not is_of_zoo(source.text + "\nprint('hello')\n")
    assert not is_of_zoo(PLAIN)
    assert not is_of_zoo("no Python at all")


@pytest.mark.parametrize(
    ("module", "answer"),
    [
        ("def reward_function(params):\n    last = params['x']\n    return last\n", False),
        (
            "last = 0.0\ndef reward_function(params):\n    global last\n    last = 1.0\n    return last\n",
            True,
        ),
        ("_last = {}\ndef reward_function(params):\n    _last['x'] = 1.0\n    return 1.0\n", True),
        (
            "class Before:\n    x = None\n"
            "def reward_function(params):\n    Before.x = params['x']\n    return 1.0\n",
            True,
        ),
        ("LIMIT = 2.0\ndef reward_function(params):\n    params['x'] = LIMIT\n    return 1.0\n", False),
        (
            "_last = {}\ndef gained(params):\n    _last['x'] = 1.0\n"
            "def reward_function(params):\n    return gained(params)\n",
            True,
        ),
        ("history = []\ndef reward_function(params):\n    history.append(1)\n    return 1.0\n", True),
        ("_last = {'a': {}}\ndef reward_function(params):\n    _last['a']['b'] = 1\n    return 1.0\n", True),
        ("import numpy as np\ndef reward_function(params):\n    return float(np.append(1, 2)[0])\n", False),
        (
            "class Reward:\n    def __init__(self):\n        self.last = 0\n"
            "    def reward_function(self, params):\n        self.last = params['x']\n        return 1.0\n"
            "made = Reward()\ndef reward_function(params):\n    return made.reward_function(params)\n",
            True,
        ),
        (
            "class Reward:\n    def pay(self, params):\n        self.last = params['x']\n        return 1.0\n"
            "def reward_function(params):\n    return Reward().pay(params)\n",
            False,
        ),
        # A training calls the batch alone.
        (
            "_last = {}\ndef reward_function(params):\n    _last['x'] = 1.0\n    return 1.0\n"
            "def reward_batch(params):\n    return params['previous_progress']\n",
            False,
        ),
    ],
)
def test_a_function_that_remembers_earlier_calls_is_known(module: str, answer: bool) -> None:
    assert keeps_state(replace(NO_REWARD, text=module)) is answer
