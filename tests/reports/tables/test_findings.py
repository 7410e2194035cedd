"""Rules of the findings on made-up logs whose answers are known."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.reports.charts.figure import Chart
from deepracer_exp.reports.finding import Finding
from deepracer_exp.reports.findings import findings as find
from deepracer_exp.reports.pages.log_report import SECTIONS, LogPage, draw_sections, html
from deepracer_exp.reports.tables.line_file import recorded_line
from deepracer_exp.reports.tables.log_tables import NONE, best_laps, headline, iteration_rows
from deepracer_exp.reports.tables.log_view import LEAST_EPISODES, LogView, once_per_view, prepare
from deepracer_exp.reports.tables.off_track import neighbours
from deepracer_exp.reports.tables.sector_times import sectors_now
from deepracer_exp.runs.recording import EVALUATION_COLUMNS, RunRecording
from deepracer_exp.runs.run_result import RunResult
from deepracer_exp.tracks.sectors import sectors_of
from deepracer_exp.training.stopping.judge import LOG_RULE

from .chart_layers import layers
from .made_up import Drive, made_up_course, made_up_recording

COURSE = made_up_course()
SECTORS = sectors_of(COURSE)
findings = once_per_view(find)


def of(view: LogView, rule: str, target_s: float | None = None) -> Finding:
    (found,) = (one for one in findings(view, target_s) if one.rule == rule)
    return found


def run_of(view: LogView, **more: object) -> RunRecording:
    """Return the recording of a view as that of a run of ours."""
    best = RunResult(measure="race_score", rank=(0.0, 0.0), iteration=10, completion=90.0, lap_time_s=None)
    return RunRecording(recording=view.recording, **{"best": best, **more})


def training(
    completions: Sequence[float], episodes: int = LEAST_EPISODES, **more: Sequence[float]
) -> LogView:
    """Prepare a training with a few equal episodes an iteration; 1.0 completes the lap.

    Several tests read the same ones.
    """
    return _training(tuple(completions), episodes, **{name: tuple(values) for name, values in more.items()})


@cache
def _training(completions: tuple[float, ...], episodes: int, **more: tuple[float, ...]) -> LogView:
    drives = [
        Drive(speed_mps=3.0, iteration=k, until=c)
        if c >= 1
        else Drive(speed_mps=3.0, iteration=k, off_at=int(118 * c))
        for k, c in enumerate(completions)
        for _ in range(episodes)
    ]
    return prepare(made_up_recording(drives, **more))


RISING = [0.1 + 0.06 * k for k in range(15)]
LEARNED = [*RISING, *[1.0] * (LOG_RULE.patience + 4)]


@pytest.mark.parametrize(
    ("completions", "entropy", "words"),
    [
        (LEARNED, [], "Converged at iteration 1"),
        (LEARNED, [1.0] * len(LEARNED), "Converged at iteration 1"),
        (LEARNED, list(np.linspace(1.7, 0.2, len(LEARNED))), "but the entropy still changes"),
        ([*RISING, 1.0], [], "Not converged yet: completion grew"),
        ([*LEARNED, 0.4, 0.4, 0.4], [], "Not converged: completion fell back from 100 to 4"),
        ([0.2] * 30, [], "training longer will not help"),
        ([0.2] * (LOG_RULE.patience + 2), [], "Too short"),
    ],
)
def test_a_training_has_converged_where_nothing_grew_any_more(
    completions: list[float], entropy: list[float], words: str
) -> None:
    found = of(training(completions, entropy=entropy), "converged")
    assert words in found.sentence
    assert ("iteration" in found.values) == found.sentence.startswith("Converged")
    if completions is LEARNED and "iteration" in found.values:
        # The moving average of three reaches the last laps two iterations after the first of them.
        assert found.values["iteration"] in range(15, 18)


def test_a_training_with_as_many_iterations_as_are_asked_for_is_judged() -> None:
    short = of(training([0.2] * 11), "converged")
    assert "11 iterations, and at least 13 are needed" in short.sentence
    needed = short.values["needed"]
    assert "needed" in of(training([0.2] * (needed - 1)), "converged").values
    assert "completion" in of(training([0.2] * needed), "converged").values


def test_evaluated_laps_that_still_become_faster_are_growth() -> None:
    view = training(LEARNED)
    times_s = [10.0 - 0.2 * k for k in range(len(LEARNED))]
    laps = evaluated(view, *((k, 100.0, time_s, 0) for k, time_s in enumerate(times_s)))
    assert "lap times still improve" in of(laps, "converged").sentence
    assert "Converged at" in of(view, "converged").sentence


def test_episodes_under_way_when_the_run_ended_do_not_count() -> None:
    drives = [Drive(speed_mps=3.0, iteration=k) for k in range(15)]
    view = prepare(made_up_recording([*drives, Drive(speed_mps=3.0, iteration=14, until=0.05)]))
    assert view.iterations["completion_mean"].tolist() == [100.0] * 15
    assert not view.episodes["ended"].iloc[-1]


def test_an_episode_belongs_to_the_iteration_in_which_it_ended() -> None:
    recording = made_up_recording([Drive(speed_mps=3.0, iteration=k) for k in (1, 2)])
    begun_before = recording.steps["steps"] < 20
    steps = recording.steps.assign(iteration=recording.steps["iteration"] - begun_before)
    view = prepare(replace(recording, steps=steps))
    assert view.episodes["iteration"].tolist() == [1, 2]


@cache
def laps_of(*iterations: tuple[int, int, float]) -> LogView:
    """Prepare a training of iterations with complete laps, episodes that run off, and the laps' speed."""
    drives = [
        drive
        for k, (laps, offs, speed) in enumerate(iterations)
        for drive in [Drive(speed_mps=speed, iteration=k)] * laps
        + [Drive(speed_mps=2.0, iteration=k, off_at=9)] * offs
    ]
    return prepare(made_up_recording(drives))


