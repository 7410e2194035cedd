"""Which checkpoint is recommended, and how it is shown."""

import dataclasses
import io
import math

import pandas as pd
import pytest
from rich.console import Console

from deepracer_exp.analysis.charts.runs import speed_and_stability
from deepracer_exp.analysis.page import write_chart
from deepracer_exp.evaluation.checkpoint_comparison import (
    CheckpointResult,
    LapStatistics,
    comparison_table,
    lap_statistics,
    legend,
    notes,
    recommend,
)
from deepracer_exp.evaluation.race_protocol import Attempt
from deepracer_exp.evaluation.result import Evaluation, Group


def figures(
    share: float, p25_s: float | None, held_out: float | None = None, done: float = 90.0
) -> LapStatistics:
    return LapStatistics(
        lap_share=share,
        lap_share_interval=(max(0.0, share - 0.1), min(1.0, share + 0.1)),
        completion=done,
        held_out_lap_share=held_out,
        held_out_completion=None if held_out is None else 100 * held_out,
        held_out_lap_time_p25_s=p25_s if held_out else None,
        lap_time_p25_s=p25_s,
        lap_time_median_s=p25_s,
        lap_time_best_s=p25_s,
        race_score_s=p25_s,
        rank=(0.0, done) if p25_s is None else (1.0, -p25_s),
    )


def result(name: str, found: LapStatistics | None, **changes: object) -> CheckpointResult:
    fixed = CheckpointResult(
        name=name,
        labels=(),
        pinned=(),
        counters={"iteration": int(name), "env_steps": 1_234_567},
        figures=found,
        fault=None if found is not None else "corrupt: state.tdz differs",
    )
    return dataclasses.replace(fixed, **changes)


def recommended(**found: LapStatistics | None) -> tuple[str, str]:
    chosen = recommend([result(name.strip("_"), one) for name, one in found.items()], "race_score")
    assert chosen is not None
    return chosen.name, chosen.why


def test_the_best_by_the_criterion_of_the_run_is_recommended_with_the_next_one():
    name, why = recommended(_000010=figures(0.95, 9.0), _000020=figures(0.5, 8.5))
    assert name == "000020"
    assert why == (
        "best by race score: race score 8.50 s, completion 90.0 %; next is 000010: race score 9.00 s, completion 90.0 %"
    )


def test_a_tie_goes_to_the_oldest_checkpoint():
    assert recommended(_000010=figures(1.0, 8.5), _000020=figures(0.9, 8.5))[0] == "000010"


def test_a_recommendation_other_than_best_says_so():
    listed = [result("000010", figures(1.0, 9.0), labels=("best",)), result("000020", figures(1.0, 8.5))]
    assert (
        "`best`, chosen in the trials of the training, is 000010: race score 9.00 s"
        in recommend(listed, "race_score").why
    )


def test_without_a_complete_lap_the_farthest_driver_is_recommended():
    name, why = recommended(_000010=figures(0.0, None, done=62.0), _000020=figures(0.0, None, done=41.0))
    assert name == "000010"
    assert "no complete lap, completion 62.0 %" in why


def test_a_corrupt_checkpoint_is_never_recommended():
    assert recommended(_000010=figures(0.5, 9.0), _000020=None)[0] == "000010"
    assert recommend([result("000010", None)], "race_score") is None


def lap(trial: int, time_s: float, complete: bool = True) -> Attempt:
    return Attempt(
        trial=trial,
        begin_s=0,
        time_s=time_s,
        penalty_s=0,
        resets=0,
        progress=100 if complete else 50,
        end="lap_complete" if complete else "off_track",
    )


def group(track: str, condition: str, laps: list[Attempt]) -> Group:
    return Group(track, condition, tuple(range(len(laps))), tuple(laps))


