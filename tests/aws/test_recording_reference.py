"""What the real service wrote is read as it was written."""

import math
import tarfile

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import Recording
from tests.conftest import REFERENCE

CONSOLE = REFERENCE / "console_training"
pytestmark = pytest.mark.skipif(not CONSOLE.is_dir(), reason=f"no recordings at {CONSOLE}")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording(CONSOLE)


@pytest.fixture(scope="module")
def training(recording) -> pd.DataFrame:
    """The rows of the CSVs: of the iteration in which the job ended there is none."""
    steps = recording.steps
    return steps[(steps["stream"] == "training") & (steps["iteration"] < 28)]


@pytest.fixture(scope="module")
def from_log() -> pd.DataFrame:
    return read_recording(CONSOLE / "logs/training").steps


def test_the_training_has_all_its_rows_iterations_episodes_and_laps(training):
    assert len(training) == 44_247
    assert training["iteration"].unique().tolist() == list(range(28))
    assert training["episode"].unique().tolist() == list(range(560))
    assert (training.groupby("episode")["progress"].max() == 100).sum() == 47


def test_the_best_lap_took_what_the_service_says(recording, training):
    time_s = training.groupby("episode")["tstamp"].agg(lambda of: of.max() - of.min())
    laps = time_s[training.groupby("episode")["progress"].max() == 100]
    assert laps.min() == pytest.approx(14.13, abs=0.01)
    logged = recording.metrics[
        (recording.metrics["phase"] == "training") & (recording.metrics["completion"] == 100)
    ]
    assert sorted(logged.loc[logged["episode"] < 560, "episode"]) == sorted(laps.index)


def test_the_text_log_reports_the_same_rows_and_the_iteration_that_was_not_finished(
    recording, training, from_log
):
    finished = from_log[from_log["iteration"] < 28]
    assert (len(finished), len(from_log)) == (44_247, 44_842)
    for name in ("episode", "steps", "iteration", "tstamp", "done", "closest_waypoint", "action"):
        np.testing.assert_array_equal(finished[name], training[name])
    assert (finished["episode_status"].astype(str).to_numpy() == training["episode_status"].astype(str)).all()
    for name in ("X", "Y", "yaw", "progress"):
        assert np.abs(finished[name].to_numpy() - training[name].to_numpy()).max() <= 6e-5
    assert recording.problems == ()
    last = recording.steps[recording.steps["iteration"] == 28]
    assert (len(last), last["episode"].min(), last["episode"].max()) == (595, 560, 563)


def test_the_entropy_begins_at_that_of_a_uniform_policy(recording):
    updates = recording.updates
    assert len(updates) == 84
    assert updates["iteration"].unique().tolist() == list(range(28))
    assert updates["entropy"].iloc[0] == pytest.approx(math.log(14), rel=0.01)
    assert set(updates["lr"]) == {0.0003}


def test_metrics_and_trace_report_the_same_episodes(recording, training):
    logged = recording.metrics[
        (recording.metrics["stream"] == "training") & (recording.metrics["phase"] == "training")
    ]
    logged = logged[logged["episode"] < 560].set_index("episode")
    driven = training.groupby("episode", observed=True)
    assert logged.index.tolist() == list(driven.groups)
    # The service rounds to whole numbers and counts from the moment of the release.
    assert np.abs(logged["reward"] - driven["reward"].sum()).max() <= 1
    assert np.abs(logged["completion"] - driven["progress"].max()).max() <= 1
    assert (logged["episode_status"].astype(str) == driven["episode_status"].last().astype(str)).all()
    duration_s = driven["tstamp"].max() - driven["tstamp"].min()
    assert np.abs(logged["time_s"] - duration_s).max() < 0.2


def test_evaluations_and_races_stand_beside_the_training(recording):
    sizes = recording.steps.groupby("stream", observed=True, sort=False).size().to_dict()
    assert next(iter(sizes)) == "training"
    assert sorted(list(sizes.values())[1:]) == [725, 735, 737, 742]
    assert sum(name.startswith("leaderboard") for name in sizes) == 2
    logged = recording.metrics[recording.metrics["stream"] != "training"]
    assert logged.groupby("stream", observed=True).size().tolist() == [3, 3]
    assert set(logged["stream"]) <= set(sizes)


def test_settings_are_those_of_the_training(recording):
    assert recording.track == "reinvent_base"
    assert set(recording.steps["track"]) == {"reinvent_base"}
    assert len(recording.metadata.actions) == 14
    assert recording.hyperparameters["discount_factor"] == 0.95
    assert recording.hyperparameters["num_epochs"] == 3


@pytest.mark.slow
def test_the_archive_of_the_folder_reports_the_same(recording, tmp_path):
    path = tmp_path / "logs.tar.gz"
    with tarfile.open(path, "w:gz", compresslevel=1) as archive:
        archive.add(CONSOLE, "EHNgTNY2T9")
    packed = read_recording(path)
    for name in ("steps", "updates", "metrics"):
        pd.testing.assert_frame_equal(getattr(packed, name), getattr(recording, name))
    assert len(packed.files) == len(recording.files)