def test_the_fast_and_dense_iteration_is_to_be_submitted() -> None:
    # The untrained one; dense but slow, fast and dense, fast but rare; too few laps for a percentile, and just enough.
    counts = (0, 5, 3.0), (10, 0, 2.0), (8, 2, 2.5), (3, 7, 3.0), (2, 0, 3.0), (3, 0, 1.8)
    view = laps_of(*counts, (8, 0, 1.5))  # in a short last iteration the job ended
    assert view.candidates["iteration"].tolist() == [2, 1, 5]
    found = of(view, "submit")
    assert found.sentence.startswith("Submit the checkpoint (its name is not logged")
    assert "8 of its 10 episodes are complete laps (49% to 94% with 95% confidence)" in found.sentence
    named = replace(view.recording, checkpoints={2: "2_Step-4711"})
    assert of(prepare(named), "submit").sentence.startswith("Submit the checkpoint 2_Step-4711, which drove")
    assert found.values["p25_s"] == pytest.approx(Drive(speed_mps=2.5).lap_time_s())


def test_without_enough_laps_the_fastest_of_the_complete_evaluations_is_to_be_submitted() -> None:
    view = laps_of((0, 5, 2.0), (2, 5, 2.0))
    assert of(view, "submit").sentence.startswith(
        "Nothing to submit yet: no iteration has 3 complete laps (2 laps in all)"
    )
    rows = [  # of iteration 3 one lap of two is incomplete, of 4 and 5 all are complete
        *((3, 100.0, 8.0), (3, 90.0, 7.0)),
        *((4, 100.0, 9.5), (4, 100.0, 9.7)),
        *((5, 100.0, 9.8), (5, 100.0, 9.8)),
    ]
    evaluated = pd.DataFrame(rows, columns=["iteration", "completion", "time_s"])
    evaluated = evaluated.assign(stream="training", phase="evaluation")
    metrics = evaluated.reindex(columns=view.recording.metrics.columns)
    recording = replace(view.recording, metrics=metrics, checkpoints={4: "4_Step-38", 5: "5_Step-47"})
    assert of(prepare(recording), "submit").sentence.startswith(
        "Submit the checkpoint 4_Step-38, which drove iteration 4: its evaluation completed both laps, in 9.60 s "
        "on average."
    )


def evaluated(view: LogView, *laps: tuple[int, float, float, float]) -> LogView:
    """Prepare a log again with evaluations: iteration, completion, time and resets of each lap."""
    rows = pd.DataFrame(laps, columns=["iteration", "completion", "time_s", "resets"])
    rows = rows.assign(stream="training", phase="evaluation")
    metrics = rows.reindex(columns=view.recording.metrics.columns)
    return prepare(replace(view.recording, metrics=metrics))


def test_evaluations_decide_whatever_the_exploring_laps_were() -> None:
    laps = laps_of((0, 5, 2.0), (10, 0, 3.0), (6, 4, 2.0))
    assert laps.candidates["iteration"].tolist() == [1, 2]
    first_two = evaluated(laps, (1, 100.0, 9.9, 0), (2, 100.0, 9.4, 0))
    assert "After it: that of iteration 1 (9.90 s, 100%)." in of(first_two, "submit").sentence
    view = evaluated(laps, (0, 60.0, 9.0, 0), (1, 100.0, 9.4, 0), (1, 100.0, 9.6, 0), (2, 100.0, 8.0, 2))
    # Of iteration 1 both laps are complete; the faster one of iteration 2 was put back twice.
    found = of(view, "submit")
    assert "that drove iteration 1: its evaluation completed both laps" in found.sentence
    assert (found.values["iteration"], found.values["lap_time_s"]) == (1, pytest.approx(9.5))
    assert view.candidates["iteration"].tolist() == [1]
    stars = [
        one for one in layers(chart_of(view, "lap_time_percentile"), "points") if one.marker.symbol == "star"
    ]
    assert [list(one.x) for one in stars] == [[1]]
    # Without a complete lap they cannot decide.
    assert evaluated(laps, (1, 90.0, 9.4, 0)).candidates["iteration"].tolist() == [1, 2]


