"""The benchmarks of an experiment's life (stopping, clone, resume) count what they say."""

import json
import math
import random
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from benchmarks import clone, command, resume, stopping
from benchmarks.command import at_once
from benchmarks.fresh import Driven, drive, fresh_trials
from benchmarks.report import mean_and_interval
from benchmarks.same import different_points, different_rows, different_tensors, different_traces
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.training.metrics import NOT_EVALUATED

SHORT = ("budget.iterations=1", "checkpoints.every=null")


@pytest.fixture(scope="module")
def twins(trained: Callable[..., Any]) -> list[Path]:
    """Return two runs that differ in nothing but their time."""
    return [trained(*SHORT).folder, trained(*SHORT, "debug=false").folder]


def _driven(lap_time_s: float | None = 10.0, completion: float = 90.0) -> Driven:
    return Driven(
        completion=completion,
        lap_share=completion / 100,
        lap_time_s=lap_time_s,
        held_out_completion=completion - 10,
        held_out_lap_time_s=lap_time_s,
    )


def _judged(track: str, seed: int, saved_steps: int, kept: Driven, full: Driven) -> dict[str, Any]:
    return {
        "track": track,
        "seed": seed,
        "rule": "converged" if saved_steps else None,
        "iteration": 7,
        "iterations": 9,
        "env_steps": 1000 - saved_steps,
        "saved_steps": saved_steps,
        "saved": saved_steps / 1000,
        "lap_time_loss": stopping.lap_time_loss(kept, full),
        **kept.named("kept"),
        **full.named("full"),
    }


def test_what_stopping_saves_is_a_share_of_all_steps_and_what_it_costs_a_mean_over_the_runs_with_laps() -> (
    None
):
    runs = [
        _judged("A", 0, 800, _driven(10.4, 80.0), _driven(10.0, 90.0)),
        _judged("A", 1, 0, _driven(), _driven()),
        _judged("B", 0, 400, _driven(None, 20.0), _driven(8.0)),
    ]
    figures = stopping.summarize(runs)
    assert figures["steps_saved"] == 0.4
    assert figures["lap_time_loss"] == pytest.approx(0.02)
    assert figures["without_lap"] == 1
    assert figures["completion_kept"] == pytest.approx(190 / 3, abs=1e-4)
    assert figures["completion_full"] == 90
    assert figures["held_out_completion_full"] == 80
    lines = stopping.markdown(runs).splitlines()
    assert [line.split("|")[1].strip() for line in lines[-3:]] == ["`A`", "`B`", "all"]
    assert "4.0%" in lines[2]
    assert len({len(line) for line in lines}) == 1


def test_the_best_of_the_beginning_is_what_its_last_checkpoint_names(
    tmp_path: Path, monkeypatch: Any
) -> None:
    best = {10: None, 20: 20, 30: 20, 40: 40}
    for iteration in best:
        (tmp_path / "checkpoints" / f"{iteration:06d}").mkdir(parents=True)
    (tmp_path / "checkpoints" / "best").symlink_to("000040", target_is_directory=True)

    def read(folder: Path) -> dict[str, Any]:
        found = best[int(folder.name)]
        return {"best": found and {"iteration": found}}

    monkeypatch.setattr(stopping, "read_training", read)
    assert stopping.best_within(tmp_path, 39) == "000020"
    assert stopping.best_within(tmp_path, 40) == "000040"
    for too_early in (5, 19):
        with pytest.raises(SystemExit, match="no policy was evaluated"):
            stopping.best_within(tmp_path, too_early)


def test_a_finished_run_of_the_same_overrides_is_used_again(tmp_path: Path, monkeypatch: Any) -> None:
    asked = stopping.training_overrides("Oval_track", 1, 5000, ["network=mlp"], "stopping=none")
    compose_experiment(asked)
    trained = []
    monkeypatch.setattr(command, "train", lambda overrides, folder: trained.append(overrides) or folder)
    states = {
        "a": ("interrupted", asked),
        "b": ("finished", [*asked, "debug=true"]),
        "c": ("finished", asked),
    }
    for name, (status, overrides) in states.items():
        run = tmp_path / "runs" / "default" / name
        run.mkdir(parents=True)
        (run / "summary.json").write_text(json.dumps({"status": status}))
        (run / "overrides.yaml").write_text("".join(f"- {json.dumps(one)}\n" for one in overrides))
    assert command.trained(tmp_path, asked).name == "c"
    assert trained == []
    assert command.trained(tmp_path, [*asked, "seed=2"]) == tmp_path
    assert trained == [[*asked, "seed=2"]]


