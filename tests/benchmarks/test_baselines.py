"""The baselines ask all algorithms for the same, take every training once, and summarize them as they say."""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import baselines
from benchmarks.sb3_timed import Watch
from deepracer_exp.config.compose import compose_experiment

FIGURES = {"completion": 100.0, "held_out_completion": 90.0, "train_s": 2.5, "steps": 1000}


def row(track: str, algorithm: str, seed: int, lap_time_s: float | None, **figures: float) -> baselines.Row:
    """Return the row of a training on a track whose bound is 5 s."""
    of = {"track": track, "algorithm": algorithm, "seed": seed, "seconds": 2.0, "overrides": []}
    return {**of, "bound_s": 5.0, "lap_time_s": lap_time_s, **FIGURES, **figures}


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[baselines.Cell]:
    """Have trainings do nothing; return those that were asked for, the ones before the first left out."""
    asked = []

    def measure(cell: baselines.Cell, seconds: float, own: list[str]) -> dict[str, Any]:
        if seconds != 1.0:
            asked.append(cell)
        return {"lap_time_s": 5.5, **FIGURES}

    monkeypatch.setattr(baselines, "measure", measure)
    monkeypatch.setattr(baselines, "bound", lambda track, own: 5.0)
    monkeypatch.setattr(baselines, "workers", ThreadPoolExecutor)
    return asked


def test_compared_trainings_begin_one_after_the_other_and_take_turns_in_being_first() -> None:
    order = baselines.cells(["A", "B"], 2, baselines.ALGORITHMS)
    groups = [order[at : at + 4] for at in range(0, len(order), 4)]
    for group, (seed, track) in zip(groups, [(0, "A"), (0, "B"), (1, "A"), (1, "B")], strict=True):
        assert {(cell.track, cell.seed) for cell in group} == {(track, seed)}
        assert {cell.algorithm for cell in group} == set(baselines.ALGORITHMS)
    assert [group[0].algorithm for group in groups] == ["ppo", "sac", "sac", "sb3_ppo"]


def test_trainings_that_are_compared_differ_by_the_algorithm_alone() -> None:
    ppo, sac, sb3_ppo, sb3_sac = (
        baselines.Cell("Oval_track", algorithm, 3).overrides(30.0, ["episode.max_steps=9"])
        for algorithm in baselines.ALGORITHMS
    )
    assert (ppo, sac) == (sb3_ppo, sb3_sac)
    assert set(ppo) ^ set(sac) == {"algorithm=ppo", "algorithm=sac"}
    assert compose_experiment(ppo)[0].budget.minutes == 0.5


def test_a_worker_keeps_to_one_core_and_leaves_the_others_to_this_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = os.sched_getaffinity(0)
    # A thread has cores of its own, too, and has imported what takes a process seconds.
    monkeypatch.setattr(
        baselines,
        "ProcessPoolExecutor",
        lambda jobs, _, begin, given: ThreadPoolExecutor(jobs, initializer=begin, initargs=given),
    )
    with baselines.workers(1) as pool:
        assert pool.submit(os.sched_getaffinity, 0).result() == {min(before)}
    assert os.sched_getaffinity(0) == before


