"""Zig-zag is steering from side to side on straights, in numbers that are known by construction."""

import math

import numpy as np
import pytest

from deepracer_exp.evaluation.zigzag import CENTRED_DEG, ZigZag, zigzag_of
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.reports.tables.sector_times import zigzag_in
from deepracer_exp.tracks.track import Track

from .made_up import Drive, made_up_course, made_up_recording

HZ, SPEED_MPS, STEPS = 15, 2.0, 120
LENGTH_M = 20.0


@pytest.fixture(scope="module")
def straight() -> Track:
    x = np.linspace(0.0, LENGTH_M, 80)
    zero = np.zeros_like(x)
    return Track.from_route(np.column_stack([x, zero, x, zero + 0.5, x, zero - 0.5]), "straight")


def measure(course: Track, steering_deg, y_m=0.0, number=0, drives=True) -> ZigZag:
    """Drive along x from 1 m on."""
    rows = len(steering_deg)
    time_s = np.arange(rows) / HZ
    x_m = 1 + SPEED_MPS * time_s
    y_m, number, drives = (np.broadcast_to(one, rows) for one in (y_m, number, drives))
    return zigzag_of(course, x_m, y_m, np.asarray(steering_deg, float), time_s, number, drives)


def swinging(angle_deg: float, each_side: int = 2) -> np.ndarray:
    return angle_deg * np.where((np.arange(STEPS) // each_side) % 2, 1.0, -1.0)


def test_a_car_that_swings_from_side_to_side_changes_as_often_as_it_does_and_as_far(straight):
    found = measure(straight, swinging(20.0))
    assert found.changes == STEPS / 2 - 2  # the first is the way into the straight
    assert found.straight_m == pytest.approx((STEPS - 1) / HZ * SPEED_MPS)
    assert found.changes_per_m == pytest.approx(found.changes / found.straight_m)
    assert found.amplitude_deg == 20.0
    assert found.laps == pytest.approx(found.straight_m / LENGTH_M)


@pytest.mark.parametrize(
    ("steering_deg", "changes", "amplitude_deg"),
    [
        (np.zeros(STEPS), 0, None),
        (np.full(STEPS, 20.0), 0, None),
        (swinging(0.9 * CENTRED_DEG), 0, None),
        # Back to the middle is not to the other side.
        (np.tile([20.0, 0.0], STEPS // 2), 0, None),
        # The way from one bend into the next takes one change.
        (np.r_[np.full(60, 10.0), np.full(60, -30.0)], 0, None),
        # Wheels may be straight in between for any time.
        (np.r_[np.full(20, 10.0), np.full(20, -10.0), np.zeros(60), np.full(20, 30.0)], 1, 20.0),
        # An angle grows before it counts.
        (np.r_[-5.0, 5.0, 12.0, 5.0, -5.0, -8.0, -5.0], 1, 10.0),
    ],
)
def test_only_steering_to_the_other_side_is_a_change(straight, steering_deg, changes, amplitude_deg):
    found = measure(straight, steering_deg)
    assert (found.changes, found.amplitude_deg) == (changes, amplitude_deg)


def test_nothing_changes_between_two_episodes_or_while_the_car_does_not_drive(straight):
    third = STEPS // 3
    swings = swinging(20.0, third)
    assert measure(straight, swings).changes == 1
    assert measure(straight, swings, number=np.arange(STEPS) // third).changes == 0
    assert measure(straight, swings, drives=np.arange(STEPS) != third).changes == 0
    assert measure(straight, swinging(20.0), drives=False) == ZigZag()


@pytest.mark.parametrize("heading_rad", [0.05, 0.2])
def test_the_time_lost_is_that_of_the_longer_way(straight, heading_rad):
    along_m = SPEED_MPS * np.arange(STEPS) / HZ
    wave_m = 0.9
    y_m = heading_rad * wave_m / (2 * np.pi) * np.sin(2 * np.pi * along_m / wave_m)
    found = measure(straight, np.zeros(STEPS), y_m)
    # A sine with the slope a is longer than its middle by a^2 / 4. Less is seen of it: chords between control steps are
    # shorter, and near the ends of the straight the mean is one of fewer steps.
    longer_s = heading_rad**2 / 4 * LENGTH_M / SPEED_MPS
    assert 0.7 * longer_s < found.lost_s < longer_s
    assert measure(straight, np.zeros(STEPS)).lost_s == pytest.approx(0.0, abs=1e-12)


def test_a_wide_bend_of_the_line_is_no_detour(straight):
    along_m = SPEED_MPS * np.arange(STEPS) / HZ
    found = measure(straight, np.zeros(STEPS), 0.3 * along_m**2 / along_m[-1] ** 2)
    assert found.lost_s == pytest.approx(0.0, abs=1e-6)


def test_steering_in_bends_does_not_count():
    angles = np.linspace(0.0, 2 * np.pi, 100)
    ring = [radius * np.column_stack([np.cos(angles), np.sin(angles)]) for radius in (2.0, 1.5, 2.5)]
    circle = Track.from_route(np.round(np.hstack([*ring]), 9), "circle")
    at = np.linspace(0.1, 5.0, STEPS)
    found = zigzag_of(
        circle,
        2 * np.cos(at),
        2 * np.sin(at),
        swinging(20.0),
        np.arange(STEPS) / HZ,
        np.zeros(STEPS, int),
        np.ones(STEPS, bool),
    )
    assert found == ZigZag()
    assert found.changes_per_m is found.lost_s is None


def test_parts_add_up_to_the_whole(straight):
    steering_deg, number = swinging(20.0), np.arange(STEPS) // 40
    parts = [measure(straight, steering_deg[number == one], number=number[number == one]) for one in range(3)]
    whole = measure(straight, steering_deg, number=number)
    total = sum(parts, ZigZag())
    assert total.changes == whole.changes > 0
    for name in ("straight_m", "laps", "swings_deg"):
        assert getattr(total, name) == pytest.approx(getattr(whole, name))


def swerving_view(angle_deg: float, stream: str = "training"):
    """Prepare a log whose training, or whose evaluation alone, swerves."""
    recording = made_up_recording(
        [Drive(speed_mps=2.0)] * 6, evaluations={"evaluation": [Drive(speed_mps=2.0)] * 3}
    )
    steps = recording.steps
    swerves = (steps["stream"] == stream).to_numpy()
    side = np.where(swerves, 1 - 2 * (np.arange(len(steps)) // 2 % 2), 0)
    steps["steer"] = angle_deg * side.astype(float)
    for axis in "XY":
        steps[axis] += 0.04 * side
    return prepare(recording)


def test_a_log_is_judged_by_its_evaluations_where_it_has_them():
    def rules(angle_deg: float, stream: str) -> list[str]:
        return [one.rule for one in findings(swerving_view(angle_deg, stream))]

    assert "zigzag" in rules(20.0, "evaluation")
    assert "zigzag" not in rules(20.0, "training")
    assert "zigzag" not in rules(3.0, "evaluation")


def test_the_finding_says_how_often_and_what_to_try():
    view = swerving_view(20.0, "evaluation")
    (found,) = (one for one in findings(view) if one.rule == "zigzag")
    known = zigzag_in(view.evaluation_steps, made_up_course())
    assert found.values["changes_per_m"] == known.changes_per_m > 2.0
    assert (
        f"{known.changes_per_m:.2f} changes of steering a metre, 20 degrees to either side" in found.sentence
    )
    # The console has no such key.
    assert "Try smaller steering angles in the action space." in found.sentence
    assert "algorithm." not in found.sentence
    assert math.isfinite(found.values["lost_s"])