def test_the_policy_that_a_training_began_with_is_none_of_its_results() -> None:
    view = laps_of((10, 0, 3.0), (6, 4, 2.0), (4, 6, 2.0))
    assert view.candidates["iteration"].tolist() == [1, 2]
    sentence = of(laps_of((10, 0, 3.0), (2, 4, 2.0)), "submit").sentence
    assert sentence.startswith(
        "Nothing to submit yet: 10 of 12 complete laps are those of iteration 0, driven by the"
    )


@pytest.mark.parametrize(
    ("name", "iteration", "words"),
    [
        ("0_Step-0", 1, "the checkpoint 1_Step-38, which drove iteration 1"),
        ("28_Step-0", 0, "the checkpoint 28_Step-0, the model that was cloned, which drove iteration 0"),
    ],
)
def test_the_first_evaluation_is_that_of_the_model_that_was_cloned_or_of_an_untrained_network(
    name: str, iteration: int, words: str
) -> None:
    view = evaluated(laps_of((0, 5, 2.0), (0, 5, 2.0)), (0, 100.0, 9.0, 0), (1, 100.0, 9.4, 0))
    view = prepare(replace(view.recording, checkpoints={0: name, 1: "1_Step-38"}))
    assert view.candidates["iteration"].iloc[0] == iteration
    assert words in of(view, "submit").sentence


TO_DO = (
    "Keep training",
    "Submit ",
    "Take ",
    "Lower ",
    "Race with",
    "Train longer",
    "Clone ",
    "training longer",
)


def test_one_thing_is_to_be_done_and_it_is_the_first_finding() -> None:
    falling = [10.0 * k for k in range(10)] + [90.0] * 3 + [40.0] * 6
    named = {k: f"{k}_Step-{100 * k}" for k in range(25)}
    for completions, evaluations, rule, words in (
        ([*RISING, *[1.0] * 4], falling, "overfits", "It became less sure"),
        ([*RISING, 0.9], [], "converged", "Keep training: clone the model as it is."),
        (LEARNED, [], "submit", "Submit the checkpoint"),
        ([*LEARNED, 0.4, 0.4, 0.4], [], "converged", "Lower the learning rate, or take the checkpoint"),
    ):
        view = training(completions, evaluated=evaluations)
        view = prepare(replace(view.recording, checkpoints=named))
        first, *others = findings(view)
        assert first.rule == rule
        assert words in first.sentence
        assert not [one.sentence for one in others for word in TO_DO if word in one.sentence]
        if rule == "overfits":
            best = view.candidates.iloc[0]["checkpoint"]
            assert f"Take the checkpoint {best}, and clone it at a lower learning rate." in first.sentence
            assert f"The best so far is the checkpoint {best}," in of(view, "submit").sentence


def test_other_findings_come_by_what_they_cost_and_none_that_costs_next_to_nothing() -> None:
    view = off_at((35, 6, False), (85, 4, False))
    costs = [one.cost_percent for one in findings(view)[1:]]
    assert costs == sorted(costs, reverse=True)
    assert of(view, "runs_off").cost_percent == pytest.approx(100 * 10 / 16)
    # 120 laps alike but one, which is some hundredths of a second faster.
    laps = prepare(made_up_recording([Drive(speed_mps=2.0)] * 5 + [Drive(speed_mps=2.001)]))
    assert "time_lost" not in [one.rule for one in findings(laps)]


def test_iterations_of_one_episode_are_judged_together() -> None:
    one = training([c for c in LEARNED for _ in range(LEAST_EPISODES)], episodes=1)
    many = training(LEARNED)
    assert one.judged["episodes"].tolist() == [LEAST_EPISODES] * len(LEARNED)
    assert one.judged["completion_mean"].tolist() == pytest.approx(many.judged["completion_mean"].tolist())
    assert one.judged["iteration"].tolist() == [LEAST_EPISODES * k + 4 for k in range(len(LEARNED))]
    assert of(one, "converged").values["completion"] == of(many, "converged").values["completion"]
    assert (
        "drove the last of iterations 75 to 79: a quarter of their exploring laps"
        in of(one, "submit").sentence
    )
    assert many.judged is many.iterations
    # A block of steps that have no episode yet ends with the last iteration.
    assert one.judged["steps"].sum() == one.iterations["steps"].sum()


