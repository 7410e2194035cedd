"""The analysis of a training of the AWS console: the figures that deepracer-utils and the service give."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from deepracer.logs import AnalysisUtils, DeepRacerLog

from deepracer_exp.analysis.findings import findings
from deepracer_exp.analysis.log_view import LogView, prepare
from deepracer_exp.deepracer.recording_reader import read_recording

CONSOLE = Path(__file__).parents[3] / "shared" / "reference" / "console_training"
pytestmark = pytest.mark.skipif(not CONSOLE.is_dir(), reason="no recorded training of the console is there")

SAME = {
    "iteration": "iteration",
    "unique_episode": "episode",
    "steps": "steps",
    "start_at": "start_at",
    "progress": "progress",
    "time": "time_s",
    "dist": "dist_m",
    "speed": "speed_mps",
    "reward": "reward",
    "time_if_complete": "time_if_complete_s",
    "reward_if_complete": "reward_if_complete",
    "complete": "complete",
}
"""Columns of deepracer-utils' `simulation_agg` and of `EPISODE_COLUMNS`."""


@pytest.fixture(scope="module")
def view() -> LogView:
    return prepare(read_recording(CONSOLE))


@pytest.fixture(scope="module")
def theirs() -> pd.DataFrame:
    log = DeepRacerLog(model_folder=str(CONSOLE))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints what it does
        log.load_training_trace()
        return AnalysisUtils.simulation_agg(log.dataframe(), secondgroup="unique_episode")


def test_episodes_equal_those_of_deepracer_utils(view: LogView, theirs: pd.DataFrame) -> None:
    ours = view.episodes[list(SAME.values())].to_numpy(np.float64)
    np.testing.assert_allclose(ours, theirs[list(SAME)].to_numpy(np.float64), rtol=1e-12)
    assert view.episodes["quintile"].tolist() == [int(word[0]) for word in theirs["quintile"]]


def test_iterations_equal_the_means_of_deepracer_utils_episodes(view: LogView, theirs: pd.DataFrame) -> None:
    groups = theirs.groupby("iteration")
    laps = theirs[theirs["complete"].astype(bool)].groupby("iteration")["time"]
    expected = pd.DataFrame(
        {
            "completion_mean": groups["progress"].mean(),
            "lap_share": groups["complete"].mean(),
            "reward_mean": groups["reward"].mean(),
            "lap_time_mean_s": laps.mean(),
            "lap_time_best_s": laps.min(),
            "lap_time_p25_s": laps.quantile(0.25),
        }
    )
    ours = view.iterations.set_index("iteration")[list(expected)]
    np.testing.assert_allclose(ours.to_numpy(np.float64), expected.to_numpy(np.float64), rtol=1e-12)


def test_laps_course_and_evaluations_are_those_that_the_service_reports(view: LogView) -> None:
    assert len(view.steps) == 44_247
    assert view.episodes["complete"].sum() == view.episodes["lap_time_s"].notna().sum() == 47
    assert round(view.episodes["lap_time_s"].min(), 2) == 14.13
    assert (view.course.name, view.course.reversed) == ("reinvent_base", False)
    # Where the rear axle really is, it moves where it looks.
    assert view.steps["slide_deg"].abs().median() < 0.2
    evaluated = view.iterations["eval_completion"]
    assert evaluated.notna().all()
    assert evaluated.iloc[0] == pytest.approx(3.4)
    assert evaluated.iloc[-6:].tolist() == [100.0] * 6
    races = view.evaluation_episodes[view.evaluation_episodes["stream"].str.startswith("leaderboard")]
    assert len(races) == 6
    assert races["lap_time_s"].between(15.0, 17.5).all()


def test_a_checkpoint_that_no_log_names_is_named_by_the_steps_before_it(view: LogView) -> None:
    traces = read_recording(CONSOLE / "sim-trace" / "training")
    logged = view.recording.checkpoints
    assert traces.checkpoints == {number: logged[number] for number in range(28)}


def test_findings_name_the_iteration_and_the_places_that_the_tables_show(view: LogView) -> None:
    found = {one.rule: one for one in findings(view)}
    assert set(found) == {"converged", "submit", "chance", "time_lost", "runs_off", "steering", "overfits"}
    assert found["converged"].sentence.startswith("Not converged yet")
    assert "checkpoint 25_Step-33002, which drove iteration 25" in found["submit"].sentence
    assert found["chance"].values["laps"] == 47
    assert found["time_lost"].values["theoretical_best_s"] < found["time_lost"].values["best_lap_s"]
    assert found["overfits"].sentence.startswith("No sign of overfitting")
