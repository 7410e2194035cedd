"""Sectors and lap deltas of laps whose times are known."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from deepracer_exp.reports.tables.log_course import catalogue_track
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.reports.tables.sector_times import interval_times, time_lost, times_by_sector
from deepracer_exp.tracks.sectors import SHORTEST_M, Sector, sector_at, sectors_of

from .made_up import HZ, Drive, made_up_course, made_up_recording

COURSE = made_up_course()
SECTORS = sectors_of(COURSE)


def kind(part: Sector) -> str:
    return part.name.split()[0]


@pytest.mark.parametrize(
    ("name", "backwards", "kinds"),
    [
        ("reinvent_base", False, {"left", "right", "straight"}),
        ("Oval_track", False, {"left", "straight"}),
        ("Oval_track", True, {"right", "straight"}),
        ("Bowtie_track", False, {"left", "right", "straight"}),
        ("Straight_track", False, {"straight"}),
        ("Spain_track", False, {"left", "right", "straight"}),
    ],
)
def test_sectors_cover_the_course_once_and_are_not_too_short(
    name: str, backwards: bool, kinds: set[str]
) -> None:
    course = catalogue_track(name, backwards)
    parts = sectors_of(course)
    assert {kind(part) for part in parts} == kinds
    assert parts[0].begin == 0.0
    assert parts[-1].end == 1.0
    assert all(a.end == b.begin and kind(a) != kind(b) for a, b in pairwise(parts))
    assert all((part.end - part.begin) * course.length_m > 0.9 * SHORTEST_M for part in parts)


def test_at_constant_speed_a_sector_takes_its_share_of_the_lap_wherever_the_lap_starts() -> None:
    drives = [Drive(speed_mps=1.0), Drive(speed_mps=1.0, start=0.37)]
    times = times_by_sector(prepare(made_up_recording(drives)).steps, SECTORS)
    share = np.array([part.end - part.begin for part in SECTORS])
    # The step between the reset and the first row belongs to the sector in which the lap starts.
    reset_s = [[part.begin <= start < part.end for part in SECTORS] for start in (0.0, 0.37)]
    expected_s = share * COURSE.length_m + np.array(reset_s) / HZ
    np.testing.assert_allclose(times.to_numpy(), expected_s, atol=1e-6)


def test_sector_times_sum_up_to_the_lap_time() -> None:
    drives = [Drive(sections=((0.2, 0.4, 3.0),), start=s) for s in (0.0, 0.1, 0.3, 0.999)]
    view = prepare(made_up_recording(drives))
    times = times_by_sector(view.steps, SECTORS)
    np.testing.assert_allclose(times.sum(axis=1), view.episodes["lap_time_s"], rtol=1e-9)


def test_incomplete_laps_have_no_sector_times_and_cannot_be_compared() -> None:
    steps = prepare(made_up_recording([Drive(until=0.7), Drive(), Drive(off_at=30)])).steps
    assert times_by_sector(steps, SECTORS).index.tolist() == [1]
    with pytest.raises(KeyError):
        time_lost(steps, 1, 0)
    assert len(times_by_sector(steps[steps["episode"] == 2], SECTORS)) == 0


def test_the_theoretical_best_lap_takes_the_fast_half_of_each_lap() -> None:
    middle = SECTORS[len(SECTORS) // 2].begin
    drives = [Drive(speed_mps=1.0, sections=((a, b, 2.0),)) for a, b in ((0.0, middle), (middle, 1.0))]
    times = times_by_sector(prepare(made_up_recording(drives)).steps, SECTORS)
    assert times.min().sum() == pytest.approx(COURSE.length_m / 2.0 + 1 / HZ, abs=0.02)
    assert times.sum(axis=1).min() > COURSE.length_m / 2.0 + 1.0


def test_a_lap_loses_time_where_it_is_slower_and_nowhere_else() -> None:
    slow = Drive(speed_mps=2.0, sections=((0.5, 0.6, 1.0),))
    steps = prepare(made_up_recording([slow, Drive(speed_mps=2.0, start=0.8)])).steps
    delta = time_lost(steps, 0, 1).set_index("lap_position")["delta_s"]
    # Each lap stands for a step where it starts, at 0 and at 0.8.
    delta -= np.where((delta.index > 0) & (delta.index <= 0.8), 1 / HZ, 0.0)
    lost_s = 0.1 * COURSE.length_m / 2.0
    assert delta.loc[:0.49].abs().max() < 0.01
    np.testing.assert_allclose(delta.loc[0.62:], lost_s, atol=0.01)
    assert delta.iloc[-1] == pytest.approx(slow.lap_time_s() - Drive(speed_mps=2.0).lap_time_s(), abs=1e-6)


def test_times_of_many_laps_do_not_mix() -> None:
    speeds = [1.0 + 0.1 * k for k in range(12)]
    steps = prepare(made_up_recording([Drive(speed_mps=v) for v in speeds])).steps
    times = interval_times(steps, np.linspace(0.0, 1.0, 5))
    reset_s = np.array([1 / HZ, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(times, [COURSE.length_m / v / 4 + reset_s for v in speeds], atol=1e-6)


def test_a_place_lies_in_the_sector_between_whose_ends_it_is() -> None:
    middles = np.array([(part.begin + part.end) / 2 for part in SECTORS])
    assert sector_at(SECTORS, middles).tolist() == list(range(len(middles)))
    assert sector_at(SECTORS, np.array([0.0, 1.0, np.nan])).tolist() == [0, len(middles) - 1, -1]


def test_places_before_the_first_row_of_a_lap_are_passed_at_its_start() -> None:
    recording = made_up_recording([Drive(speed_mps=2.0, start=s) for s in (0.0, 0.3, 0.999, 0.0)])
    steps = recording.steps[recording.steps["steps"] > 1].reset_index(drop=True)
    view = prepare(replace(recording, steps=steps))
    times = interval_times(view.steps, np.linspace(0.0, 1.0, 101))
    assert times.to_numpy().min() >= 0.0
    # Two steps before the first row belong to the place of the start.
    assert times.to_numpy().max() < 0.01 * COURSE.length_m / 2.0 + 2 / HZ
    np.testing.assert_allclose(times.sum(axis=1), view.episodes["lap_time_s"], rtol=1e-9)


def test_a_flying_lap_takes_the_time_since_the_end_of_the_lap_before() -> None:
    recording = made_up_recording([Drive(speed_mps=2.0), Drive(speed_mps=1.5)])
    steps = recording.steps.copy()
    second = steps["episode"] == 1
    steps.loc[second, "steps"] += steps.loc[~second, "steps"].max()
    steps.loc[second, "tstamp"] += 1 / 15.0 - 0.05
    view = prepare(replace(recording, steps=steps))
    expected = [COURSE.length_m / 2.0 + 1 / HZ, COURSE.length_m / 1.5 + 1 / 15.0]
    np.testing.assert_allclose(view.episodes["lap_time_s"], expected)
    np.testing.assert_allclose(interval_times(view.steps, np.linspace(0.0, 1.0, 9)).sum(axis=1), expected)
