"""Lines of laps and racing lines as files."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

from deepracer_exp.reports.tables.line_file import SUFFIXES, racing_line_table, recorded_line, write_line
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.tracks.track import world_track
from tests.conftest import refused

from .made_up import Drive, made_up_recording

FAST, SLOW, HALF = Drive(speed_mps=2.0, offset_m=0.1), Drive(speed_mps=1.6), Drive(until=0.5)


@pytest.fixture(scope="module")
def view() -> LogView:
    return prepare(made_up_recording([HALF, SLOW, FAST], name="log"))


def read_points(path: Path) -> np.ndarray:
    """Return x, y and, where it is known, the speed that a file has, (n, 3) or (n, 2)."""
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False)
    if path.suffix == ".csv":
        return pd.read_csv(path).drop(columns="progress").to_numpy()
    return np.array(runpy.run_path(str(path))["LINE"])


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(("episode", "drive"), [(None, FAST), (1, SLOW)])
def test_what_is_written_of_a_lap_are_its_rows(view, tmp_path, suffix, episode, drive):
    line, which = recorded_line(view, episode)
    points = read_points(write_line(tmp_path / f"line{suffix}", line))
    rows = view.steps[view.is_driven & (view.steps["episode"] == (2 if episode is None else episode))]
    np.testing.assert_array_equal(points[:, :2], rows[["X", "Y"]].to_numpy().round(4))
    assert np.median(points[:, 2]) == pytest.approx(drive.speed_mps, rel=0.1)
    assert which.startswith("the fastest lap") == (episode is None)
    assert f"episode {rows['episode'].iloc[0]}, " in which


def test_a_table_has_the_progress_of_the_rows(view, tmp_path):
    table = pd.read_csv(write_line(tmp_path / "line.csv", recorded_line(view, 1)[0]))
    assert list(table) == ["x_m", "y_m", "speed_mps", "progress"]
    rows = view.steps[view.is_driven & (view.steps["episode"] == 1)]
    np.testing.assert_array_equal(table["progress"], rows["progress"].to_numpy().round(4))


def test_a_line_has_numbers_only(tmp_path):
    recording = made_up_recording([FAST])
    steps = recording.steps
    steps.loc[10, "X"] = np.nan
    steps.loc[20, "tstamp"] = steps.loc[19, "tstamp"]
    line, _ = recorded_line(prepare(recording), None)
    points = read_points(write_line(tmp_path / "line.py", line))
    assert len(points) == len(steps) - 2  # without the prepare row and the one without a position
    assert np.isfinite(points).all()


def test_an_episode_that_is_no_complete_lap_is_refused_with_those_that_are(view):
    assert "is no complete lap; accepted: one of its 2 complete laps, the fastest first: 2, 1" in refused(
        recorded_line, view, 0
    )
    for missing in (3, 10**40):
        assert "is not there" in refused(recorded_line, view, missing)
    assert "has no complete lap" in refused(recorded_line, prepare(made_up_recording([HALF])), None)


NOT_BESIDE = ("AWS_track", "China_track", "Tokyo_Training_track")
"""Tracks where the border points of some waypoints are far ahead of them or behind."""


@pytest.mark.parametrize("name", [*NOT_BESIDE, "Straight_track", "reinvent_base"])
def test_the_racing_line_stays_on_the_road_from_waypoint_0_to_the_end(name):
    track = world_track(name)
    line = racing_line_table(track)
    points = line[["x_m", "y_m"]].to_numpy()
    assert shapely.dwithin(track.road, shapely.points(points), 1e-6).all()
    assert line["progress"].iloc[[0, -1]].tolist() == [0.0, 100.0]
    assert (line["progress"].diff()[1:] > 0).all()
    assert np.array_equal(points[0], points[-1]) == track.closed
