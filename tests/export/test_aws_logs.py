"""A run's logs as the service writes them, read by the racers' own tool, deepracer-utils."""

import json

import numpy as np
import pandas as pd
import pytest
from deepracer.logs import AnalysisUtils, DeepRacerLog, LogFolderType, TrainingMetrics

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.runs.trace import read_trace

RENAMED = {
    "X": "x",
    "Y": "y",
    "steer": "steering_angle",
    "throttle": "speed",
    "all_wheels_on_track": "on_track",
}
EXACT = ("steps", "x", "y", "yaw", "steering_angle", "speed", "reward", "done", "on_track",
         "progress", "closest_waypoint", "track_len", "tstamp", "episode_status", "pause_duration",
         "action", "iteration")  # fmt: skip
ROUNDED = {
    "x": 4,
    "y": 4,
    "yaw": 4,
    "steering_angle": 2,
    "speed": 2,
    "reward": 4,
    "progress": 4,
    "track_len": 2,
}
LONGER = ("algorithm.frames_per_iteration=4096", "budget.env_steps=16384", "action_space=discrete")
LAYOUTS = {
    "console": LogFolderType.CONSOLE_MODEL_WITH_LOGS,
    "deepracer-for-cloud": LogFolderType.DRFC_MODEL_SINGLE_WORKERS,
}


@pytest.fixture(scope="module")
def run(trained):
    return trained(*LONGER)


@pytest.fixture(scope="module")
def export(call_at, tmp_path_factory):
    """Export a run; return the folder and what the command said."""

    def go(folder, layout: str):
        to = tmp_path_factory.mktemp("exported") / "logs"
        ended = call_at(
            to.parent, "export", str(folder), "format=aws-logs", f"layout={layout}", "-o", str(to)
        )
        assert ended.code == 0, ended.stderr
        return to, ended.stdout

    return go


@pytest.fixture(scope="module")
def exported(run, export):
    return {layout: export(run.folder, layout) for layout in LAYOUTS}


@pytest.fixture(scope="module")
def ours(run) -> pd.DataFrame:
    """Our trace's rows of episodes that ended, with the iteration in which they did."""
    rows = read_trace(run.folder / "trace").rename(columns=RENAMED)
    rows["ended"] = rows.groupby("episode")["done"].transform("any")
    rows["iteration"] = rows.groupby("episode")["iteration"].transform("max")
    rows = rows[rows["ended"]]
    rows["iteration"] -= rows["iteration"].min()
    return rows.sort_values(["iteration", "episode", "steps"], kind="stable", ignore_index=True)


def loaded(folder, layout: str, caplog) -> DeepRacerLog:
    log = DeepRacerLog(model_folder=str(folder))
    assert log.fh.type == LAYOUTS[layout]
    log.load_training_trace()
    # It warns of what it misses.
    assert not [record for record in caplog.records if record.name.startswith("deepracer.")]
    return log


@pytest.fixture(params=LAYOUTS)
def log(request, exported, caplog) -> DeepRacerLog:
    """What deepracer-utils loads from a layout."""
    return loaded(exported[request.param][0], request.param, caplog)


def test_deepracer_utils_loads_the_rows_of_our_trace(ours, log):
    theirs = log.dataframe()
    assert len(theirs) == len(ours) > 1000
    for name in EXACT:
        assert theirs[name].tolist() == ours[name].tolist(), name


def test_deepracer_utils_counts_our_episodes(ours, log):
    episodes = AnalysisUtils.simulation_agg(
        log.dataframe(), firstgroup="iteration", secondgroup="unique_episode"
    )
    own = ours.groupby(["iteration", "episode"], sort=True)
    assert episodes["iteration"].tolist() == [iteration for iteration, _ in own.groups]
    assert episodes["steps"].tolist() == own.size().tolist()
    np.testing.assert_allclose(episodes["reward"], own["reward"].sum(), rtol=1e-12)
    np.testing.assert_allclose(episodes["time"], own["tstamp"].agg(lambda s: s.max() - s.min()), atol=1e-9)
    assert episodes["progress"].tolist() == own["progress"].max().tolist()
    assert episodes["unique_episode"].is_unique


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_metrics_file_counts_an_episode_from_its_reset(ours, exported, layout):
    (file,) = (exported[layout][0] / "metrics").rglob("*.json")
    items = [item for item in json.loads(file.read_text())["metrics"] if item["phase"] == "training"]
    steps = ours.groupby(["iteration", "episode"], sort=True).size().to_numpy()
    elapsed_ms = [item["elapsed_time_in_milliseconds"] for item in items]
    np.testing.assert_allclose(elapsed_ms, steps * 1000 / 15, atol=1.0)


def test_deepracer_utils_finds_hyperparameters_and_action_space(ours, log):
    per_iteration = ours.groupby("iteration")["episode"].nunique().max()
    assert log.hyperparameters()["num_episodes_between_training"] == per_iteration
    # As trained, though the console takes no such values.
    assert log.hyperparameters()["batch_size"] == 256
    assert log.action_space()[0] == {"steering_angle": -30.0, "speed": 1.0, "index": 0}
    assert log.agent_and_network()["sensor_list"] == ["FRONT_FACING_CAMERA"]


