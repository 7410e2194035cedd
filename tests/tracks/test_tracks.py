import numpy as np
import pytest

from deepracer_exp.tracks.track import Track, Tracks

NAMES = ("Spain_track", "reinvent_base", "Straight_track", "2022_summit_speedway")


@pytest.fixture(scope="module")
def several(catalogue_track) -> list[Track]:
    tracks = [catalogue_track(name) for name in NAMES]
    return [*tracks, catalogue_track("Oval_track", "reversed")]


@pytest.fixture(scope="module")
def points(several) -> tuple[np.ndarray, np.ndarray]:
    """Return points on, beside and far from five courses in any order, and the course each is asked of."""
    draw = np.random.default_rng(1)
    track_index = draw.integers(0, len(several), 400)
    away = draw.normal(0, 1, (400, 2)) * draw.choice([0.01, 0.3, 30.0], (400, 1))
    at = np.stack([several[w].points_at(np.array([draw.random()]))[0] for w in track_index])
    at += away
    at[7] = np.nan
    return at, track_index


def test_every_answer_is_that_of_the_course_alone(several, points):
    at, track_index = points
    together = Tracks(several)
    found = together.project(at, track_index)
    borders = together.border_distances(at, found.center, track_index)
    ndist = np.stack([found.ndist - 0.3, found.ndist + 0.9], axis=1)
    road, ahead = together.on_road(at, track_index), together.points_at(ndist, track_index)
    start = together.start_pose(found.ndist, track_index)
    for place, track in enumerate(several):
        own = track_index == place
        alone = track.project(at[own])
        for name in alone._fields:
            np.testing.assert_array_equal(getattr(found, name)[own], getattr(alone, name), err_msg=name)
        alone_borders = track.border_distances(at[own], alone.center)
        np.testing.assert_array_equal(borders.track_width_m[own], alone_borders.track_width_m)
        np.testing.assert_array_equal(borders.is_left[own], alone_borders.is_left)
        np.testing.assert_array_equal(road[own], track.on_road(at[own]))
        np.testing.assert_array_equal(ahead[own], track.points_at(ndist[own]))
        for part, alone_part in zip(start, track.start_pose(found.ndist[own]), strict=True):
            np.testing.assert_array_equal(part[own], alone_part)
        pairs = np.column_stack([found.previous, found.next])[own]
        waypoints, first = together.waypoints
        np.testing.assert_array_equal(waypoints[first[place] + pairs], track.waypoints[pairs])
        assert together.length_m[place] == track.length_m
        assert together.closed[place] == track.closed
    assert road.any()
    assert not road.all()


def test_points_of_a_car_may_follow_one_another(several, points):
    """The points of a car's four wheels share one index of a course."""
    at, track_index = points
    together = Tracks(several)
    np.testing.assert_array_equal(
        together.on_road(at, track_index[::4]), together.on_road(at, np.repeat(track_index[::4], 4))
    )
