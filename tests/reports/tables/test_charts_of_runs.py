"""Charts of several runs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.aws.logs.recorded import Round
from deepracer_exp.reports.charts.run_charts import (
    generalisation_matrix,
    generations,
    group_name,
    policy_of,
    recordings_compared,
)
from deepracer_exp.reports.tables.log_view import LogView, prepare

from .chart_layers import layers
from .made_up import Drive, made_up_recording


def run(name: str, speed_mps: float = 1.4, iterations: int = 4, **more: object) -> LogView:
    drives = [Drive(iteration=k, speed_mps=speed_mps, off_at=None if k else 40) for k in range(iterations)]
    return prepare(made_up_recording(drives, entropy=[2.0] * iterations, name=name, **more))


def in_folder(view: LogView, folder: Path) -> LogView:
    """The view of a run of ours."""
    folder.mkdir()
    recording = replace(view.recording, files=(folder / "metrics.jsonl",))
    return replace(view, name=folder.name, recording=recording)


def test_names_that_differ_in_time_and_seed_are_one_group() -> None:
    names = [
        "20261122-013219-reinvent_base-progress_delta-seed0",
        "20261123-010101-reinvent_base-progress_delta-seed12",
    ]
    assert {group_name(name) for name in names} == {"reinvent_base-progress_delta"}
    assert group_name("seed0") == "seed0"


def test_recordings_of_seeds_become_a_mean_with_a_band_and_single_ones_lines_without() -> None:
    views = [(None, run(f"a-seed{k}", 1.3 + 0.1 * k)) for k in range(3)]
    chart = recordings_compared(views)
    assert len(layers(chart, "band")) == 4
    assert {line.name for line in layers(chart, "line")} == {"a", ""}
    laps = layers(next(p for row in chart.rows for p in row if p.title.startswith("Lap time")), "line")[0]
    # The slower a run, the more steps it has driven: at both ends some have no value.
    middle = laps.y[(laps.x > 0.5 * laps.x.max()) & (laps.x < 0.8 * laps.x.max())]
    times_s = [view.episodes["lap_time_s"].min() for _, view in views]
    np.testing.assert_allclose(middle, np.mean(times_s), rtol=1e-6)
    alone = recordings_compared([(None, run("a-seed0")), (None, run("b-seed0"))])
    assert not layers(alone, "band")
    assert "nothing says how much" in alone.caption
    assert recordings_compared([(None, run("a"))]) is None
    named = recordings_compared([("ours", run("x")), ("ours", run("y")), ("theirs", run("z"))])
    assert {line.name for line in layers(named, "line")} == {"ours", "theirs", ""}


def test_rounds_of_a_recording_are_generations() -> None:
    view = run("a", iterations=6)
    rounds = (Round("first", 0), Round("second", 4))
    chart = generations([replace(view, recording=replace(view.recording, rounds=rounds))])
    assert [layer.x.tolist() for layer in layers(chart.rows[0][0], "points")] == [[0, 1, 2, 3], [4, 5]]
    assert {mark.x0 for mark in layers(chart, "mark")} == {3.5}
    assert generations([view]) is None


def test_a_clone_follows_its_parent_in_whatever_order_they_come(tmp_path: Path) -> None:
    parent, clone, other = (
        in_folder(run(name, iterations=3), tmp_path / name) for name in ("parent", "clone", "other")
    )
    lineage = {"parent": "parent", "parent_dir": str(tmp_path / "parent"), "parent_run_id": None}
    lineage |= {"checkpoint": "000010", "sha256": "0" * 64, "generation": 1, "registered": None}
    (tmp_path / "clone" / "lineage.json").write_text(json.dumps(lineage))
    panel = generations([clone, other, parent]).rows[0][0]
    assert [layer.name for layer in layers(panel, "line")] == ["1: parent", "2: clone"]
    assert [layer.x.tolist() for layer in layers(panel, "points")] == [[0, 1, 2], [3, 4, 5]]
    assert generations([other, parent]) is None
    (tmp_path / "clone" / "lineage.json").write_text("{")
    assert generations([clone, parent]) is None


def test_the_matrix_has_every_policy_on_every_track(tmp_path: Path) -> None:
    stored = {
        "a": [("20260101", "reinvent_base", 10.0), ("20260102", "reinvent_base", 90.0)],
        "b": [("20260103", "Oval_track", 70.0)],
    }
    stored["a"].append(("20260103", "Oval_track", 50.0))
    views = []
    for name, evaluations in stored.items():
        views.append(in_folder(run(name), tmp_path / name))
        folder = tmp_path / name / "evaluations"
        folder.mkdir()
        for time, track, completion in evaluations:
            group = {"track": track, "condition": "usual", "completion": {"mean": completion}}
            held_out = {**group, "condition": "held_out", "completion": {"mean": 1.0}}
            (folder / f"{time}.json").write_text(json.dumps({"groups": [group, held_out]}))
        (folder / "20260104.json").write_text("no evaluation")
    chart = generalisation_matrix(list(map(policy_of, views)))
    np.testing.assert_array_equal(layers(chart, "cells")[0].z, [[90.0, 50.0], [np.nan, 70.0]])
    assert "mean is 60 per cent" in chart.caption
    assert generalisation_matrix([policy_of(views[1])]) is None


def test_recorded_races_are_results_as_well() -> None:
    view = run("a", evaluations={"race": [Drive(), Drive(until=0.5)]})
    assert policy_of(view)[2] == {"reinvent_base": pytest.approx(75.0)}
