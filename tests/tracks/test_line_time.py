import numpy as np
import pytest

from deepracer_exp.tracks.line_time import Ability, fastest_line
from deepracer_exp.tracks.track import Track

ABILITY = Ability(np.array([4.0, 1.0, 0.5, 0.0]), np.array([1.0, 2.0, 3.0, 3.5]), 8.0, 10.0)
REACH_M = 0.1


def ring(radius_m: float, width_m: float) -> Track:
    angle = np.linspace(0, 2 * np.pi, 121)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    unit[-1] = unit[0]  # closed
    radii = (radius_m, radius_m - 0.5 * width_m, radius_m + 0.5 * width_m)
    return Track.from_route(np.concatenate([unit * radius for radius in radii], axis=1), "ring")


def test_a_ring_is_driven_along_its_inner_border_at_the_speed_of_its_curvature():
    inside_m = 3.0 - 0.3 - REACH_M
    time_s, line = fastest_line(ring(3.0, 0.6), REACH_M, ABILITY)
    assert time_s == pytest.approx(2 * np.pi * inside_m / ABILITY.speed_at(np.array(1 / inside_m)), rel=0.02)
    assert np.hypot(*line.T) == pytest.approx(inside_m, abs=0.02)


def test_a_wider_road_and_a_better_car_are_never_slower():
    (narrow, _), (wide, _) = (fastest_line(ring(2.0, width), REACH_M, ABILITY) for width in (0.4, 1.0))
    better = ABILITY._replace(speed_mps=1.1 * ABILITY.speed_mps)
    assert wide < narrow
    assert fastest_line(ring(2.0, 0.4), REACH_M, better)[0] < narrow


def test_a_lap_from_standstill_is_slower_by_what_it_takes_to_gain_speed():
    course = ring(3.0, 0.6)
    flying, _ = fastest_line(course, REACH_M, ABILITY)
    standing, line = fastest_line(course, REACH_M, ABILITY, start_ndist=0.25)
    pulling_away = ABILITY._replace(accelerate_mps2=1e6)
    assert line[0] == pytest.approx(course.points_at(np.array([0.25]))[0])
    # Half of the time to the speed of the ring, if the line were the same.
    speed = float(ABILITY.speed_at(np.array(1 / 2.6)))
    assert standing - flying == pytest.approx(0.5 * speed / ABILITY.accelerate_mps2, abs=0.08)
    assert fastest_line(course, REACH_M, pulling_away, start_ndist=0.25)[0] < standing


def test_a_lap_ends_when_the_front_of_the_car_is_at_the_line():
    course = ring(3.0, 0.6)
    whole, _ = fastest_line(course, REACH_M, ABILITY, 0.0)
    short, _ = fastest_line(course, REACH_M, ABILITY, 0.0, short_m=0.3)
    assert 0.05 < whole - short < 0.2


def test_the_line_of_a_driven_lap_is_never_better_than_the_least_time():
    course = ring(2.0, 0.6)
    driven = course.points_at(np.linspace(0.0, 1.0, 40))
    alone, _ = fastest_line(course, REACH_M, ABILITY, 0.0)
    assert fastest_line(course, REACH_M, ABILITY, 0.0, driven=driven)[0] <= alone + 1e-9
