from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.aws.worlds.routes import read_route
from deepracer_exp.env.rule_passes import lap_progress
from deepracer_exp.tracks.track import Track

WHEELS_M = np.array([[0.082311, 0.0796], [0.082311, -0.0796], [-0.081663, 0.08105], [-0.081663, -0.08105]])
FRONT_M = np.array([0.14, 0.0])


def drive(ndist: list[float], start: float) -> Iterator[float]:
    previous = 0.0
    for at in ndist:
        shown, previous = lap_progress(at, start, previous)
        yield shown


@given(start=st.floats(0, 0.999), steps=st.lists(st.floats(0.0001, 0.3), max_size=30))
def test_progress_never_falls_on_the_way_forward_and_ends_at_100(start, steps):
    travelled = np.cumsum([0.001, *steps])
    shown = list(drive([(start + t) % 1.0 for t in travelled[travelled < 1]], start))
    np.testing.assert_allclose(shown, 100 * travelled[travelled < 1], atol=1e-9)


def test_rolling_back_over_the_start_gives_negative_progress():
    assert list(drive([0.201, 0.199, 0.15], 0.2)) == pytest.approx([0.1, -0.1, -5.0])
    assert list(drive([0.001, 0.999], 0.0)) == pytest.approx([0.1, -0.1])


def test_the_lap_closes_at_100_and_the_next_one_begins_at_0():
    assert list(drive([0.4, 0.8, 0.1, 0.3], 0.1)) == pytest.approx([30.0, 70.0, 100.0, 20.0])


@pytest.fixture(scope="module")
def recording(reference: Path) -> pd.DataFrame:
    folder = reference / "console_training/sim-trace/training/training-simtrace"
    rows = pd.concat([pd.read_csv(path) for path in folder.glob("*.csv")])
    return rows.sort_values(["episode", "steps"], kind="stable").reset_index(drop=True)


@pytest.fixture(scope="module")
def published(reference: Path) -> Track:
    return Track.from_route(read_route(reference / "routes/reinvent_base.npy"), "reinvent_base")


def test_every_recorded_progress_is_reproduced(recording, published):
    found = published.project(recording[["X", "Y"]].to_numpy())
    assert len(recording) == 44_247
    # The service moves the start by 0.05 after every episode; the first row shows by how much so far.
    start = recording.assign(at=found.ndist).groupby("episode")[["at", "progress"]].transform("first")
    start_ndist = np.round((start["at"] - start["progress"] / 100).to_numpy() * 20) / 20 % 1
    shown = np.empty(len(recording))
    previous = np.zeros(recording["episode"].max() + 1)
    for row, episode in enumerate(recording["episode"]):
        shown[row], previous[episode] = lap_progress(found.ndist[row], start_ndist[row], previous[episode])
    np.testing.assert_allclose(shown, recording["progress"], rtol=0, atol=1e-11)


def test_every_recorded_closest_waypoint_and_length_is_reproduced(recording, published):
    points = recording[["X", "Y"]].to_numpy()
    found = published.project(points)
    behind = np.linalg.norm(published.waypoints[found.previous] - points, axis=1)
    ahead = np.linalg.norm(published.waypoints[found.next] - points, axis=1)
    closest = np.where(behind <= ahead, found.previous, found.next)
    np.testing.assert_array_equal(closest, recording["closest_waypoint"])
    assert (recording["track_len"] == published.length_m).all()


def test_recorded_wheels_are_on_the_road_when_the_service_says_so(recording, published):
    """4 and 2 rows differ: the wheels are rebuilt flat, and the real car leans."""
    yaw = np.radians(recording["yaw"].to_numpy())
    rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    wheels = (
        np.einsum("ijn,wj->nwi", rotation, WHEELS_M - FRONT_M) + recording[["X", "Y"]].to_numpy()[:, None]
    )
    on_road = published.on_road(wheels.reshape(-1, 2)).reshape(-1, 4)
    assert (on_road.all(axis=1) != recording["all_wheels_on_track"]).sum() <= 4
    assert (~on_road.any(axis=1) != (recording["episode_status"] == "off_track")).sum() <= 2
