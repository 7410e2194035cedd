from functools import cache

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


# A longer course or one more search takes a second each.
COURSE = ring(2.0, 0.6)
INSIDE_M = 2.0 - 0.3 - REACH_M


@cache
def fastest(start_ndist: float | None = None) -> tuple[float, np.ndarray]:
    return fastest_line(COURSE, REACH_M, ABILITY, start_ndist)


def test_a_ring_is_driven_along_its_inner_border_at_the_speed_of_its_curvature():
    time_s, line = fastest()
    assert time_s == pytest.approx(2 * np.pi * INSIDE_M / ABILITY.speed_at(np.array(1 / INSIDE_M)), rel=0.02)
    assert np.hypot(*line.T) == pytest.approx(INSIDE_M, abs=0.02)


def test_a_wider_road_and_a_better_car_are_never_slower():
    better = ABILITY._replace(speed_mps=1.1 * ABILITY.speed_mps)
    assert fastest_line(ring(2.0, 1.0), REACH_M, ABILITY)[0] < fastest()[0]
    assert fastest_line(COURSE, REACH_M, better)[0] < fastest()[0]


def test_a_lap_from_standstill_is_slower_by_what_it_takes_to_gain_speed():
    (flying, _), (standing, line) = fastest(), fastest(0.25)
    pulling_away = ABILITY._replace(accelerate_mps2=1e6)
    assert line[0] == pytest.approx(COURSE.points_at(np.array([0.25]))[0])
    # Half of the time to the speed of the ring, if the line were the same.
    speed = float(ABILITY.speed_at(np.array(1 / INSIDE_M)))
    assert standing - flying == pytest.approx(0.5 * speed / ABILITY.accelerate_mps2, abs=0.08)
    assert fastest_line(COURSE, REACH_M, pulling_away, 0.25, driven=line)[0] < standing


def test_a_lap_ends_when_the_front_of_the_car_is_at_the_line():
    whole, line = fastest(0.25)
    short, _ = fastest_line(COURSE, REACH_M, ABILITY, 0.25, short_m=0.3, driven=line)
    assert 0.05 < whole - short < 0.2


def test_the_line_of_a_driven_lap_is_never_better_than_the_least_time():
    driven = COURSE.points_at(np.linspace(0.25, 1.25, 40))
    assert fastest_line(COURSE, REACH_M, ABILITY, 0.25, driven=driven)[0] <= fastest(0.25)[0] + 1e-9
