"""The benchmarks of an experiment's life (stopping, clone, resume) count what they say."""

import math
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import resume
from benchmarks.fresh import drive
from benchmarks.same import different_points, different_rows, different_tensors, different_traces

SHORT = ("budget.iterations=1",)


@pytest.fixture(scope="module")
def twins(trained: Callable[..., Any]) -> list[Path]:
    """Return two runs that differ in nothing but their time."""
    return [trained(*SHORT).folder, trained(*SHORT, "debug=false").folder]


def test_the_same_policy_drives_the_same_way_whatever_drives_beside_it(twins: list[Path]) -> None:
    alone, twice = drive(twins[0], ["last"], trials=2), drive(twins[1], ["last", "last"], trials=2)
    assert twice == alone * 2
    assert 0 < alone[0].completion < 100


def test_a_run_without_kills_is_the_same_as_the_undisturbed_one(twins: list[Path]) -> None:
    one, other = twins
    assert one != other
    lasts = [run / "checkpoints" / "last" for run in twins]
    assert different_tensors(*lasts) is None
    assert different_traces(one, other) is None


def test_one_bit_of_a_row_is_a_difference_and_a_time_is_none() -> None:
    rows = [{"iteration": 1, "completion": 0.3, "kl": math.nan, "wall_clock_s": 1.0}]
    assert different_rows(rows, [rows[0] | {"wall_clock_s": 2.0}]) is None
    bit = rows[0] | {"completion": math.nextafter(0.3, 1)}
    assert different_rows(rows, [bit]) == "row 1: completion is 0.3 and 0.30000000000000004"
    assert different_rows(rows, rows * 2) == "1 and 2 rows"


def test_other_weights_are_a_difference(trained: Callable[..., Any], twins: list[Path]) -> None:
    other = trained(*SHORT, "seed=1").folder
    assert different_tensors(twins[0] / "checkpoints" / "last", other / "checkpoints" / "last")
    assert different_traces(twins[0], other)


def test_a_point_twice_or_not_at_all_is_a_difference() -> None:
    rows = [
        {"env_steps": 10, "completion": 1.0, "best_lap_time_s": None, "wall_clock_s": 0.1},
        {"env_steps": 20, "completion": 2.0, "best_lap_time_s": 9.0, "wall_clock_s": 0.2},
    ]
    history = {
        "train/completion": [(20, 2.0), (10, 1.0)],
        "train/best_lap_time_s": [(20, 9.0)],
        "time/wall_clock_s": [(10, 0.1), (20, 0.7)],
        "system/system_memory_usage_percentage": [(10, 7.0), (10, 8.0)],
    }
    assert different_points(rows, history) is None
    for key, points in (
        ("train/completion", [(10, 1.0), (20, 2.0), (20, 2.0)]),
        ("train/completion", [(10, 1.0)]),
        ("train/completion", [(10, 1.0), (20, 2.5)]),
        ("time/wall_clock_s", [(10, 0.1), (20, 0.2), (20, 0.3)]),
        ("besides", [(10, 1.0)]),
    ):
        assert (different_points(rows, history | {key: points}) or "").startswith(f"{key}: ")


COUNTER = """\
import json, pathlib, time
run = pathlib.Path("runs/tiny/run")
(run / "checkpoints").mkdir(parents=True, exist_ok=True)
(run / "config.yaml").touch()
rows = run / "metrics.jsonl"
done = len(rows.read_text().splitlines()) if rows.exists() else 0
for number in range(done + 1, 11):
    time.sleep(0.02)
    with rows.open("a") as file:
        file.write(json.dumps({"iteration": number}) + "\\n")
    (run / "checkpoints" / f"{number:06d}").mkdir(exist_ok=True)
    aside = run / "checkpoints" / ".last"
    aside.unlink(missing_ok=True)
    aside.symlink_to(f"{number:06d}")
    aside.replace(run / "checkpoints" / "last")
(run / ".summary").write_text('{"status": "finished"}')
(run / ".summary").replace(run / "summary.json")
"""
"""Counts to ten, and continues where it was killed."""


@pytest.mark.processes
def test_a_run_is_killed_as_often_as_asked_even_if_it_is_much_faster_than_expected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resume, "command_line", lambda *_: [sys.executable, "-c", COUNTER])
    folder = tmp_path / "killed"
    folder.mkdir()
    expected = resume.Pace(start_s=1.0, work_s=2.0, iterations=10)
    run, kills = resume.killed([], folder, 4, expected, random.Random(0))
    assert run == folder / "runs" / "tiny" / "run"
    assert len(kills) == 4
    assert resume._rows(run) == 10
    assert all(kill["checkpoint"] >= kill["began_at"] for kill in kills)
