"""Messages are rendered from data, repeat a long value in short, and never shorten what would be accepted."""

import ast
import copy
from pathlib import Path

import pytest

import deepracer_exp
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput, RunFailed, Unknown, reading
from deepracer_exp.files import read_json, read_yaml
from deepracer_exp.rewards.source import load_reward_source
from tests.conftest import refused

LONG = "x" * 5000


@pytest.mark.parametrize("value", [LONG, f"'x x{LONG}'"])
@pytest.mark.parametrize("key", ["track", "car", "name", "reward.name", "nothing"])
def test_a_long_value_is_not_repeated(key, value):
    message = refused(lambda: load_reward_source(compose_experiment([f"{key}={value}"])[0].reward))
    assert key in message
    assert "x" * 200 not in message


@pytest.mark.parametrize("value", [LONG, "a 'b' " * 1000, "word " * 1000])
def test_a_long_quoted_value_is_shortened_whatever_it_holds(value):
    message = str(BadInput(f"key={value!r}: is not known; accepted: one, two"))
    assert len(message) < 4100
    assert message.endswith("accepted: one, two")


def test_what_would_be_accepted_is_never_shortened():
    options = ", ".join(f"track's_{number}" for number in range(200))
    for message in (f"track='x': no such track; accepted: {options}", f"it's 'x': {options}"):
        assert str(BadInput(message)) == message


@pytest.mark.parametrize("key", ["lookahead_scale_m", "speed_scale_mps", "yaw_rate_scale_radps"])
@pytest.mark.parametrize("value", ["1e-320", "1e-7", "1e300", "nan"])
def test_a_scale_that_would_make_features_infinite_is_refused(key, value):
    assert f"observation.{key}" in refused(compose_experiment, [f"observation.{key}={value}"])


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        (("a.yaml", "is a folder", "a file"), "a.yaml: is a folder; accepted: a file"),
        (("a.yaml", "is a folder"), "a.yaml: is a folder"),
        (("--port 0", "", "1 to 65535"), "--port 0: accepted: 1 to 65535"),
        (("the two contradict each other",), "the two contradict each other"),
    ],
)
def test_a_line_is_rendered_from_its_parts_and_keeps_them_in_a_copy(parts, line):
    error = BadInput(*parts)
    assert str(error) == line
    assert vars(copy.copy(error)) == vars(error)
    assert error.without(parts[0]) == (line.removeprefix(f"{parts[0]}: ") if len(parts) > 1 else line)
    assert error.without("b.yaml") == line


@pytest.mark.parametrize("read", [read_json, read_yaml, lambda file, accepted: (file / "x").read_text()])
@pytest.mark.parametrize("content", ["{", None])
def test_an_error_of_a_file_names_it_as_what_cannot_be_used(tmp_path, read, content):
    file = tmp_path / "settings"
    if content is not None:
        file.write_text(content)
    with pytest.raises(BadInput) as raised, reading(file, "settings"):
        read(file, "settings")
    assert (raised.value.what, raised.value.accepted) == (str(file), "settings")


@pytest.mark.parametrize("override", ["network=mlpp", "algorithm.lrr=1", "network.kind=x", "track=[A]"])
def test_a_name_that_does_not_exist_is_an_error_of_its_own(override):
    with pytest.raises(Unknown):
        compose_experiment(["observation=lidar", override])


def test_no_code_decides_by_the_text_of_an_error():
    package = Path(deepracer_exp.__file__).parent
    found = {
        str(file.relative_to(package))
        for file in package.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ExceptHandler) and node.name and any(map(_reads(node.name), ast.walk(node)))
    }
    # torch and MLflow say only in their text that memory or disk ran out.
    assert found <= {"tracking/download.py"}


def _reads(name):
    """Return a function that says whether a node compares the text of this error, or takes a part of it away."""

    def is_text(node):
        return isinstance(node, ast.Call) and ast.unparse(node) == f"str({name})"

    def reads(node):
        if isinstance(node, ast.Compare):
            return any(map(is_text, (node.left, *node.comparators)))
        ways = ("removeprefix", "removesuffix", "startswith", "endswith")
        return isinstance(node, ast.Attribute) and node.attr in ways and is_text(node.value)

    return reads


@pytest.mark.parametrize("kind", [BadInput, RunFailed])
@pytest.mark.parametrize("piece", ["x", "x y ", "\x1b", "\n", "'x ", "\"'"])
def test_a_value_of_megabytes_leaves_its_line_short_and_its_reason_readable(kind, piece):
    line = str(kind(f"key={piece * 1_000_000}: is no number"))
    assert len(line) < 4100
    assert line.startswith("key=")
    assert line.endswith(": is no number")
    assert line.isprintable()
