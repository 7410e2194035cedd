import contextlib
from bisect import bisect_right

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.segments import build_segments
from deepracer_exp.tracks.track import Track

COURSES = [
    ("reinvent_base",),
    ("Spain_track",),
    ("Tokyo_Training_track", "reversed"),
    ("Straight_track",),
    ("Straight_track", "reversed"),
]


@pytest.fixture(params=COURSES, ids=lambda course: "-".join(course))
def track(request, catalogue_track) -> Track:
    return catalogue_track(*request.param)


@pytest.fixture
def points(track) -> np.ndarray:
    """Return points inside the grid of segments, and beyond it."""
    draw = np.random.default_rng(1)
    low, high = track.outer.min(axis=0), track.outer.max(axis=0)
    return np.concatenate([draw.uniform(low - beyond, high + beyond, (1500, 2)) for beyond in (0.3, 5.0)])


def as_line(points: np.ndarray, closed: bool) -> shapely.Geometry:
    """Return the line as the service makes it, repeated points included."""
    return shapely.LinearRing(points) if closed else shapely.LineString(points)


def test_a_projection_is_the_one_of_shapely_to_the_last_bit(track, points):
    line = as_line(track.waypoints, track.closed)
    found = track.project(points)
    expected = shapely.line_locate_point(line, shapely.points(points), normalized=True)
    np.testing.assert_array_equal(found.ndist, expected)
    np.testing.assert_allclose(
        np.abs(found.offset_m), shapely.distance(line, shapely.points(points)), atol=1e-12
    )
    center = shapely.get_coordinates(shapely.line_interpolate_point(line, expected, normalized=True))
    np.testing.assert_allclose(found.center, center, atol=1e-12)
    np.testing.assert_allclose(found.distance_m, expected * line.length, atol=1e-12)


def test_closest_waypoints_are_the_two_sides_of_the_bisection_with_the_wrap(track, points):
    line = as_line(track.waypoints, track.closed)
    at = [line.project(shapely.Point(point), normalized=True) for point in track.waypoints[:-1]] + [1.0]
    points = np.concatenate([points, track.waypoints])
    found = track.project(points)
    following = np.array([bisect_right(at, ndist) for ndist in found.ndist])
    np.testing.assert_array_equal(found.previous, (following - 1) % len(at))
    np.testing.assert_array_equal(found.next, following % len(at))


def test_the_sign_of_the_offset_is_left_of_the_driving_direction(track):
    at = np.linspace(0.02, 0.98, 50)
    pose = track.start_pose(at)
    left = np.column_stack([-np.sin(pose.yaw_rad), np.cos(pose.yaw_rad)])
    middle = track.points_at(at)
    np.testing.assert_allclose(track.project(middle + 0.1 * left).offset_m, 0.1, atol=0.01)
    np.testing.assert_allclose(track.project(middle - 0.1 * left).offset_m, -0.1, atol=0.01)
    assert track.border_distances(middle + 0.1 * left, middle).is_left.all()
    assert not track.border_distances(middle - 0.1 * left, middle).is_left.any()


def test_a_driven_path_is_projected_point_by_point(track, points):
    beyond = np.vstack([points, [[np.nan, 0.0], [1e4, -1e4]]])
    expected = track.project(beyond)
    found = track.follow(beyond[:, 0], beyond[:, 1])
    np.testing.assert_array_equal(found, [expected.ndist, expected.offset_m, expected.heading_rad])


def test_width_and_side_are_measured_to_the_border_points_nearest_to_the_projection(track, points):
    center = track.project(points).center
    nearest = []
    for border in (track.inner, track.outer):
        line = as_line(border, track.closed)
        nearest.append(
            shapely.line_interpolate_point(line, shapely.line_locate_point(line, shapely.points(center)))
        )
    inner, outer = nearest
    found = track.border_distances(points, center)
    np.testing.assert_allclose(found.track_width_m, shapely.distance(inner, outer), atol=1e-9)
    dots = shapely.points(points)
    to_inner, to_outer = shapely.distance(dots, inner), shapely.distance(dots, outer)
    clear = np.abs(to_inner - to_outer) > 1e-9
    np.testing.assert_array_equal(found.is_left[clear], (to_inner < to_outer)[clear] != track.is_clockwise)