def test_deepracer_utils_loads_the_text_log_as_it_loads_the_trace(exported, caplog):
    folder, _ = exported["console"]
    trace = loaded(folder, "console", caplog)
    log = DeepRacerLog(model_folder=str(folder))
    log.load()
    lines, rows = log.dataframe(), trace.dataframe()
    assert len(lines) == len(rows)
    assert lines["unique_episode"].tolist() == rows["unique_episode"].tolist()
    for name in ("iteration", "steps", "action", "done", "on_track", "tstamp", "episode_status"):
        assert lines[name].tolist() == rows[name].tolist(), name
    for name, digits in ROUNDED.items():
        np.testing.assert_allclose(lines[name], rows[name], rtol=0, atol=0.51 * 10**-digits, err_msg=name)
    assert log.hyperparameters() == trace.hyperparameters()
    assert log.action_space() == trace.action_space()
    assert log.agent_and_network()["world"] == "reinvent_base"


def test_deepracer_utils_measures_the_control_period(exported, caplog):
    log = loaded(exported["console"][0], "console", caplog)
    assert log.stability.analyze()["avg_ms"].tolist() == pytest.approx(
        [1000 / 15] * log.dataframe()["iteration"].nunique(), abs=0.1
    )


@pytest.mark.parametrize(
    ("layout", "pattern"),
    [
        ("console", "metrics/training/training-*.json"),
        ("deepracer-for-cloud", "metrics/TrainingMetrics.json"),
    ],
)
def test_deepracer_utils_loads_the_metrics(run, ours, exported, layout, pattern, monkeypatch):
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")  # it makes a client of S3 even for a file
    (file,) = exported[layout][0].glob(pattern)
    metrics = TrainingMetrics(None, fname=str(file))
    own = ours.groupby(["iteration", "episode"])
    training = metrics.getTraining()
    assert training["iteration"].tolist() == [iteration for iteration, _ in own.groups]
    assert training["reward"].tolist() == [round(reward) for reward in own["reward"].sum()]
    assert training["complete"].sum() == (ours["episode_status"] == "lap_complete").sum()
    evaluated = [row for row in run.metrics if row["eval_completion"] is not None]
    tried = metrics.getEvaluation()
    # What an update has changed drives the next iteration, after which the service evaluates it.
    driven = [row for row in evaluated if row["iteration"] <= training["iteration"].max()]
    assert tried["iteration"].tolist() == [row["iteration"] for row in driven]
    assert tried["completion"].tolist() == [int(row["eval_completion"]) for row in driven]


def test_the_trainers_log_has_a_line_for_each_update(run, exported):
    (file,) = exported["console"][0].glob("logs/training/*-sagemaker.log")
    lines = [line for line in file.read_text().splitlines() if line.startswith("Policy training>")]
    assert len(lines) == len(run.metrics)
    assert f"Entropy={run.metrics[-1]['entropy']}, training epoch=0" in lines[-1]
    assert f"KL divergence={run.metrics[-1]['kl']}, " in lines[-1]


def test_what_is_left_out_is_reported(run, ours, exported):
    _, said = exported["console"]
    missing = len(read_trace(run.folder / "trace", ["steps"])) - len(ours)
    assert f"{missing:,} rows of unfinished episodes are left out" in said


def test_a_continuous_policy_with_lidar_writes_its_commands_and_sensors(trained, export, caplog):
    run = trained("algorithm.frames_per_iteration=2048", "budget.env_steps=4096", "observation=lidar")
    folder, _ = export(run.folder, "deepracer-for-cloud")
    theirs = loaded(folder, "deepracer-for-cloud", caplog).dataframe()
    assert set(theirs["action"]) == {-1}
    first = next((folder / "training-simtrace").glob("*.csv")).read_text().splitlines()[1].split(",")
    steer, throttle = first[7].strip("[]").split()
    assert [steer, throttle] == [first[5], first[6]]
    back = read_recording(folder)
    assert back.problems == ()
    assert len(back.steps) == len(theirs)
    assert back.steps["action"].isna().all()
    assert back.metadata.sensor == ("FRONT_FACING_CAMERA", "LIDAR")


def test_our_own_reader_finds_in_the_files_what_the_run_had(run, ours, exported):
    back = read_recording(exported["console"][0])
    assert back.problems == ()
    assert len(back.steps) == len(ours)
    for name in ("reward", "progress", "tstamp", "iteration"):
        assert back.steps[name].tolist() == ours[name].tolist()
    assert back.updates["entropy"].tolist() == [row["entropy"] for row in run.metrics]
    assert back.reward_source == (run.folder / "reward_function.py").read_text()


def test_a_folder_that_is_not_empty_is_refused(run, call, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    ended = call("export", str(run.folder), "format=aws-logs", "-o", "full")
    ended.assert_bad_input("full: is not empty; accepted: a new or an empty folder")


def test_the_files_of_the_model_are_those_of_the_run(run, exported):
    for layout in LAYOUTS:
        folder, _ = exported[layout]
        assert (folder / "reward_function.py").read_text() == (run.folder / "reward_function.py").read_text()
        assert len(json.loads((folder / "model/model_metadata.json").read_text())["action_space"]) == 15
