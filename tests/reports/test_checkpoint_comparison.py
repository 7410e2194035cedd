"""Which checkpoint is recommended, and how it is shown."""

import dataclasses
import io
import math

import pandas as pd
import pytest
from rich.console import Console

from deepracer_exp.evaluation.results import Evaluation
from deepracer_exp.reports.charts.run_charts import speed_and_stability
from deepracer_exp.reports.pages.checkpoint_comparison import (
    CheckpointResult,
    LapStatistics,
    comparison_table,
    lap_statistics,
    recommend,
)
from tests.evaluation.test_result import attempt, group
from tests.reports.tables.chart_layers import drawn


def figures(
    complete: float, lap_time_s: float, held_out: float = math.nan, done: float = 90.0
) -> LapStatistics:
    driven = math.isfinite(lap_time_s)
    return LapStatistics(
        complete=complete,
        low=max(0.0, complete - 10),
        high=min(100.0, complete + 10),
        completion=done,
        lap_time_s=lap_time_s,
        median_s=lap_time_s,
        best_s=lap_time_s,
        laps_s=(lap_time_s,) if driven else (),
        held_out_complete=held_out,
        held_out_completion=held_out,
        held_out_lap_time_s=math.nan,
        race_score_s=lap_time_s if driven else None,
        rank=(1.0, -lap_time_s) if driven else (0.0, done),
    )


def result(name: str, found: LapStatistics | None, **changes: object) -> CheckpointResult:
    fixed = CheckpointResult(
        name=name,
        labels=(),
        pinned=(),
        env_steps=1_234_567,
        figures=found,
        fault=None if found is not None else "corrupt: state.tdz differs",
    )
    return dataclasses.replace(fixed, **changes)


@pytest.mark.parametrize(
    ("found", "name", "words"),
    [
        (
            {"10": figures(95, 9.0), "20": figures(50, 8.5)},
            "20",
            "best by race score (usual): race score (usual) 8.50 s, usual completion 90.0%, median usual "
            "lap 8.50 s; next is checkpoint 10: "
            "race score (usual) 9.00 s, usual completion 90.0%, median usual lap 9.00 s",
        ),
        ({"10": figures(100, 8.5), "20": figures(90, 8.5)}, "10", "next is checkpoint 20"),
        (
            {"10": figures(0, math.nan, done=62.0), "20": figures(0, math.nan, done=41.0)},
            "10",
            "no complete lap, usual completion 62.0%",
        ),
        ({"10": figures(50, 9.0), "20": None}, "10", "race score (usual) 9.00 s"),
    ],
    ids=["best by the run's metric", "a tie goes to the oldest", "no lap", "never a corrupt one"],
)
def test_a_checkpoint_is_recommended_with_the_next_one(found, name, words):
    best, why = recommend([result(*one) for one in found.items()], "race_score")
    assert best == name
    assert words in why


def test_a_recommendation_other_than_best_says_so_and_without_any_there_is_none():
    listed = [result("10", figures(100, 9.0), labels=("best",)), result("20", figures(100, 8.5))]
    other = "`best`, chosen in the trials of the training, is checkpoint 10: race score (usual) 9.00 s"
    assert other in recommend(listed, "race_score")[1]
    assert recommend([result("10", None)], "race_score") is None


def test_figures_are_those_of_the_usual_conditions_with_the_held_out_ones_beside_them():
    laps = [attempt(trial, time_s) for trial, time_s in enumerate((8.0, 9.0, 10.0, 12.0))]
    usual = group(*laps, attempt(4, 3.0, progress=50.0))
    held_out = group(attempt(0, 20.0), attempt(1, 2.0, progress=50.0), condition="held_out")
    found = lap_statistics(Evaluation((usual, held_out)), "race_score")
    assert (found.complete, found.completion) == pytest.approx((80.0, 90.0))
    assert (found.best_s, found.lap_time_s, found.median_s) == (8.0, 8.75, 9.5)
    assert found.race_score_s == pytest.approx(64 / 5)  # of all laps
    assert (found.held_out_complete, found.held_out_completion) == (50.0, 75.0)
    assert found.held_out_lap_time_s == 20.0
    alone = lap_statistics(Evaluation((usual,)), "lap_time")
    assert math.isnan(alone.held_out_complete)
    assert math.isnan(alone.held_out_lap_time_s)


def test_a_track_without_a_lap_leaves_no_time_of_several_tracks():
    long, short = (group(attempt(0, time_s), track=f"{time_s}") for time_s in (20.0, 10.0))
    failed = group(attempt(0, progress=50.0), track="hard")
    assert lap_statistics(Evaluation((long, short)), "progress").lap_time_s == 15.0
    assert math.isnan(lap_statistics(Evaluation((long, failed)), "progress").lap_time_s)


LISTED = (
    result("100", figures(95, 8.13, 15), pinned=("promoted as racer@champion",)),
    result("110", None, labels=("best",)),
    result("1120", figures(40, 10.4, 45), labels=("last",)),
)


@pytest.mark.parametrize(
    ("width", "median", "intervals"), [(100, True, True), (80, False, True), (76, False, False)]
)
def test_a_narrow_table_drops_columns_but_truncates_no_number(width, median, intervals):
    console = Console(width=width, file=io.StringIO())
    console.print(comparison_table(LISTED, "100", console))
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    assert "best, bad" in text
    assert "held-out" in text
    assert "1,234,567" in text
    assert ("median" in text, "95 (85\N{EN DASH}100)" in text) == (median, intervals)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text


def test_held_out_conditions_are_a_column_only_where_they_were_driven():
    console = Console(width=160, file=io.StringIO())
    console.print(comparison_table([result("10", figures(95, 8.0))], "", console))
    assert "held-out" not in console.file.getvalue()


def row(
    name: str, time_s: float, complete: float, away: tuple[float, float] = (math.nan, math.nan)
) -> dict[str, object]:
    held_out = {"held_out_lap_time_s": away[0], "held_out_complete": away[1]}
    interval = {"low": complete - 1, "high": complete + 1}
    return {"name": name, "labels": "", "lap_time_s": time_s, "complete": complete, **interval, **held_out}


@pytest.mark.parametrize(
    "rows",
    [
        [row("10", 8.1, 95.0, (9.0, 40.0)), row("20", 8.1, 95.0)],
        [row("10", math.nan, 0.0), row("20", 8.1, 100.0)],
        [row("10", math.nan, 0.0)],
    ],
    ids=["on each other", "one without a lap", "no lap"],
)
def test_every_checkpoint_is_in_the_legend_of_the_chart(rows):
    chart = speed_and_stability(pd.DataFrame(rows), str(rows[-1]["name"]))
    assert drawn(chart).data
    panel = chart.rows[0][0]
    named = [layer["name"] for layer in panel.layers if layer.get("showlegend")]
    assert all(any(name.startswith(f"checkpoint {one['name']}") for name in named) for one in rows)
    assert f"recommended: checkpoint {rows[-1]['name']}" in named
    if any(one["complete"] for one in rows):
        assert panel.x_range[0] > panel.x_range[1], "faster is to the right"
