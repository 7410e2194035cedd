"""Whatever a key is given and whatever a file holds: an experiment, or one line that says what is wrong."""

import copy
import json
import math
import random
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest

from deepracer_exp.config.compose import compose_experiment, compose_option, expand_grid
from deepracer_exp.config.options import groups
from deepracer_exp.config.overrides import key_of
from deepracer_exp.config.parse import parse_experiment
from deepracer_exp.config.stopping import NoStopping
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.errors import BadInput
from tests.conftest import refused
from tests.hostile_files import KINDS, TEXTS, make

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 10**18, 10**400, -(10**400)),
    *(0.5, -0.0, 1e-300, 1e300, math.nan, math.inf, -math.inf),
    *("", " ", "none", "../x", "/etc/passwd", "a" * 5000, "\0", "\x1b[2J"),
    *("Ü\u202e\U0001f3ce", "${seed}", "1e3"),
    *([], [None], [1, 2], [[]], [[[[[[1]]]]]], ["a"] * 2000, {}, {"a": 1}, {"kind": "none"}, {"": {"": {}}}),
)
LINES = (
    *("null", "[1,2]", "{a:1}", "", "nan", "inf", "-1", "9" * 5000, "1e999", "???"),
    *("${seed}", "${oc.env:NO_SUCH}", "${nothing.here}"),
    *("'a b'", "[", "[[", "]", "{a:{b:{c:1}}}", "a,b", "range(0,5,0)", "range(1,9)", "glob(*)"),
    *("2026-01-01", "!!int abc", "&a [*a]", "../x", "\0", "\x1b[2J", "Ü\u202e", "a\nb"),
    *("=", "==", "~", "None", "choice(", "interval(1,0)", "tag(x,1)", "sort(3,2)"),
    *("shuffle(range(0,1000000000))", "int(abc)", "true"),
    *("[" * 900, "[" * 900 + "]" * 900, "{a:" * 300),
)


def _keys(values: Any, prefix: str = "") -> Iterator[str]:
    """Yield every dotted key, of groups as well."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield f"{prefix}{key}"
            yield from _keys(value, f"{prefix}{key}.")


@cache
def _places() -> list[tuple[dict[str, Any], str]]:
    """Return every key of the default experiment, and those of the options that have keys of their own, with both."""
    default = compose_experiment([])[1].mapping
    places = [(default, key) for key in _keys(default)]
    for group, name in (("stopping", "plateau"), ("stopping", "reliable"), ("lr_schedule", "adaptive_kl")):
        mapping = compose_experiment([f"{group}={name}"])[1].mapping
        places += [(mapping, f"{group}.{key}") for key in _keys(mapping[group])]
    return places


def _refusal(call: Any, *arguments: Any) -> str | None:
    """Return the complaint, None where it is accepted; any other exception is a failure."""
    try:
        call(*arguments)
    except BadInput as error:
        return str(error)
    return None


def _assert_one_line(complaint: str | None, *named: str) -> None:
    if complaint is None:
        return
    assert complaint.isprintable()
    assert any(name in complaint for name in named), complaint


def _try_values(seed: int, each: int) -> int:
    """Give every key of every option some of the values; return how many were tried."""
    draw = random.Random(seed)
    for mapping, key in _places():
        *path, leaf = key.split(".")
        for value in draw.sample(VALUES, each):
            changed = copy.deepcopy(mapping)
            node = changed
            for part in path:
                node = node[part]
            node[leaf] = value
            # Of values that contradict each other the message may name the other one.
            _assert_one_line(_refusal(parse_experiment, changed), path[0] if path else leaf, leaf)
    return each * len(_places())


def _lines(seed: int, count: int) -> list[str]:
    draw = random.Random(seed)
    keys = [
        *groups(),
        *(key for _, key in _places()),
        "hydra.run.dir",
        "no.such",
        "track.all.weight",
        "custom_files",
    ]
    signs = ["", "", "", "+", "++", "~"]
    return [f"{draw.choice(signs)}{draw.choice(keys)}={draw.choice(LINES)}" for _ in range(count)]


def _try_line(line: str) -> None:
    group = key_of(line).partition(".")[0]
    for call in (compose_experiment, expand_grid, compose_sweep):
        _assert_one_line(_refusal(call, [line]), group, line[:20])


def test_any_value_of_any_key_is_taken_or_named_in_one_line():
    assert _try_values(seed=1, each=1) > 150


@pytest.mark.parametrize("part", range(3))
def test_any_override_is_taken_or_named_in_one_line(part):
    for line in _lines(part, 8):
        _try_line(line)


def test_any_option_file_is_taken_or_named_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "conf" / "stopping"
    folder.mkdir(parents=True)
    for at, kind in enumerate(KINDS):
        make(kind, folder / f"file{at}.yaml")
        complaint = _refusal(compose_option, "stopping", f"file{at}", NoStopping)
        assert complaint is not None, kind
        _assert_one_line(complaint, f"file{at}")


def test_an_option_file_leads_to_no_file_outside_of_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf" / "stopping").mkdir(parents=True)
    (tmp_path / "secret.yaml").write_text("kind: none\n")
    for name in ("../../secret", str(tmp_path / "secret")):
        (tmp_path / "conf" / "stopping" / "mine.yaml").write_text(f"defaults: ['{name}']\n")
        _assert_one_line(refused(compose_experiment, ["stopping=mine"]), "stopping", "secret")


@pytest.mark.parametrize(
    "line",
    [
        "network.hidden=[100000000]",
        "collector.cars=1000000",
        "collector.processes=100000",
        "algorithm.frames_per_iteration=1000000000",
        "car.substeps=100000",
        "evaluation.trials=1000000",
    ],
)
def test_a_slip_of_the_finger_that_costs_an_hour_is_refused(line):
    assert line.partition("=")[0] in refused(compose_experiment, [line])


@pytest.mark.slow
@pytest.mark.timeout(9000)
@pytest.mark.parametrize("seed", range(100, 104))
def test_thousands_of_values_and_overrides_are_taken_or_named_in_one_line(seed):
    assert _try_values(seed, each=10) > 1500
    for line in _lines(seed, 400):
        _try_line(line)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reward_function.py", "model_metadata.json", "hyperparameters.json"])
def test_whatever_lies_in_custom_files_is_taken_or_named_in_one_line(name, tmp_path, call):
    for at, kind in enumerate(KINDS):
        folder = tmp_path / str(at)
        folder.mkdir()
        (folder / "hyperparameters.json").write_text(json.dumps({"lr": 0.001}))
        (folder / name).unlink(missing_ok=True)
        make(kind, folder / name)
        ended = call("train", f"custom_files={folder}", "--cfg")
        assert ended.code == 0 or name in ended.complaint
    assert set(TEXTS) < set(KINDS)
