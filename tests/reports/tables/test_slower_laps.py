"""Laps that become slower are noticed, and laps that only scatter are not."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.recorded import METRICS_COLUMNS, Recording
from deepracer_exp.reports.charts.training_charts import training_progress
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.slower_laps import SERIES, SlowerLaps, slower_laps
from deepracer_exp.runs.recording import EVALUATION_COLUMNS, RunRecording
from deepracer_exp.runs.run_result import RunResult

from .made_up import Drive, made_up_recording, typed

EVERY = 10
SLOWED_S = [5.55, 5.70, 5.78, 5.92, 5.99, 6.21, 6.38, 6.34, 6.52, 6.40, 6.69, 6.61]
RETURNS = [223.0, 240, 268, 266, 271, 275, 276, 279, 280, 281, 284, 284]


def table(
    laps_s: list[float] | np.ndarray, returns: list[float] | np.ndarray, column: str = "eval_lap_time_s"
) -> pd.DataFrame:
    """Return iterations of which every tenth was evaluated, or, for exploring laps, each of them."""
    every = EVERY if column == "eval_lap_time_s" else 1
    iterations = pd.DataFrame({"iteration": np.arange(1, every * len(laps_s) + 1)})
    iterations = iterations.assign(reward_mean=np.repeat(np.asarray(returns, float), every))
    iterations[list(SERIES)] = np.nan
    iterations.loc[every - 1 :: every, column] = laps_s
    iterations["eval_lap_share"] = 1.0
    return iterations


def test_laps_that_rise_from_evaluation_to_evaluation_while_the_return_rises_are_blamed_on_the_reward() -> (
    None
):
    found = slower_laps(table(SLOWED_S, RETURNS))
    assert found is not None
    assert (found.laps, found.since, found.return_rose) == ("evaluated laps", 2 * EVERY, True)
    assert found.fastest_s == pytest.approx(np.mean(SLOWED_S[:3]))
    assert found.now_s == pytest.approx(np.mean(SLOWED_S[-3:]))
    assert str(found).startswith(
        "The evaluated laps became slower from iteration 20 on, from 5.68 to 6.57 s, while the return rose from "
    )
    assert "the reward function rewards it" in str(found)


def test_where_the_return_does_not_rise_the_reward_is_not_blamed() -> None:
    found = slower_laps(table(SLOWED_S, RETURNS[::-1]))
    assert found is not None
    assert not found.return_rose
    assert "the reward function" not in str(found)


@pytest.mark.parametrize(
    "laps_s",
    [
        SLOWED_S[::-1],
        [6.0] * 12,
        SLOWED_S[:7],  # too few to say
        [6.0 + 0.001 * k for k in range(12)],  # by less than counts
        [7.0, 6.5, 6.2, *[6.0] * 9],
        [*SLOWED_S[::-1], 5.6, 5.8],
    ],
)
def test_laps_that_did_not_become_slower_are_not_reported(laps_s: list[float]) -> None:
    assert slower_laps(table(laps_s, np.linspace(200, 280, len(laps_s)))) is None


def test_evaluated_laps_decide_whatever_the_exploring_laps_did() -> None:
    both = table([6.0] * 12, RETURNS)
    both["lap_time_mean_s"] = np.linspace(7.0, 9.0, len(both))
    assert slower_laps(both) is None
    found = slower_laps(both.assign(eval_lap_time_s=np.nan))
    assert found is not None
    assert found.laps == "exploring laps"
    few = both.assign(eval_lap_time_s=both["eval_lap_time_s"].where(both["iteration"] < 50))
    assert slower_laps(few) == found


def test_fast_laps_of_policies_that_often_fail_do_not_count() -> None:
    laps = table([5.0, 5.1, 5.05, *[6.0] * 12], np.linspace(200, 280, 15))
    assert slower_laps(laps.assign(eval_lap_share=np.where(laps["iteration"] <= 35, 0.875, 1.0))) is None
    ramp = table(SLOWED_S, RETURNS)
    assert slower_laps(ramp.assign(eval_lap_share=0.94)) is None


def scatter(rng: np.random.Generator, count: int, memory: float) -> np.ndarray:
    """Return noise of deviation 1 of which each value keeps a share of the one before."""
    values = rng.standard_normal(count)
    for k in range(1, count):
        values[k] = memory * values[k - 1] + np.sqrt(1 - memory**2) * values[k]
    return values


@pytest.mark.parametrize("column", SERIES)
@pytest.mark.parametrize("count", [8, 30])
@pytest.mark.parametrize("memory", [0.0, 0.3])
@pytest.mark.parametrize("learns", [False, True])
def test_at_most_one_of_twenty_histories_without_a_change_is_reported(
    column: str, count: int, memory: float, learns: bool
) -> None:
    rng, histories = np.random.default_rng(count), 40
    curve = 6.0 * (1 + 0.4 * learns * np.exp(-np.arange(count) / 3))
    reported = [
        slower_laps(table(curve + 0.15 * scatter(rng, count, memory), np.linspace(200, 280, count), column))
        for _ in range(histories)
    ]
    assert sum(found is not None for found in reported) <= 0.05 * histories


def test_most_trainings_that_lose_a_twentieth_of_their_speed_are_reported() -> None:
    rng, count = np.random.default_rng(1), 30
    curve = 6.0 * (1 + 0.075 * np.clip(np.arange(count) / count - 0.25, 0, None) / 0.75)
    found = [
        slower_laps(table(curve + 0.1 * rng.standard_normal(count), RETURNS[:1] * count)) for _ in range(100)
    ]
    assert sum(one is not None for one in found) >= 90


def slowing(**more: object) -> LogView:
    """Prepare a log whose laps become slower while the reward, which is progress, stays."""
    return prepare(replace(slowing_recording(), **more))


def slowing_recording() -> Recording:
    drives = [Drive(speed_mps=3.0 - 0.06 * k, iteration=k) for k in range(12) for _ in range(5)]
    return made_up_recording(drives)


def sentence(view: LogView) -> str:
    (found,) = (one for one in findings(view) if one.rule == "laps_slower")
    assert found.figure == "training_progress"
    return found.sentence


def test_a_log_without_evaluations_is_judged_by_its_exploring_laps_and_says_so() -> None:
    assert sentence(slowing()).startswith("The exploring laps became slower from iteration 1 on, from ")


def evaluated(times_s: list[float]) -> pd.DataFrame:
    rows = pd.DataFrame(
        {"iteration": range(len(times_s)), "time_s": times_s, "completion": 100.0, "resets": 0}
    )
    rows = rows.assign(stream="training", phase="evaluation", worker=0, episode=0, trial=1, reward=1.0)
    return typed(rows.assign(episode_status="Lap complete"), METRICS_COLUMNS)


def test_a_log_with_evaluations_is_judged_by_them() -> None:
    assert sentence(slowing(metrics=evaluated(SLOWED_S))).startswith(
        "The evaluated laps became slower from it"
    )
    assert not any(one.rule == "laps_slower" for one in findings(slowing(metrics=evaluated(SLOWED_S[::-1]))))


def own(times_s: list[float], recording: Recording | None = None, **more: object) -> LogView:
    """Prepare a run of ours with evaluations."""
    rows = pd.DataFrame({"iteration": range(len(times_s)), "lap_time_s": times_s})
    rows = rows.assign(completion=100.0, lap_share=1.0, held_out_completion=90.0)
    rows = rows.reindex(columns=list(EVALUATION_COLUMNS))
    best = RunResult(
        measure="race_score",
        rank=(1.0, -6.0),
        iteration=0,
        completion=100.0,
        held_out_completion=90.0,
        lap_time_s=times_s[0],
    )
    evaluations = typed(rows, EVALUATION_COLUMNS)
    recording = recording or slowing_recording()
    return prepare(RunRecording(recording=recording, evaluations=evaluations, best=best, **more))


def test_a_run_of_ours_names_the_checkpoint_to_take_instead() -> None:
    said = sentence(own(SLOWED_S))
    assert said.startswith("The evaluated laps became slower from iteration 1 on, from 5.68 to 6.57 s")
    assert said.endswith("Take checkpoint 0 (the best by race score (usual and held-out)).")


def test_laps_of_several_tracks_are_not_mixed() -> None:
    several = own(SLOWED_S[::-1], replace(slowing_recording(), track=None))
    assert several.iterations["eval_lap_time_s"].isna().all()
    assert sentence(several).startswith("The exploring laps")


def test_a_rule_that_ended_the_run_for_it_is_reported_once() -> None:
    decision = {"rule": "laps_slower", "why": "slower", "values": {}, "thresholds": {}}
    found = findings(own(SLOWED_S, decision=decision))
    assert [one.rule for one in found].count("laps_slower") == 0
    assert found[0].sentence.startswith("The run's stopping rule ended it (laps slower): slower. The reward")


def test_the_chart_shows_evaluated_and_exploring_laps_apart() -> None:
    chart = training_progress(own(SLOWED_S))
    assert chart is not None
    (panel,) = (panel for row in chart.rows for panel in row if panel.title == "Lap times")
    assert {"evaluated laps, mean", "exploring laps, mean"} <= {layer.get("name") for layer in panel.layers}


def test_nothing_is_said_of_a_table_without_laps() -> None:
    found: SlowerLaps | None = slower_laps(table([np.nan] * 12, RETURNS))
    assert found is None
