"""The analysis of a training of the AWS console: the figures that deepracer-utils and the service give."""

import contextlib
import io

import numpy as np
import pandas as pd
import pytest
from deepracer.logs import AnalysisUtils, DeepRacerLog

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.tables.log_view import LogView, prepare

from .conftest import CONSOLE

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
def theirs(console: LogView) -> pd.DataFrame:
    """What deepracer-utils makes of the training, where there is one."""
    log = DeepRacerLog(model_folder=str(CONSOLE))
    with contextlib.redirect_stdout(io.StringIO()):  # it prints what it does
        log.load_training_trace()
        return AnalysisUtils.simulation_agg(log.dataframe(), secondgroup="unique_episode")


def test_episodes_equal_those_of_deepracer_utils(theirs: pd.DataFrame) -> None:
    traces = prepare(read_recording(CONSOLE / "sim-trace" / "training"))
    ours = traces.episodes[list(SAME.values())].to_numpy(np.float64)
    np.testing.assert_allclose(ours, theirs[list(SAME)].to_numpy(np.float64), rtol=1e-12)
    assert traces.episodes["quintile"].tolist() == [int(word[0]) for word in theirs["quintile"]]


def test_iterations_equal_the_means_of_deepracer_utils_episodes(
    console: LogView, theirs: pd.DataFrame
) -> None:
    groups = theirs.groupby("iteration")
    traced = console.episodes[console.episodes["iteration"] < 28]
    laps = traced[traced["complete"]].groupby("iteration")["lap_time_s"]
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
    ours = console.iterations.set_index("iteration").loc[:27, list(expected)]
    np.testing.assert_allclose(ours.to_numpy(np.float64), expected.to_numpy(np.float64), rtol=1e-12)


def test_laps_course_and_evaluations_are_those_that_the_service_reports(console: LogView) -> None:
    # The text log has the iteration in which the job ended, too: 595 steps, three finished episodes and one lap.
    assert len(console.steps) == 44_247 + 595
    assert console.episodes["complete"].sum() == console.episodes["lap_time_s"].notna().sum() == 47 + 1
    assert console.judged["iteration"].max() == 27
    assert (console.course.name, console.course.reversed) == ("reinvent_base", False)
    # Where the rear axle really is, it moves where it looks.
    assert console.steps["slide_deg"].abs().median() < 0.2
    evaluated = console.iterations["eval_completion"]
    assert evaluated.iloc[:28].notna().all()
    assert evaluated.iloc[0] == pytest.approx(3.4)
    assert evaluated.iloc[22:28].tolist() == [100.0] * 6
    races = console.evaluation_episodes[console.evaluation_episodes["stream"].str.startswith("leaderboard")]
    assert len(races) == 6
    assert races["lap_time_s"].between(15.0, 17.5).all()


def test_a_checkpoint_that_no_log_names_is_named_by_the_steps_before_it(console: LogView) -> None:
    traces = read_recording(CONSOLE / "sim-trace" / "training")
    logged = console.recording.checkpoints
    assert traces.checkpoints == {number: logged[number] for number in range(29)}


def test_findings_name_the_iteration_and_the_places_that_the_tables_show(console: LogView) -> None:
    found = {one.rule: one for one in findings(console)}
    assert set(found) == {"converged", "submit", "chance", "time_lost", "runs_off", "steering"}
    assert next(iter(found)) == "converged"
    assert found["converged"].sentence.startswith("Not converged yet")
    assert found["converged"].sentence.endswith("Keep training: clone the model as it is.")
    assert "checkpoint 25_Step-33002, which drove iteration 25" in found["submit"].sentence
    assert found["chance"].values["laps"] == 48
    assert found["time_lost"].values["theoretical_best_s"] < found["time_lost"].values["best_lap_s"]