def test_the_road_is_the_outer_polygon_without_the_inner_one(track, points):
    if track.closed:
        expected = shapely.contains_xy(shapely.Polygon(track.outer), points) & ~shapely.contains_xy(
            shapely.Polygon(track.inner), points
        )
    else:
        ring = np.concatenate([track.outer, track.inner[::-1]])
        expected = shapely.contains_xy(shapely.Polygon(ring), points)
    assert expected.any()
    np.testing.assert_array_equal(track.on_road(points), expected)


def test_a_reversed_course_mirrors_the_positions_and_swaps_the_sides(catalogue_track):
    forward = catalogue_track("Spain_track")
    backward = catalogue_track("Spain_track", "reversed")
    points = forward.waypoints[5:-5] + 0.07
    there, back = forward.project(points), backward.project(points)
    np.testing.assert_allclose(back.ndist, 1 - there.ndist, atol=1e-12)
    np.testing.assert_allclose(back.offset_m, -there.offset_m, atol=1e-12)
    assert forward.is_clockwise
    assert not backward.is_clockwise
    np.testing.assert_array_equal(backward.waypoints, forward.waypoints[::-1])
    np.testing.assert_array_equal(backward.on_road(points), forward.on_road(points))


@given(ndist=st.floats(-3, 3))
def test_a_look_ahead_wraps_on_a_ring_and_stops_at_an_end(catalogue_track, ndist):
    ring, strip = catalogue_track("reinvent_base"), catalogue_track("Straight_track")
    on_ring = as_line(ring.waypoints, True).interpolate(ndist % 1.0, normalized=True)
    np.testing.assert_allclose(ring.points_at(np.array(ndist)), (on_ring.x, on_ring.y), atol=1e-9)
    on_strip = as_line(strip.waypoints, False).interpolate(min(max(ndist, 0.0), 1.0), normalized=True)
    np.testing.assert_allclose(strip.points_at(np.array(ndist)), (on_strip.x, on_strip.y), atol=1e-9)


def test_a_start_pose_looks_at_the_next_waypoint(track):
    at = np.linspace(0.0, 0.999, 200)
    pose = track.start_pose(at)
    place = np.column_stack([pose.x, pose.y])
    ahead = np.searchsorted(track.project(track.waypoints[1:-1]).ndist, at, side="right") + 1
    toward = track.waypoints[ahead] - place
    far = np.linalg.norm(toward, axis=1) > 1e-6
    turn = pose.yaw_rad - np.arctan2(toward[:, 1], toward[:, 0])
    np.testing.assert_allclose(np.cos(turn[far]), 1.0, atol=1e-9)


def test_a_point_beyond_the_end_projects_onto_the_end(catalogue_track):
    strip = catalogue_track("Straight_track")
    beyond = strip.waypoints[-1] + [3.0, 0.4]
    found = strip.project(np.array([beyond]))
    assert found.ndist[0] == 1.0
    np.testing.assert_array_equal(found.center[0], strip.waypoints[-1])
    assert (found.previous[0], found.next[0]) == (len(strip.waypoints) - 1, 0)


def test_a_point_that_is_not_a_number_never_gets_a_finite_place(catalogue_track):
    track = catalogue_track("reinvent_base")
    lost = np.array([[np.nan, 1.0], [1.0, np.nan]])
    found = track.project(lost)
    assert np.isnan(found.ndist).all()
    assert np.isnan(found.offset_m).all()
    assert not track.on_road(lost).any()
    assert np.isnan(track.points_at(np.array([np.nan, np.inf]))).all()


def test_the_candidates_of_a_place_on_the_road_do_not_depend_on_the_length_of_the_course():
    """A zig-zag of the same bends, 4 and 40 times: as many segments are looked at for a point."""

    def mean_candidates(bends: int) -> float:
        x = np.arange(0.0, 6.0 * bends, 0.15)
        line = np.column_stack([x, np.sin(x * np.pi / 3)])
        grid = build_segments(line)
        of = grid.lines[0]
        cells = ((line - [of["low_x"], of["low_y"]]) / of["cell_m"]).astype(int)
        cell = cells[:, 1] * of["columns"] + cells[:, 0]
        return float(np.diff(grid.first)[cell].mean())

    assert mean_candidates(40) <= 1.05 * mean_candidates(4)
    assert mean_candidates(4) < 6