def test_a_really_stopped_run_must_be_the_beginning_of_the_full_one(tmp_path: Path) -> None:
    rows = [
        NOT_EVALUATED | {"iteration": number, "completion": number / 3, "wall_clock_s": number}
        for number in range(1, 10)
    ]

    def run(name: str, of: list[dict[str, Any]], best: int) -> Path:
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in of))
        summary = {"iteration": of[-1]["iteration"], "best": {"iteration": best}}
        (tmp_path / name / "summary.json").write_text(json.dumps(summary))
        return tmp_path / name

    full = run("full", rows, 8)
    slower = [row | {"wall_clock_s": 99.0} for row in rows[:5]]
    assert stopping.prove(full, run("same", slower, 4), 5, "000004")["same_metrics"]
    # A run that ends has its last policy evaluated, which may be the best.
    raced = [*slower[:4], slower[4] | {"eval_completion": 100.0}]
    assert stopping.prove(full, run("raced", raced, 5), 5, "000004")["same_metrics"]
    for name, of, best in (
        ("other_end", slower[:4], 4),
        ("other_best", slower, 3),
        ("other_row", [*slower[:4], slower[4] | {"completion": 1.7}], 4),
        ("raced_before", [*slower[:3], slower[3] | {"eval_completion": 100.0}, slower[4]], 4),
    ):
        with pytest.raises(SystemExit, match="ended after"):
            stopping.prove(full, run(name, of, best), 5, "000004")


def test_fresh_trials_begin_where_no_evaluation_of_a_training_does() -> None:
    experiment, _ = compose_experiment(["track=Oval_track", "experiment=tiny"])
    fresh, own = fresh_trials(16), experiment.evaluation
    starts = [
        [trial.start_ndist for trial in Evaluator(experiment, config, threads=1).trials]
        for config in (fresh, own)
    ]
    assert len(set(starts[0])) == 16
    assert not set(starts[0]) & set(starts[1])
    assert min(abs(new - old) for new in starts[0] for old in starts[1]) >= 0.25 / 16
    assert fresh.seed != own.seed


def test_the_same_policy_drives_the_same_way_whatever_drives_beside_it(twins: list[Path]) -> None:
    alone, twice = drive(twins[0], ["last"], trials=2), drive(twins[1], ["last", "last"], trials=2)
    assert twice == alone * 2
    assert 0 < alone[0].completion < 100


def test_clones_are_compared_within_their_family() -> None:
    seeds = [
        {
            "seed": seed,
            "parent": vars(_driven(parent)),
            "tenth": vars(_driven(parent - 0.5)),
            "same": vars(_driven(same)),
        }
        for seed, (parent, same) in enumerate(((10.0, 9.6), (12.0, 11.8), (9.0, None)))
    ]
    figures = clone.summarize(seeds)
    assert figures["parent"]["lap_time_s"]["mean"] == pytest.approx(31 / 3, abs=1e-4)
    assert figures["tenth_minus_parent"]["lap_time_s"] == {"mean": -0.5, "interval": [-0.5, -0.5]}
    assert figures["tenth_minus_same"]["lap_time_s"]["mean"] == pytest.approx(-0.2)
    low, high = figures["tenth_minus_same"]["lap_time_s"]["interval"]
    assert low < -0.2 < high
    lines = clone.markdown(seeds, figures).splitlines()
    assert len(lines) == 2 + 9 + 6
    assert len({len(line) for line in lines}) == 1


def test_the_interval_is_students() -> None:
    found = mean_and_interval([1.0, None, 2.0, 3.0])
    half = 4.302653 / math.sqrt(3)
    assert found == {"mean": 2.0, "interval": [round(2 - half, 4), round(2 + half, 4)]}
    assert mean_and_interval([1.0, None]) == {"mean": 1.0, "interval": None}
    assert mean_and_interval([None]) == {"mean": None, "interval": None}


def test_kills_fall_from_the_start_of_the_process_into_all_that_is_left() -> None:
    pace = resume.Pace(start_s=5.0, work_s=30.0, iterations=300)
    assert resume.latest_kill_s(pace, 0, 1) == 35
    assert resume.latest_kill_s(pace, 200, 1) == pytest.approx(15)
    assert resume.latest_kill_s(pace, 0, 19) == pytest.approx(8)
    assert resume.latest_kill_s(pace, 300, 7) == 5


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


def test_the_first_failure_of_many_calls_is_reported_and_ends_the_rest() -> None:
    made = []

    def call(number: int) -> int:
        made.append(number)
        if number == 1:
            raise SystemExit("no")
        time.sleep(0.05)
        return number * 2

    assert at_once(2, [partial(call, number) for number in (3, 2)]) == [6, 4]
    made.clear()
    with pytest.raises(SystemExit, match="no"):
        at_once(1, [partial(call, number) for number in range(1, 400)])
    assert len(made) < 399


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
(run / "summary.json").write_text('{"status": "finished"}')
"""
"""Counts to ten, and continues where it was killed."""


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
