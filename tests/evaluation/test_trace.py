"""The trace of an evaluation: crashes and pauses as the service writes them, and where the others were."""

import numpy as np
import pyarrow.parquet as pq
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.others.placement import rebuild_poses
from deepracer_exp.env.trace_columns import STATUS_CODE
from deepracer_exp.errors import BadInput
from deepracer_exp.evaluation.evaluator import Evaluator
from deepracer_exp.evaluation.trace_recorder import TraceRecorder, pauses_left_s
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.log_report import LogPage, draw_sections
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.runs.recording import read_log
from deepracer_exp.runs.trace import EVALUATION_OTHERS

from .conftest import Driver


def test_a_penalty_counts_down_from_the_row_in_which_it_is_given():
    words = ["in_progress", "crashed", "pause", "pause", "in_progress", "off_track", "pause"]
    status = np.array([STATUS_CODE[word] for word in words], np.float64)
    # The end of the race cuts the penalty of the second trial off.
    episode = np.array([0.0, 0, 0, 0, 0, 1, 1])
    left_s = pauses_left_s(status, episode, {"crashed": 1.0, "off_track": 2.0}, 0.5)
    assert left_s.tolist() == [0, 1.0, 0.5, 0, 0, 2.0, 1.5]


@pytest.mark.parametrize("race", ["time_trial", "head_to_bot"])
def test_each_lap_of_a_trial_is_an_episode_with_its_time_and_each_condition_has_a_folder(
    circle, protocol, tmp_path, race
):
    overrides = [
        f"track.file={circle}",
        "action_space=continuous",
        f"race={race}",
        "race.bots.min_distance_m=1",
        "observation.next_objects=2",
    ]
    experiment = compose_experiment(overrides)[0]
    config = protocol("three_trials", trials=2, laps=2, time_s=60.0, held_out="sim2real")
    evaluator, recorder = Evaluator(experiment, config, threads=1), TraceRecorder(config)
    evaluation = evaluator(Driver(experiment), recorder)
    files = recorder.write(tmp_path / "trace", evaluator)
    for group in evaluation.groups:
        folder = tmp_path / "trace" / group.condition
        assert {file for file in files if folder in file.parents} == {
            file for file in folder.rglob("*") if file.is_file()
        }
        view = prepare(read_log(folder))
        laps = sorted(group.attempts, key=lambda lap: (lap.trial, lap.begin_s))
        assert len(laps) == 4 or group.condition == "held_out" or race == "head_to_bot"
        laps_s = [lap.time_s if lap.complete and not lap.resets else np.nan for lap in laps]
        np.testing.assert_allclose(view.episodes["lap_time_s"], laps_s, atol=1e-3)
        if race == "head_to_bot":
            placed = read_log(folder).others.episodes[False]
            trials = {lap.trial for lap in laps}
            assert (len(placed), len({one.seed for one in placed.values()})) == (len(laps), len(trials))


def test_the_steps_of_an_evaluation_are_written_and_every_pose_of_the_others_is_rebuilt(protocol, tmp_path):
    options = (
        "race=head_to_bot",
        "race.boxes.number=4",
        "observation.next_objects=1",
        "action_space=continuous",
    )
    experiment = compose_experiment(["track=reInvent2019_track", *options])[0]
    config = protocol("object_avoidance", trials=2, time_s=20.0)
    evaluator = Evaluator(experiment, config, threads=1)
    recorder, poses = TraceRecorder(config), []

    def record(race, running, acted):
        recorder(race, running, acted)
        poses.append(race.others.others.poses.copy())

    evaluation = evaluator(Driver(experiment), record)
    recorder.write(tmp_path / "trace", evaluator)
    read = read_recording(tmp_path / "trace")
    assert read.problems == ()
    steps = read.steps.sort_values(["episode", "steps"], kind="stable")
    assert steps["stream"].nunique() == 1
    status = steps["episode_status"].astype(str).to_numpy()
    crashes = sum(attempt.crashes for attempt in evaluation.groups[0].attempts)
    assert (status == "crashed").sum() == crashes > 0
    after = np.flatnonzero(status == "crashed")
    assert (status[after + 1] == "pause").all()
    left_s = steps["pause_duration"].to_numpy()
    np.testing.assert_allclose(left_s[after], 5.0)
    np.testing.assert_allclose(left_s[after + 1], 5.0 - experiment.car.control_period_s)
    assert (steps["pause_duration"].to_numpy()[status == "in_progress"] == 0).all()
    assert (steps["reward"] == 0).all()
    log = read_log(tmp_path / "trace")
    assert log.others.race == experiment.race
    placed = log.others.episodes[False]
    episode, step = (steps[name].to_numpy(np.intp) for name in ("episode", "steps"))
    rebuilt, _ = rebuild_poses(
        experiment.race,
        evaluator.race.setup.track,
        [placed[number] for number in sorted(placed)],
        experiment.car.control_period_s,
        episode,
        step.astype(np.int64),
    )
    np.testing.assert_array_equal(rebuilt, np.array(poses)[step - 1, episode])
    view = prepare(log)
    assert len(view.others.crashes) == crashes
    assert view.others.names[3:5] == ("box 4", "bot 1")
    (found,) = [finding for finding in findings(view) if finding.rule == "costs_most"]
    assert found.sentence.startswith("In the evaluations: ")
    drawn = {chart.name for some in draw_sections(LogPage(view, [])).values() for chart in some}
    assert {"crashes_by_object", "crash_places"} <= drawn
    np.testing.assert_allclose(view.others_at(view.steps[view.steps["episode"] == 1])[0], poses[0][1, :, :2])
    # Without the file beside it, nothing says who was there; with another in its place, that is said.
    file = tmp_path / "trace" / EVALUATION_OTHERS
    plain = pq.read_table(file).replace_schema_metadata(None)
    pq.write_table(plain, file)
    with pytest.raises(BadInput, match="does not say among whom"):
        read_log(tmp_path / "trace")
    file.unlink()
    assert prepare(read_log(tmp_path / "trace")).others is None
