import numpy as np
import pandas as pd
import pytest

from deepracer_exp.reports.tables.against_fastest import CAUSES, _in_sectors, by_cause
from deepracer_exp.tracks.sectors import sectors_of
from deepracer_exp.tracks.track import world_track

COURSE = world_track("reinvent_base")


def lap(speed_mps=2.0, aside_m=0.0, zigzag_m=0.0):
    """Return a lap beside the centre line at a steady speed, with a zig-zag of two control steps."""
    steps = int(COURSE.length_m / speed_mps * 15)
    pose = COURSE.start_pose(np.linspace(0.0, 0.999, steps))
    away_m = aside_m + zigzag_m * (-1.0) ** np.arange(steps)
    x_m, y_m = pose.x - away_m * np.sin(pose.yaw_rad), pose.y + away_m * np.cos(pose.yaw_rad)
    return pd.DataFrame({"time_s": np.arange(steps) / 15, "x_m": x_m, "y_m": y_m})


def lost(slower, faster):
    sectors = sectors_of(COURSE)
    return by_cause(_in_sectors(slower, sectors, COURSE), _in_sectors(faster, sectors, COURSE))


@pytest.mark.parametrize(
    ("slower", "cause"),
    [
        (lap(speed_mps=1.5), "speed"),
        (lap(zigzag_m=0.05), "steering"),
        # The outside of a course that is driven counter-clockwise.
        (lap(speed_mps=1.82, aside_m=-0.3), "line"),
    ],
    ids=["slower", "zig-zag", "outside"],
)
def test_the_cause_of_a_loss_is_found(slower, cause):
    assert lost(slower, lap()).sum().idxmax() == cause


def test_causes_and_sectors_add_up_to_the_whole_loss():
    slower, faster = lap(speed_mps=1.6, aside_m=-0.1, zigzag_m=0.02), lap()
    table = lost(slower, faster)
    assert list(table.columns) == list(CAUSES)
    whole = slower["time_s"].iloc[-1] - faster["time_s"].iloc[-1]
    assert table.to_numpy().sum() == pytest.approx(whole, abs=1e-9)


def test_time_that_the_car_stands_at_its_start_counts():
    faster = lap()
    waits = pd.concat([faster.iloc[[0] * 5], faster], ignore_index=True)
    waits["time_s"] = np.arange(len(waits)) / 15
    table = lost(waits, faster)
    assert table.sum().to_dict() == pytest.approx({"line": 0.0, "speed": 5 / 15, "steering": 0.0}, abs=1e-9)
    assert table.iloc[0].sum() == pytest.approx(5 / 15, abs=1e-9)


def test_a_lap_loses_nothing_to_itself():
    assert np.abs(lost(lap(), lap()).to_numpy()).max() < 1e-12
