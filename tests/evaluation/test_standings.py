"""Which checkpoint is recommended, and how it is shown."""

import dataclasses
import io

import pytest
from rich.console import Console

from deepracer_exp.analysis.checkpoints_figure import Lap, Point, checkpoints_figure
from deepracer_exp.evaluation.result import Evaluation, Group
from deepracer_exp.evaluation.standings import Figures, Standing, figures_of, recommend
from deepracer_exp.evaluation.standings_report import legend, notes, table
from deepracer_exp.evaluation.stewards import Attempt


def figures(share: float, p25_s: float | None, held_out: float | None = None, done: float = 90.0) -> Figures:
    return Figures(
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
    )


def standing(name: str, found: Figures | None, **changes: object) -> Standing:
    fixed = Standing(
        name=name,
        labels=(),
        pinned=(),
        counters={"iteration": int(name), "env_steps": 1_234_567},
        figures=found,
        fault=None if found is not None else "torn: state.tdz is not as it was written",
    )
    return dataclasses.replace(fixed, **changes)


def recommended(**found: Figures | None) -> tuple[str, str]:
    chosen = recommend([standing(name.strip("_"), one) for name, one in found.items()])
    assert chosen is not None
    return chosen.name, chosen.why


def test_a_faster_checkpoint_that_arrives_as_often_is_recommended():
    name, why = recommended(_000010=figures(0.95, 9.0), _000020=figures(0.95, 8.5))
    assert name == "000020"
    assert why == "95% complete laps, 25th percentile 8.50 s"


def test_a_faster_checkpoint_that_arrives_less_often_is_not_and_the_reason_says_so():
    name, why = recommended(_000120=figures(0.97, 9.8), _000150=figures(0.80, 9.7))
    assert name == "000120"
    assert "000150 is 0.10 s faster but completes only 80%" in why


def test_one_lap_in_twenty_less_is_no_reason_against_speed_and_two_are():
    assert recommended(_000010=figures(1.0, 9.0), _000020=figures(0.95, 8.5))[0] == "000020"
    name, why = recommended(_000010=figures(1.0, 9.0), _000020=figures(0.90, 8.5))
    assert name == "000010"
    assert "0.50 s faster" in why


def test_a_surer_but_slower_checkpoint_is_named_beside_the_recommended_one():
    name, why = recommended(_000010=figures(1.0, 9.0), _000020=figures(0.96, 8.5))
    assert name == "000020"
    assert "000010 completes 100% but is 0.50 s slower" in why


def test_of_equally_fast_ones_the_surer_then_the_steadier_then_the_newer_is_recommended():
    even = figures(0.95, 8.5, 0.5)
    assert recommended(_000010=figures(1.0, 8.5, 0.5), _000020=even)[0] == "000010"
    assert recommended(_000010=figures(0.95, 8.5, 0.7), _000020=even)[0] == "000010"
    assert recommended(_000010=even, _000020=even)[0] == "000020"


def test_who_arrives_more_often_on_held_out_conditions_is_named():
    name, why = recommended(_000010=figures(0.95, 9.0, 0.65), _000020=figures(0.95, 8.5, 0.15))
    assert name == "000020"
    assert "on held-out conditions 000010 completes 65% and this one 15%" in why


def test_without_a_complete_lap_the_one_that_comes_farthest_is_recommended():
    name, why = recommended(_000010=figures(0.0, None, done=62.0), _000020=figures(0.0, None, done=41.0))
    assert name == "000010"
    assert "no checkpoint completes a lap" in why
    assert "62%" in why


def test_a_torn_checkpoint_is_never_recommended():
    assert recommended(_000010=figures(0.5, 9.0), _000020=None)[0] == "000010"
    assert recommend([standing("000010", None)]) is None


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
    found = figures_of(
        Evaluation(
            (group("oval", "usual", usual), group("oval", "held_out", [lap(0, 20.0), lap(1, 2.0, False)]))
        )
    )
    assert found.lap_share == pytest.approx(0.8)
    assert found.completion == pytest.approx(90.0)
    assert (found.lap_time_best_s, found.lap_time_p25_s, found.lap_time_median_s) == (8.0, 8.75, 9.5)
    assert found.race_score_s == pytest.approx(42 / 4)
    assert (found.held_out_lap_share, found.held_out_completion) == (0.5, 75.0)
    assert found.held_out_lap_time_p25_s == 20.0
    assert figures_of(Evaluation((group("oval", "usual", usual),))).held_out_lap_share is None


def test_a_track_without_a_lap_leaves_no_time_of_several_tracks():
    long, short = group("long", "usual", [lap(0, 20.0)]), group("short", "usual", [lap(0, 10.0)])
    failed = group("hard", "usual", [lap(0, 10.0, complete=False)])
    assert figures_of(Evaluation((long, short))).lap_time_p25_s == 15.0
    assert figures_of(Evaluation((long, failed))).lap_time_p25_s is None


LISTED = (
    standing("000100", figures(0.95, 8.13, 0.15), pinned=("promoted as racer@champion",)),
    standing("000110", None, labels=("best",)),
    standing("001120", figures(0.40, 10.4, 0.45), labels=("last",)),
)


@pytest.mark.parametrize(
    ("width", "median", "intervals"), [(100, True, True), (80, False, True), (76, False, False)]
)
def test_a_narrow_table_leaves_out_columns_but_cuts_no_figure(width, median, intervals):
    console = Console(width=width, file=io.StringIO())
    console.print(table(LISTED, recommend(LISTED), console))
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    assert "best, torn" in text
    assert "1,234,567" in text
    assert ("median" in text, "95 (85\N{EN DASH}100)" in text) == (median, intervals)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text


def test_torn_and_pinned_checkpoints_are_told_with_the_reasons():
    text = "\n".join(notes(LISTED, recommend(LISTED)))
    assert "000110 is left out: torn: state.tdz is not as it was written" in text
    assert "000100 is pinned: promoted as racer@champion" in text
    assert "recommended: 000100: 95% complete laps" in text


def test_held_out_conditions_are_a_column_only_where_they_were_driven():
    usual_only = [standing("000010", figures(0.95, 8.0))]
    console = Console(width=160, file=io.StringIO())
    console.print(table(usual_only, None, console), legend(usual_only))
    assert "held out" not in console.file.getvalue()
    assert "held out" in legend(LISTED)


def point(name: str, time_s: float | None, complete: float, held_out: Lap | None = None) -> Point:
    return Point(
        name=name, labels="", usual=Lap(time_s, complete), interval=(complete, complete), held_out=held_out
    )


@pytest.mark.parametrize(
    "points",
    [
        [point("000010", 8.1, 95.0, Lap(9.0, 40.0)), point("000020", 8.1, 95.0, Lap(None, 0.0))],
        [point("000010", None, 0.0), point("000020", 8.1, 100.0)],
        [point("000010", None, 0.0)],
    ],
    ids=["on each other", "one without a lap", "no lap"],
)
def test_every_checkpoint_stands_in_the_picture_s_legend(points, tmp_path):
    figure = checkpoints_figure("run", points, points[-1].name, 5.0)
    figure.savefig(tmp_path / "picture.png")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert all(any(label.startswith(one.name) for label in labels) for one in points)
    assert f"recommended: {points[-1].name}" in labels
    left, right = figure.axes[0].get_xlim()
    assert left > right, "faster is to the right"