def test_an_interrupted_benchmark_makes_the_missing_trainings_alone(
    trained: list[baselines.Cell],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "rows.jsonl"
    words = ["--json", str(file), "--seconds", "2", "--jobs", "1", "--seeds", "2", "--tracks", "A,B"]
    monkeypatch.setattr(baselines, "compose_experiment", lambda overrides: None)
    measure = baselines.measure

    def interrupted(cell: baselines.Cell, *given: Any, **named: Any) -> dict[str, Any]:
        if len(trained) == 3:
            raise KeyboardInterrupt
        return measure(cell, *given, **named)

    monkeypatch.setattr(baselines, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        baselines.main(words)
    first = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(one["track"], one["algorithm"], one["seed"]) for one in first] == trained
    monkeypatch.setattr(baselines, "measure", measure)
    assert baselines.main(words) == 0
    assert len(trained) == len(set(trained)) == 2 * 2 * 4
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert rows[:3] == first
    assert len(rows) == 2 * 2 * 4
    assert baselines.main(words) == 0
    assert len(trained) == 2 * 2 * 4
    assert "| `sb3_sac` |        4 |" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--seconds", "3"], ["seed=1"]])
def test_a_file_of_other_trainings_is_refused_and_left_as_it_is(
    words: list[str], trained: list[baselines.Cell], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.jsonl"
    file.write_text(json.dumps(row("A", "ppo", 0, 5.5)) + "\n")
    before = file.read_text()
    assert baselines.main(["--json", str(file), "--seconds", "2", "--tracks", "Oval_track", *words]) == 2
    assert "trainings of other seconds or overrides" in capsys.readouterr().err
    assert (file.read_text(), trained) == (before, [])
    file.write_text(before[:-9])
    assert baselines.main(["--json", str(file), "--seconds", "2"]) == 2
    assert "is not lines of its JSON" in capsys.readouterr().err


def test_laps_are_compared_with_the_bound_of_their_track_over_all_tracks() -> None:
    rows = [row("A", "ppo", seed, lap_s) for seed, lap_s in enumerate([5.0, 5.5, 6.0, 6.5])]
    rows += [row("B", "ppo", seed, 10.0) | {"bound_s": 8.0} for seed in range(4)]
    ppo = baselines.summarize(rows)["ppo"]
    # Of 0, 0.1, 0.2, 0.3 and four times 0.25 the middle four: 0.2 and three times 0.25.
    assert ppo["over_bound"]["iqm"] == pytest.approx(0.2375)
    low, high = ppo["over_bound"]["interval"]
    # The seeds of B are equal, and no resample has more of A.
    assert 0.05 < low < 0.2375 < high <= 0.275
    assert ppo["held_out_completion"] == {"iqm": 90.0, "interval": [90.0, 90.0]}
    assert (ppo["policies"], ppo["without_lap"]) == (8, 0)


def test_a_policy_without_a_lap_is_slower_than_any() -> None:
    rows = [row("A", "ppo", seed, 5.5) for seed in range(3)] + [row("A", "ppo", 3, None)]
    rows += [row("A", "sac", seed, lap_s) for seed, lap_s in enumerate([5.0, 5.5, None, None])]
    found = baselines.summarize(rows)
    assert found["ppo"]["over_bound"]["iqm"] == pytest.approx(0.1)
    assert found["sac"]["over_bound"]["iqm"] is None
    assert (found["ppo"]["without_lap"], found["sac"]["without_lap"]) == (1, 2)
    assert "| `A`   |      5.00 | 5.50 / 100.0 / 90.0 | - / 100.0 / 90.0 |" in baselines.markdown(rows)


def test_the_peers_entropy_bonus_falls_as_that_of_our_ppo() -> None:
    algorithm = compose_experiment(["algorithm.entropy_coeff=0.02", "algorithm.entropy_end_factor=0.5"])[
        0
    ].algorithm
    watch = Watch(1000.0, algorithm)
    watch.model = SimpleNamespace()
    watch.began = time.perf_counter() - 500.0
    watch._on_rollout_end()
    assert watch.model.ent_coef == pytest.approx(0.015, rel=1e-3)


@pytest.mark.slow
def test_policies_of_both_drive_the_same_laps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.jsonl"
    asked = ["--json", str(file), "--seconds", "1", "--seeds", "1", "--jobs", "1"]
    asked += ["--tracks", "Straight_track", "--algorithms", "ppo,sb3_ppo", "collector.cars=64"]
    assert baselines.main(asked) == 0
    ours, theirs = sorted(map(json.loads, file.read_text().splitlines()), key=lambda row: row["algorithm"])
    assert ours.keys() == theirs.keys()
    for one in (ours, theirs):
        assert 1.0 <= one["train_s"] < 5.0
        assert one["steps"] > 0
        assert 0 < one["completion"] <= 100
        assert one["machine"]["cores"] == 1
    assert "`Straight_track`" in capsys.readouterr().out