def test_figures_are_those_of_the_usual_conditions_with_the_held_out_ones_beside_them():
    usual = [lap(0, 8.0), lap(1, 9.0), lap(2, 10.0), lap(3, 12.0), lap(4, 3.0, complete=False)]
    found = lap_statistics(
        Evaluation(
            (group("oval", "usual", usual), group("oval", "held_out", [lap(0, 20.0), lap(1, 2.0, False)]))
        ),
        "race_score",
    )
    assert found.lap_share == pytest.approx(0.8)
    assert found.completion == pytest.approx(90.0)
    assert (found.lap_time_best_s, found.lap_time_p25_s, found.lap_time_median_s) == (8.0, 8.75, 9.5)
    assert found.race_score_s == pytest.approx(64 / 5)  # of all laps
    assert (found.held_out_lap_share, found.held_out_completion) == (0.5, 75.0)
    assert found.held_out_lap_time_p25_s == 20.0
    assert lap_statistics(Evaluation((group("oval", "usual", usual),)), "lap_time").held_out_lap_share is None


def test_a_track_without_a_lap_leaves_no_time_of_several_tracks():
    long, short = group("long", "usual", [lap(0, 20.0)]), group("short", "usual", [lap(0, 10.0)])
    failed = group("hard", "usual", [lap(0, 10.0, complete=False)])
    assert lap_statistics(Evaluation((long, short)), "progress").lap_time_p25_s == 15.0
    assert lap_statistics(Evaluation((long, failed)), "progress").lap_time_p25_s is None


LISTED = (
    result("000100", figures(0.95, 8.13, 0.15), pinned=("promoted as racer@champion",)),
    result("000110", None, labels=("best",)),
    result("001120", figures(0.40, 10.4, 0.45), labels=("last",)),
)


@pytest.mark.parametrize(
    ("width", "median", "intervals"), [(100, True, True), (80, False, True), (76, False, False)]
)
def test_a_narrow_table_drops_columns_but_truncates_no_number(width, median, intervals):
    console = Console(width=width, file=io.StringIO())
    console.print(comparison_table(LISTED, recommend(LISTED, "race_score"), console))
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    assert "best, bad" in text
    assert "1,234,567" in text
    assert ("median" in text, "95 (85\N{EN DASH}100)" in text) == (median, intervals)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text


def test_corrupt_and_pinned_checkpoints_are_listed_with_reasons():
    text = "\n".join(notes(LISTED, recommend(LISTED, "race_score")))
    assert "000110 is left out: corrupt: state.tdz differs" in text
    assert "000100 is pinned: promoted as racer@champion" in text
    assert "recommended: 000100: best by race score: race score 8.13 s" in text


def test_held_out_conditions_are_a_column_only_where_they_were_driven():
    usual_only = [result("000010", figures(0.95, 8.0))]
    console = Console(width=160, file=io.StringIO())
    console.print(comparison_table(usual_only, None, console), legend(usual_only))
    assert "held-out" not in console.file.getvalue()
    assert "held-out" in legend(LISTED)


def row(
    name: str, time_s: float, complete: float, away: tuple[float, float] = (math.nan, math.nan)
) -> dict[str, object]:
    held_out = {"held_out_lap_time_s": away[0], "held_out_complete": away[1]}
    interval = {"low": complete - 1, "high": complete + 1}
    return {"name": name, "labels": "", "lap_time_s": time_s, "complete": complete, **interval, **held_out}


@pytest.mark.parametrize(
    "rows",
    [
        [row("000010", 8.1, 95.0, (9.0, 40.0)), row("000020", 8.1, 95.0)],
        [row("000010", math.nan, 0.0), row("000020", 8.1, 100.0)],
        [row("000010", math.nan, 0.0)],
    ],
    ids=["on each other", "one without a lap", "no lap"],
)
def test_every_checkpoint_is_in_the_legend_of_the_chart(rows, tmp_path):
    chart = speed_and_stability("run", pd.DataFrame(rows), str(rows[-1]["name"]))
    page = write_chart(tmp_path / "checkpoints.html", chart)
    assert page.stat().st_size > 1_000_000
    panel = chart.rows[0][0]
    named = [layer.name for layer in panel.layers if getattr(layer, "showlegend", False)]
    assert all(any(name.startswith(str(one["name"])) for name in named) for one in rows)
    assert f"recommended: {rows[-1]['name']}" in named
    if any(one["complete"] for one in rows):
        assert panel.x_range[0] > panel.x_range[1], "faster is to the right"