@pytest.mark.parametrize("denser", [4, 10])
def test_the_candidates_grow_no_faster_than_the_density_of_the_points(catalogue_track, denser):
    track = catalogue_track("AWS_track")
    dense = track.points_at(np.linspace(0, 1, denser * (len(track.waypoints) - 1) + 1))
    few, many = build_segments(track.waypoints), build_segments(dense)
    assert many.lines["columns"] * many.lines["rows"] == few.lines["columns"] * few.lines["rows"]
    assert len(many.member) <= 1.1 * denser * len(few.member)


def test_a_closed_course_of_rows_keeps_its_closing_point(ring):
    track = Track.from_route(ring, "ring")
    assert track.closed
    np.testing.assert_array_equal(track.waypoints[0], track.waypoints[-1])
    assert (track.width_m, track.is_clockwise, track.title) == (pytest.approx(1.0), False, "ring")
    with pytest.raises(ValueError, match="read-only"):
        track.waypoints[0] = 0.0


def eight(rows: int = 100, turn: float = 0.0) -> np.ndarray:
    """Return route rows of a figure of eight, closed exactly, whose crossing is at the origin."""
    angle = np.linspace(0.0, 2 * np.pi, rows + 1) + turn
    center = np.column_stack([2 * np.sin(angle), np.sin(2 * angle)])
    ahead = np.column_stack([2 * np.cos(angle), 2 * np.cos(2 * angle)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    route = np.column_stack([center, center + 0.2 * left, center - 0.2 * left])
    route[-1] = route[0]
    return route


@pytest.mark.parametrize(
    ("turn", "closed"), [(0.0, True), (0.01, True), (1.6, True), (0.0, False), (1.6, False)]
)
def test_a_course_that_crosses_itself_is_refused_with_the_place(turn, closed):
    for rows in (eight(turn=turn), eight(turn=turn)[::-1]):
        with pytest.raises(
            BadInput, match=r"^the centre line crosses itself at \(-?0\.0\d, -?0\.0\d\); accepted is"
        ):
            Track.from_route(rows if closed else rows[:-1], "eight")


def test_an_open_course_that_crosses_itself_late_is_refused_with_the_place():
    x, y = np.array([-5, -4, -3, -2, -1, 0, 1, 2, 2, 1, 0.5, 0.5]), np.array([0] * 7 + [0, 1, 1, 0.5, -1.0])
    rows = np.column_stack([x, y, x, y + 0.3, x, y - 0.3])
    with pytest.raises(BadInput, match=r"crosses itself at \(0\.50, -?0\.00\)"):
        Track.from_route(rows, "late")


def test_a_course_that_returns_along_itself_is_refused(ring):
    half = ring[:31]
    with pytest.raises(BadInput, match="the centre line crosses itself"):
        Track.from_route(np.concatenate([half, half[-2::-1]]), "back and forth")


def test_the_recorded_figure_of_eight_is_refused_in_one_line(reference):
    with pytest.raises(BadInput, match=r"figure_of_eight.npy: .* crosses itself at \(-?0.00, -?0.00\)"):
        Track.from_file(reference / "inputs/figure_of_eight.npy")


@given(
    shifts=st.lists(st.floats(-3.0, 3.0).map(lambda m: round(m, 1)), min_size=12, max_size=12),
    closed=st.booleans(),
)
def test_whatever_borders_a_route_has_it_is_a_course_or_refused(shifts, closed):
    angle = np.linspace(0.0, 2 * np.pi, 13)[:12]
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    rows = np.column_stack([3.0 * around, 2.5 * around + np.resize(shifts[:6], (12, 2)), 3.5 * around])
    rows[:, 4] += shifts
    rows = np.concatenate([rows, rows[:1]]) if closed else rows
    track = None
    with contextlib.suppress(BadInput):
        track = Track.from_route(rows, "mine")
    if track is not None:
        assert np.isfinite(track.project(track.waypoints).ndist).all()
        assert 0 <= track.on_road(track.waypoints).mean() <= 1


def test_swapped_borders_and_a_centre_line_outside_of_them_are_refused(ring):
    with pytest.raises(BadInput, match="centre points lie off the road"):
        Track.from_route(ring[:, [0, 1, 4, 5, 2, 3]], "ring")
    ring[:, :2] *= 2
    with pytest.raises(BadInput, match="61 of 61 centre points"):
        Track.from_route(ring, "ring")
