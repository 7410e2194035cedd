import json

import numpy as np
import pytest

from benchmarks import lap_bounds
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.tracks.track import Track

CAR = compose_experiment(["car=deepracer_v5"])[0].car


@pytest.fixture(scope="module")
def turns() -> lap_bounds.Cornering:
    return lap_bounds.cornering(CAR)


def ring(radius_m: float, width_m: float) -> Track:
    angle = np.linspace(0, 2 * np.pi, 121)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radii = (radius_m, radius_m - 0.5 * width_m, radius_m + 0.5 * width_m)
    return Track.from_route(np.concatenate([unit * radius for radius in radii], axis=1), "ring")


def test_tighter_turns_are_slower_and_nothing_is_faster_than_the_wheels(turns):
    speeds = turns.speed_at(np.linspace(0.0, 2.0, 50))
    assert (np.diff(speeds) <= 0).all()
    assert 3.0 < speeds[0] < 3.7


def test_a_ring_is_driven_along_its_inner_border_at_the_speed_of_its_curvature(turns):
    inside_m = 3.0 - 0.3 - CAR.rear_wheel_y_m
    bound_s = lap_bounds.bound_s(ring(3.0, 0.6), CAR, turns)
    assert bound_s == pytest.approx(2 * np.pi * inside_m / turns.speed_at(np.array(1 / inside_m)), rel=0.02)


def test_a_wider_road_is_never_slower(turns):
    narrow, wide = (lap_bounds.bound_s(ring(2.0, width), CAR, turns) for width in (0.4, 1.0))
    assert wide < narrow


def test_only_time_trials_of_the_fast_era_count(tmp_path, capsys):
    file = tmp_path / "boards.csv"
    file.write_text(
        "world,race_type,date,best_lap_s\n"
        "reInvent2019_track,TIME_TRIAL,2019-10-01,1.0\n"
        "reInvent2019_track,TIME_TRIAL,2020-11-01,7.5\n"
        "reInvent2019_track,OBJECT_AVOIDANCE,2020-11-01,2.0\n"
        "elsewhere,TIME_TRIAL,2020-11-01,9.0\n"
    )
    assert lap_bounds.main(["--anchors", str(file), "--json", str(tmp_path / "bounds.json")]) == 0
    said = capsys.readouterr()
    assert "1 of 1 worlds" in said.out
    assert "elsewhere: not in the catalogue" in said.err
    (row,) = json.loads((tmp_path / "bounds.json").read_text())["worlds"]
    assert row["record_s"] == 7.5


def test_an_unknown_car_is_refused_in_one_line(tmp_path, capsys):
    file = tmp_path / "boards.csv"
    file.write_text("world,race_type,date,best_lap_s\n")
    assert lap_bounds.main(["--anchors", str(file), "--car", "nope"]) == 2
    assert capsys.readouterr().err.startswith("car=nope: no such car; options: deepracer,")
