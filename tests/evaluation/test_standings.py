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
        rank=(0.0, done) if p25_s is None else (1.0, -p25_s),
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
    chosen = recommend([standing(name.strip("_"), one) for name, one in found.items()], "race_score")
    assert chosen is not None
    return chosen.name, chosen.why


def test_the_best_by_the_criterion_of_the_run_is_recommended_with_the_next_one():
    name, why = recommended(_000010=figures(0.95, 9.0), _000020=figures(0.5, 8.5))
    assert name == "000020"
    assert why == (
        "best by race score: race score 8.50 s, completion 90.0 %; next is 000010: race score 9.00 s, completion 90.0 %"
    )


def test_of_equals_the_oldest_is_recommended_as_in_the_training():
    assert recommended(_000010=figures(1.0, 8.5), _000020=figures(0.9, 8.5))[0] == "000010"


def test_another_than_the_best_of_the_training_is_recommended_with_a_word_about_that():
    listed = [standing("000010", figures(1.0, 9.0), labels=("best",)), standing("000020", figures(1.0, 8.5))]
    assert (
        "`best`, chosen in the trials of the training, is 000010: race score 9.00 s"
        in recommend(listed, "race_score").why
    )


def test_without_a_complete_lap_the_one_that_comes_farthest_is_recommended():
    name, why = recommended(_000010=figures(0.0, None, done=62.0), _000020=figures(0.0, None, done=41.0))
    assert name == "000010"
    assert "no complete lap, completion 62.0 %" in why


def test_a_torn_checkpoint_is_never_recommended():
    assert recommended(_000010=figures(0.5, 9.0), _000020=None)[0] == "000010"
    assert recommend([standing("000010", None)], "race_score") is None


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
        ),
        "race_score",
    )
    assert found.lap_share == pytest.approx(0.8)
    assert found.completion == pytest.approx(90.0)
    assert (found.lap_time_best_s, found.lap_time_p25_s, found.lap_time_median_s) == (8.0, 8.75, 9.5)
    assert found.race_score_s == pytest.approx(64 / 5)  # of all laps
    assert (found.held_out_lap_share, found.held_out_completion) == (0.5, 75.0)
    assert found.held_out_lap_time_p25_s == 20.0
    assert figures_of(Evaluation((group("oval", "usual", usual),)), "lap_time").held_out_lap_share is None


def test_a_track_without_a_lap_leaves_no_time_of_several_tracks():
    long, short = group("long", "usual", [lap(0, 20.0)]), group("short", "usual", [lap(0, 10.0)])
    failed = group("hard", "usual", [lap(0, 10.0, complete=False)])
    assert figures_of(Evaluation((long, short)), "progress").lap_time_p25_s == 15.0
    assert figures_of(Evaluation((long, failed)), "progress").lap_time_p25_s is None


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
    console.print(table(LISTED, recommend(LISTED, "race_score"), console))
    text = console.file.getvalue()
    assert all(len(line) <= width for line in text.splitlines())
    assert "best, torn" in text
    assert "1,234,567" in text
    assert ("median" in text, "95 (85\N{EN DASH}100)" in text) == (median, intervals)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text


def test_torn_and_pinned_checkpoints_are_told_with_the_reasons():
    text = "\n".join(notes(LISTED, recommend(LISTED, "race_score")))
    assert "000110 is left out: torn: state.tdz is not as it was written" in text
    assert "000100 is pinned: promoted as racer@champion" in text
    assert "recommended: 000100: best by race score: race score 8.13 s" in text


def test_held_out_conditions_are_a_column_only_where_they_were_driven():
    usual_only = [standing("000010", figures(0.95, 8.0))]
    console = Console(width=160, file=io.StringIO())
    console.print(table(usual_only, None, console), legend(usual_only))
    assert "held-out" not in console.file.getvalue()
    assert "held-out" in legend(LISTED)


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
    figure = checkpoints_figure("run", points, points[-1].name)
    figure.savefig(tmp_path / "picture.png")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert all(any(label.startswith(one.name) for label in labels) for one in points)
    assert f"recommended: {points[-1].name}" in labels
    left, right = figure.axes[0].get_xlim()
    assert left > right, "faster is to the right"
