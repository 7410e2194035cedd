"""Laws of the figures of several runs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.charts.runs import generalisation_matrix, generations, group_name, runs_compared
from deepracer_exp.analysis.log_view import LogView, prepare
from deepracer_exp.analysis.run_folders import RESULT_COLUMNS, clone_chain, evaluation_results
from deepracer_exp.deepracer.recording import Round

from .chart_layers import layers
from .made_up import Drive, made_up_recording


def run(name: str, speed_mps: float = 1.4, iterations: int = 4) -> LogView:
    drives = [Drive(iteration=k, speed_mps=speed_mps, off_at=None if k else 40) for k in range(iterations)]
    return prepare(made_up_recording(drives, entropy=[2.0] * iterations, name=name))


def in_folder(view: LogView, folder: Path) -> LogView:
    """The view of a run of ours."""
    folder.mkdir()
    return replace(
        view, name=folder.name, recording=replace(view.recording, files=(folder / "metrics.jsonl",))
    )


def test_names_that_differ_in_time_and_seed_are_one_group() -> None:
    names = [
        "20261122-013219-reinvent_base-progress_gain-seed0",
        "20261123-010101-reinvent_base-progress_gain-seed12",
    ]
    assert {group_name(name) for name in names} == {"reinvent_base-progress_gain"}
    assert group_name("seed0") == "seed0"


def test_seeds_become_a_median_with_a_band() -> None:
    views = [run(f"a-seed{k}", 1.3 + 0.1 * k) for k in range(3)]
    chart = runs_compared(views)
    assert chart is not None
    assert len(layers(chart, "band")) == 4
    assert {line.name for line in layers(chart, "line")} == {"a", ""}
    laps = chart.table[chart.table["column"] == "lap_time_p25_s"].dropna()
    # The slower a run, the more steps it has driven: at both ends some have no value.
    middle = laps[laps["steps"].between(0.5 * laps["steps"].max(), 0.8 * laps["steps"].max())]
    np.testing.assert_allclose(middle["median"], views[1].episodes["lap_time_s"].min())
    assert (laps["low"] <= laps["median"]).all()
    assert (laps["median"] <= laps["high"]).all()


def test_single_runs_are_lines_without_bands() -> None:
    chart = runs_compared([run("a-seed0"), run("b-seed0")])
    assert not layers(chart, "band")
    assert "nothing says how much" in chart.caption  # type: ignore[union-attr]


def test_one_run_is_not_compared() -> None:
    assert runs_compared([run("a")]) is None
    assert generations([run("a")]) is None


def test_generations_stand_one_after_the_other() -> None:
    chart = generations([run("a", iterations=3), run("b", iterations=4)])
    assert chart is not None
    assert list(chart.table["iteration"]) == list(range(7))
    assert list(chart.table["generation"]) == [0] * 3 + [1] * 4
    assert {mark.x0 for mark in layers(chart, "mark")} == {2.5}


def test_rounds_of_a_recording_are_generations() -> None:
    view = run("a", iterations=6)
    rounds = (Round("first", 0, 0), Round("second", 4, 4))
    chart = generations([replace(view, recording=replace(view.recording, rounds=rounds))])
    assert chart is not None
    assert list(chart.table["generation"]) == [0] * 4 + [1] * 2


def test_a_clone_follows_its_parent_in_whatever_order_they_come(tmp_path: Path) -> None:
    parent, clone, other = (in_folder(run(name), tmp_path / name) for name in ("parent", "clone", "other"))
    lineage = {"parent": "parent", "parent_dir": str(tmp_path / "parent"), "parent_run_id": None}
    lineage |= {"checkpoint": "000010", "sha256": "0" * 64, "generation": 1, "registered": None}
    (tmp_path / "clone" / "lineage.json").write_text(json.dumps(lineage))
    assert [view.name for view in clone_chain([clone, other, parent])] == ["parent", "clone"]
    assert clone_chain([other, parent]) == []
    (tmp_path / "clone" / "lineage.json").write_text("{")
    assert clone_chain([clone, parent]) == []


def test_the_matrix_has_every_policy_on_every_track() -> None:
    views = [run("a"), run("b")]
    results = [
        pd.DataFrame(
            [("reinvent_base", 90.0, 0.8, 10.0), ("Oval_track", 50.0, 0.1, 9.0)], columns=RESULT_COLUMNS
        ),
        pd.DataFrame([("Oval_track", 70.0, 0.5, 9.5)], columns=RESULT_COLUMNS),
    ]
    chart = generalisation_matrix(views, results)
    cells = layers(chart, "cells")[0]
    np.testing.assert_array_equal(cells.z, [[90.0, 50.0], [np.nan, 70.0]])
    assert "mean is 60 per cent" in chart.caption  # type: ignore[union-attr]


def test_policies_tried_on_one_track_have_no_matrix() -> None:
    one = pd.DataFrame([("reinvent_base", 90.0, 0.8, 10.0)], columns=RESULT_COLUMNS)
    assert generalisation_matrix([run("a")], [one]) is None


def test_stored_evaluations_are_found_and_the_newest_counts(tmp_path: Path) -> None:
    view = in_folder(run("a"), tmp_path / "a")
    assert not len(evaluation_results(view))
    folder = tmp_path / "a" / "evaluations"
    folder.mkdir()
    for time, completion in (("20260101", 10.0), ("20260102", 20.0)):
        group = {"track": "Oval_track", "condition": "usual", "completion": {"mean": completion}}
        group |= {"lap_share": {"mean": 0.0}, "lap_time_s": {"mean": None}}
        held_out = {**group, "condition": "held_out", "completion": {"mean": 1.0}}
        (folder / f"{time}.json").write_text(json.dumps({"groups": [group, held_out]}))
    (folder / "20260103.json").write_text("no evaluation")
    found = evaluation_results(view)
    assert found["completion"].tolist() == [20.0]
    assert np.isnan(found["lap_time_s"]).all()


def test_recorded_races_are_results_as_well() -> None:
    view = prepare(made_up_recording([Drive()], evaluations={"race": [Drive(), Drive(until=0.5)]}))
    found = evaluation_results(view).iloc[0]
    assert (found["track"], found["lap_share"]) == ("reinvent_base", 0.5)
    assert found["completion"] == pytest.approx(75.0)
    assert found["lap_time_s"] == pytest.approx(Drive().lap_time_s(), rel=1e-6)