def with_resets(view: LogView, *episodes: int) -> LogView:
    """Prepare a log again in which the car was put back once in the middle of episodes."""
    steps = view.recording.steps.copy()
    status = steps["episode_status"].astype(str)
    for episode in episodes:
        rows = np.flatnonzero(steps["episode"] == episode)
        status.iloc[rows[len(rows) // 2]] = "off_track"
        status.iloc[rows[len(rows) // 2 + 1]] = "pause"
    return prepare(replace(view.recording, steps=steps.assign(episode_status=status.astype("category"))))


def test_laps_with_resets_are_no_laps_of_the_driving_line() -> None:
    drives = {"race": [Drive(speed_mps=v) for v in (1.5, 1.5, 1.6, 1.6, 1.8, 2.0)]}
    view = with_resets(prepare(made_up_recording([], evaluations=drives)), 5)
    assert view.episodes["resets"].tolist() == [0, 0, 0, 0, 0, 1]
    assert view.episodes["lap_time_s"].notna().tolist() == [True] * 5 + [False]
    assert view.episodes["reset_lap_time_s"].notna().tolist() == [False] * 5 + [True]
    assert "5 complete laps, the fastest in 9.9" in headline(view)
    assert headline(view).endswith("; 1 more lap with resets.")
    found = of(view, "chance")
    assert (found.values["laps"], found.values["complete"]) == (5, pytest.approx(5 / 6))
    assert "the best sectors of 5 laps" in of(view, "time_lost").sentence.lower()
    assert [row[-1] for row in best_laps(view).rows] == ["0"] * 5 + ["1"]
    assert "(5)" in chart_of(view, "lap_time_histogram").rows[0][0].title


def test_no_normal_curve_goes_through_a_few_laps() -> None:
    for laps, drawn in ((3, False), (5, True)):
        speeds = (1.5, 2.0, 1.8, 1.7, 1.6)[:laps]
        view = prepare(made_up_recording([], evaluations={"race": [Drive(speed_mps=v) for v in speeds]}))
        (panel,) = chart_of(view, "lap_time_histogram").rows[0]
        assert any("normal" in str(one.name) for one in layers(panel, "line")) == drawn


def test_an_episode_just_short_of_the_lap_has_not_driven_all_of_it() -> None:
    view = prepare(made_up_recording([Drive(until=0.998)]))
    assert "(0 laps in all); the farthest episode drove 99% of the lap" in of(view, "submit").sentence


def test_laps_that_are_in_metrics_files_only_can_be_submitted() -> None:
    recording = laps_of((0, 5, 2.0)).recording
    known = {
        "stream": "training",
        "worker": 0,
        "iteration": 7,
        "trial": 1,
        "phase": "training",
        "reward": 1.0,
    }
    known |= {"completion": 100.0, "time_s": 9.5, "episode_status": "lap_complete", "resets": 0.0}
    metrics = pd.DataFrame({"episode": np.arange(100, 108)}).assign(**known)
    view = prepare(replace(recording, metrics=metrics))
    assert of(view, "submit").sentence.startswith("Submit the checkpoint (its name is not logged")
    words = "8 more episodes known from metrics files only; 8 complete exploring laps, the fastest in 9.50 s"
    assert words in headline(view)
    assert "a quarter of the 5 episodes with a trace" in chart_of(view, "quarters").caption
    assert "5 of 5 episodes with a trace ended" in chart_of(view, "episode_ends_map").title
    assert of(view, "runs_off").sentence.endswith("since iteration 0 of the traces.")
    assert [row[2] for row in iteration_rows(view).rows] == [str(len(view.steps)), NONE]


def test_the_chance_of_a_lap_is_measured_and_fitted_on_the_laps_of_the_last_third() -> None:
    view = laps_of((6, 0, 1.0), (6, 0, 1.0), (4, 0, 2.0), (2, 0, 3.0))
    found = of(view, "chance", target_s=Drive(speed_mps=2.5).lap_time_s())
    assert (found.values["laps"], found.values["faster"]) == (6, 2)
    assert "2 of 6 complete exploring laps since iteration 2 took at most 7.15 s" in found.sentence
    assert (found.values["low"], found.values["high"]) == pytest.approx((0.0968, 0.7), abs=1e-3)
    assert found.values["normal"] == pytest.approx(0.303, abs=0.001)


def test_lap_times_of_cars_that_differ_are_not_compared() -> None:
    drives = [Drive(speed_mps=v, iteration=k) for k in range(9) for v in (3.0, 2.0, 3.2, 5.0)]
    alike = prepare(made_up_recording(drives))
    usual = alike.episodes["episode"].to_numpy()[::2]
    view = prepare(run_of(alike, usual_episodes=usual))
    chance = of(view, "chance")
    assert chance.values["laps"] == 6
    assert chance.values["best_s"] == pytest.approx(Drive(speed_mps=3.2).lap_time_s())
    assert "since iteration 6 on usual conditions took" in chance.sentence
    assert "100% of these episodes were complete laps" in chance.sentence
    assert of(alike, "chance").values["laps"] == 12
    fastest_s = Drive(speed_mps=3.2).lap_time_s()
    assert f"the fastest in {fastest_s:.2f} s" in headline(view)
    assert best_laps(view).rows[0][0] == f"{fastest_s:.2f}"
    assert recorded_line(view, None)[1].endswith(f"{fastest_s:.3f} s")
    charts = {chart.name: chart for some in draw_sections(LogPage(view, [])).values() for chart in some}
    assert f": {fastest_s:.3f} s" in charts["lap_line"].title
    assert charts["lap_time_histogram"].rows[0][0].title == "All complete laps on usual conditions (18)"
    lost = sectors_now(view, COURSE)[1].sum(axis=1)
    assert (lost.min(), lost.max()) == pytest.approx([Drive(speed_mps=v).lap_time_s() for v in (3.2, 3.0)])
    usual_s = [Drive(speed_mps=v).lap_time_s() for v in (3.0, 3.2)]
    assert view.iterations["lap_time_best_s"].tolist() == pytest.approx([min(usual_s)] * 9)
    assert view.iterations["lap_time_mean_s"].tolist() == pytest.approx([sum(usual_s) / 2] * 9)
    # Episodes on other conditions count in all that does not compare lap times.
    assert view.iterations["complete"].tolist() == [4] * 9
    assert len(view.now()[0]) == 12
    for few, comparable in ((usual[:1], 1), (usual[:0], len(drives))):
        assert len(prepare(run_of(alike, usual_episodes=few)).comparable) == comparable


def test_without_a_lap_there_is_no_chance_and_few_say_little() -> None:
    rules = [one.rule for one in findings(laps_of((0, 5, 2.0)))]
    assert rules == ["converged", "runs_off", "steering", "submit"]
    for laps in (1, 3):
        view = laps_of((1, 4, 2.0), (laps - 1, 4, 1.5))
        sentence = of(view, "chance").sentence
        assert "too few to say how likely the next one is" in sentence
        lost = [one.sentence for one in findings(view) if one.rule == "time_lost"]
        assert [f"From {laps} laps this is a hint at most." in one for one in lost] == [True] * (laps > 1)


def test_time_is_lost_in_the_sectors_that_were_driven_slowly() -> None:
    slow = dict(zip((SECTORS[k] for k in (1, 5, 9)), (0.8, 1.0, 1.2), strict=True))
    sections = tuple((part.begin, part.end, speed) for part, speed in slow.items())
    drives = [Drive(speed_mps=2.0)] + [Drive(speed_mps=2.0, sections=sections)] * 6
    found = of(prepare(made_up_recording(drives)), "time_lost")
    lost = {
        f"lost_s, {part.name}": (part.end - part.begin) * COURSE.length_m * (1 / speed - 1 / 2.0)
        for part, speed in slow.items()
    }
    names = [name for name in found.values if name.startswith("lost_s")]
    assert names == sorted(lost, key=lambda name: -lost[name])
    assert {name: found.values[name] for name in lost} == pytest.approx(lost, abs=0.05)
    assert found.values["theoretical_best_s"] == pytest.approx(Drive(speed_mps=2.0).lap_time_s(), abs=0.05)
    assert "Compared with the best time of each sector, the median loses most in" in found.sentence
    assert f"waypoints {SECTORS[1].first_waypoint} to {SECTORS[1].last_waypoint}" in found.sentence


@cache
def off_at(*places: tuple[int, int, bool], unfinished: int = 0) -> LogView:
    """Prepare drives that run off at waypoints, each as often as given, spinning or not, among complete laps."""
    drives = [Drive()] * 6 + [Drive(until=0.3)] * unfinished
    for waypoint, times, spins in places:
        drives += [Drive(off_at=waypoint + k % 3 - 1, spins=spins) for k in range(times)]
    return prepare(made_up_recording(drives))


def test_the_car_runs_off_where_it_was_made_to() -> None:
    view = off_at((35, 6, False), (85, 4, False))
    found = of(view, "runs_off")
    times = {name: value for name, value in found.values.items() if name.startswith("times")}
    assert times == {"times, waypoint 35": 6, "times, waypoint 85": 4}
    # All sixteen come to waypoint 35, and six do not come to 85.
    assert found.values["risk, waypoint 35"] == pytest.approx(6 / 16)
    assert found.values["risk, waypoint 85"] == pytest.approx(4 / 10)
    assert "waypoint 35 (left 2) to the right" in found.sentence
    # What the car does at several places is said once.
    assert "at waypoints 35 and 85 it understeers" in of(view, "steering").sentence
    assert "runs_off" not in [one.rule for one in findings(off_at())]


def test_a_car_that_goes_straight_on_though_steered_understeers_and_a_spinning_one_oversteers() -> None:
    found = of(off_at((35, 6, False), (85, 4, True)), "steering")
    assert found.sentence.startswith("Before it runs off, at waypoint 35 it understeers")
    assert "at waypoint 85 it oversteers" in found.sentence
    assert (found.values["understeer, waypoint 35"], found.values["oversteer, waypoint 85"]) == (6, 4)


def test_a_car_that_does_not_steer_back_is_named_so() -> None:
    view = off_at((35, 6, False))
    last = view.steps.groupby("episode").cumcount(ascending=False) < 12
    ends = view.episodes["status"].to_numpy()[view.steps["episode"]] == "off_track"
    steps = view.recording.steps.copy()
    steps.loc[last & ends, "steer"] = 0.0
    assert "it does not steer back" in of(prepare(replace(view.recording, steps=steps)), "steering").sentence


def test_logs_without_episode_status_show_where_the_car_runs_off() -> None:
    recording = off_at((35, 6, False)).recording
    view = prepare(replace(recording, steps=recording.steps.assign(episode_status="")))
    assert view.episodes["status"].tolist() == ["lap_complete"] * 6 + ["off_track"] * 6
    assert of(view, "runs_off").values["times, waypoint 35"] == 6


def test_a_car_that_is_put_back_passes_a_place_as_often_as_it_runs_off_there() -> None:
    recording = made_up_recording([Drive()])
    off = np.flatnonzero(recording.steps["closest_waypoint"] == 34)[0] + np.array([0, 2, 4])
    status = recording.steps["episode_status"].astype(str).to_numpy()
    status[off] = "off_track"
    view = prepare(replace(recording, steps=recording.steps.assign(episode_status=status)))
    assert "(3 of 3 passes: a risk of 44% to 100%)" in of(view, "runs_off").sentence


def test_crashes_at_one_object_are_a_finding_with_place_and_count() -> None:
    recording = off_at((35, 6, False), (85, 2, False), unfinished=1).recording
    status = recording.steps["episode_status"].astype(str).replace("off_track", "crashed")
    view = prepare(replace(recording, steps=recording.steps.assign(episode_status=status.astype("category"))))
    found = of(view, "crashes")
    assert found.sentence.startswith("The car crashed in 8 of 14 episodes, 6 times at one place: waypoint 3")
    assert found.sentence.endswith(" m).")
    assert headline(view).split("; ")[0].endswith("14 finished episodes and 1 iteration")
    assert of(view, "chance").values["complete"] == 6 / 14
    assert "crashes" not in [one.rule for one in findings(off_at((35, 6, False)))]


FALLING = [10.0 * k for k in range(10)] + [90.0] * 9 + [40.0] * 10


def test_a_crash_in_the_first_step_after_a_crash_is_another(reference: Path) -> None:
    view = prepare(read_recording(reference / "inputs/fourth/03-crash-in-first-step"))
    assert of(view, "crashes").sentence.startswith("The car crashed in 4 of 5 episodes")


@pytest.mark.parametrize(
    ("completions", "evaluated", "overfits"),
    [
        (LEARNED, FALLING, True),
        ([*RISING, *[1.0] * 4, *[0.3] * 10], FALLING, False),
        (LEARNED, [min(90.0, 10.0 * k) for k in range(29)], False),
    ],
    ids=["they fall while the training holds", "both fall", "both hold"],
)
def test_evaluations_that_fall_while_the_training_holds_are_overfitting(
    completions: list[float], evaluated: list[float], overfits: bool
) -> None:
    found = [one for one in findings(training(completions, evaluated=evaluated)) if one.rule == "overfits"]
    assert bool(found) == overfits
    for one in found:
        assert "completion of three evaluations in a row fell from 90%" in one.sentence
        assert "it overfits" in one.sentence
        assert one.values["best_iteration"] in range(10, 19)


def test_a_run_of_ours_is_judged_by_its_own_rules_and_its_decision_is_what_the_report_shows() -> None:
    view = training(LEARNED, evaluated=FALLING)
    overrides = ["stopping.converged.patience=40", "stopping.overfitting.patience=20"]
    stopping = compose_experiment(overrides)[1].mapping["stopping"]
    own = replace(view, run=run_of(view, stopping=stopping))
    assert "at least 43 are needed" in of(own, "converged").sentence
    fallen = of(own, "overfits").sentence
    assert "fell from 90%" in fallen
    assert "it overfits" not in fallen  # not before iteration 23
    decision = {"rule": "overfitting", "why": "held-out fell", "values": {"a": 1.0}, "thresholds": {}}
    ended = replace(view, run=run_of(view, decision=decision))
    assert "ended it (overfitting): held-out fell." in of(ended, "converged").sentence
    assert "overfits" not in [one.rule for one in findings(ended)]


def test_a_run_of_ours_is_advised_to_take_a_checkpoint_that_it_has() -> None:
    fell_back = [*LEARNED, 0.4, 0.4, 0.4]
    for completions, words in (
        (LEARNED, "checkpoint 10, the best, whose evaluation completed 90%"),
        (fell_back, "take checkpoint 10 (the best by race score (usual))"),
    ):
        view = training(completions, evaluated=FALLING)
        assert "checkpoint 10" not in findings(view)[0].sentence
        own = replace(view, run=run_of(view))
        assert words in findings(own)[0].sentence
        assert "enough laps" not in "".join(one.caption for one in charts_of(own))


def held_out(view: LogView, completions: list[float], laps_s: list[float], **more: object) -> LogView:
    """Prepare a training as a run of ours with evaluations of these held-out completions and laps."""
    rows = {"iteration": range(len(completions)), "completion": 100.0, "lap_share": 1.0}
    evaluations = pd.DataFrame({**rows, "held_out_completion": completions, "lap_time_s": laps_s})
    evaluations = evaluations.reindex(columns=list(EVALUATION_COLUMNS))
    return prepare(run_of(view, evaluations=evaluations, **more))


def test_a_car_that_became_faster_and_less_sure_is_called_so_with_what_to_do() -> None:
    # From 100 to 60% within 12 iterations: before the patience of any rule is over.
    completions = [100.0] * 6 + [90.0, 80.0, 70.0, *[60.0] * 3]
    view = held_out(training([1.0] * 12), completions, [8.0 - 0.2 * k for k in range(12)])
    first = findings(view)[0]
    assert first.rule == "overfits"
    assert "held-out evaluations in a row fell from 100%" in first.sentence
    assert "faster meanwhile, from 7.80 to 6.00 s: it is faster and less sure" in first.sentence
    assert "Clone it at a tenth of the learning rate, with randomization=sim2real" in first.sentence
    # The best, of iteration 10, is as unsure as the last one.
    assert "or take checkpoint 5, an earlier one, whose held-out evaluation completed 100%" in first.sentence
    trained_so = held_out(training([1.0] * 12), completions, [8.0] * 12, randomized=True)
    assert "Clone it at a tenth of the learning rate; or" in findings(trained_so)[0].sentence


@pytest.mark.parametrize(
    ("rule", "values", "to_do"),
    [
        ("reliable", {"lap_share": 0.9}, "Train longer"),
        ("overfitting", {"held_out_completion_before": 86.0, "held_out_completion_since": 67.0}, "sim2real"),
        ("laps_slower", {"lap_time_s_before": 6.0, "lap_time_s_since": 6.6}, "Take checkpoint 10"),
        ("collapsed", {"completion": 20.0}, "Raise the entropy coefficient (algorithm.entropy_coeff)"),
        ("not_learning", {"completion": 20.0}, "training longer will not help"),
        ("converged", {}, "Race with checkpoint 10"),
    ],
)
def test_what_ended_a_run_decides_what_to_do_next(rule: str, values: dict[str, float], to_do: str) -> None:
    view = training(LEARNED)
    decision = {"rule": rule, "why": "it", "values": values, "thresholds": {}}
    first, *others = findings(replace(view, run=run_of(view, decision=decision)))
    assert to_do.lower() in first.sentence.lower()
    assert not [one.sentence for one in others for word in TO_DO if word in one.sentence]


def test_a_car_that_drives_little_of_the_lap_needs_more_than_training() -> None:
    slowly = [0.05 + 0.004 * k for k in range(29)]
    for own in (False, True):
        view = training(slowly)
        first = findings(replace(view, run=run_of(view)) if own else view)[0]
        assert "completion is 16% after 29 iterations, 4 points more than 10 iterations ago" in first.sentence
        assert "at this pace a whole lap is" in first.sentence
        assert "Keep training" not in first.sentence
        assert "`deepracer-exp validate" in first.sentence
        assert ("action_space.speed.high" in first.sentence) == own
    random = findings(training(slowly, entropy=[1.09] * 29))[0]
    assert "almost at random (99% of the highest), so raise the learning rate; lower" in random.sentence


def test_an_entropy_that_rises_is_named_with_its_cure_in_the_words_of_whoever_trained() -> None:
    fading = [*[1.0] * 10, *np.linspace(1.0, 0.4, 20)]
    rising = [*np.linspace(1.0, 0.4, 10), *np.linspace(0.4, 1.7, 20)]
    view = training(fading, entropy=rising)
    settings = {"beta_entropy": 0.01, "lr": 0.0003}
    view = prepare(replace(view.recording, hyperparameters=settings))
    first = findings(view)[0]
    assert first.rule == "entropy_rises"
    assert "with a lower entropy (now 0.01) or learning rate (now 0.0003)." in first.sentence
    own = findings(replace(view, run=run_of(view)))[0]
    assert "Clone checkpoint 10 (the best by " in own.sentence
    assert "with a lower algorithm.entropy_coeff (now 0.01) or algorithm.lr (now 0.0003)." in own.sentence
    sac = prepare(replace(view.recording, hyperparameters={"sac_alpha": 0.2}))
    for other in (sac, training([1.0] * 30, entropy=rising), training(fading, entropy=rising[::-1])):
        assert "entropy_rises" not in [one.rule for one in findings(other)]


def test_zig_zag_is_named_from_a_twentieth_of_a_second_a_lap_on() -> None:
    view = training(LEARNED)
    evaluations = pd.DataFrame(
        {"iteration": [10], "completion": 100.0, "zigzag_per_m": 2.0, "zigzag_deg": 9.0}
    )
    evaluations = evaluations.reindex(columns=list(EVALUATION_COLUMNS))
    for lost_s, named in ((0.04, False), (0.2, True)):
        own = replace(view, run=run_of(view, evaluations=evaluations.assign(zigzag_lost_s=lost_s)))
        assert ("zigzag" in [one.rule for one in findings(own)]) == named
    assert "an action space with smaller angles" in of(own, "zigzag").sentence


def chart_of(view: LogView, name: str) -> Chart:
    (draw,) = (one for some in SECTIONS.values() for one in some if one.__name__ == name)
    chart = draw(view)
    assert chart is not None
    return chart


def charts_of(view: LogView) -> list[Chart]:
    return [chart for some in draw_sections(LogPage(view, [])).values() for chart in some]


@pytest.mark.parametrize(
    "decision", [None, {"rule": "converged", "why": "it", "values": {}, "thresholds": {}}]
)
def test_the_figure_says_of_convergence_what_the_finding_says(decision) -> None:
    view = training([0.2] * LOG_RULE.patience)
    view = replace(view, run=None if decision is None else run_of(view, decision=decision))
    chart = chart_of(view, "training_progress")
    words = "too short to say" if decision is None else "stopping rule ended it"
    assert words in chart.caption
    assert words in of(view, "converged").sentence.lower()


def test_a_race_without_training_is_judged_by_its_laps() -> None:
    races = {"race": [Drive(speed_mps=v) for v in (1.5, 2.0, 1.8)]}
    view = prepare(made_up_recording([], evaluations=races))
    assert [one.rule for one in findings(view)] == ["time_lost", "chance"]
    assert of(view, "chance").sentence.startswith("3 of 3 episodes in the evaluations are complete laps")
    assert headline(view).startswith("No training; ")
    assert "3 complete laps, the fastest in 8.92 s" in headline(view)
    drawn = {chart.name for chart in charts_of(view)}
    assert "of the training" not in html(LogPage(view, findings(view)))
    assert {"lap_line", "sector_times", "speed_steering_by_waypoint", "lap_time_histogram"} <= drawn
    assert [row[:2] for row in best_laps(view).rows] == [("race", s) for s in ("8.92", "9.91", "11.87")]


def test_without_a_course_only_what_needs_its_shape_is_left_out() -> None:
    recording = laps_of((3, 4, 2.0)).recording
    steps = recording.steps.assign(X=recording.steps["X"] + 50.0, track="nowhere", closest_waypoint=0)
    view = prepare(replace(recording, steps=steps))
    assert view.course is None
    assert "nowhere" in str(view.problems[0])
    assert [one.rule for one in findings(view)] == ["converged", "runs_off", "steering", "submit", "chance"]


@given(
    at=st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=1, max_size=40),
    others=st.lists(st.floats(0.0, 1.0, exclude_max=True), min_size=1, max_size=40),
    within=st.floats(0.001, 0.4),
)
def test_places_off_the_road_are_counted_the_shorter_way_round(at, others, within):
    away = np.abs(np.array(at)[:, None] - np.array(others)[None, :])
    away = np.minimum(away, 1.0 - away)
    # At the very edge rounding decides.
    assume(not (np.abs(away - within) < 1e-12).any())
    counted = neighbours(np.array(at), np.array(others), within)
    assert counted.tolist() == (away <= within).sum(axis=1).tolist()
