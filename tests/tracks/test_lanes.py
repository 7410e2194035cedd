import numpy as np
import pytest

from deepracer_exp.tracks.lanes import INNER, OUTER, Lanes, _path
from deepracer_exp.tracks.track import Track, world_track

RADIUS_M, WIDTH_M = 2.0, 1.0


def circle(reversed: bool = False) -> Track:
    """Return a circle that is driven counter-clockwise, whose inner border is on the left."""
    angle = np.linspace(0, 2 * np.pi, 181)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    radii = (RADIUS_M, RADIUS_M - WIDTH_M / 2, RADIUS_M + WIDTH_M / 2)
    rows = np.hstack([radius * ring for radius in radii])
    rows[-1] = rows[0]
    return Track.from_route(rows, "circle", reversed=reversed)


@pytest.mark.parametrize("reversed", [False, True])
def test_lanes_run_halfway_between_the_centre_line_and_the_borders(reversed):
    track = circle(reversed)
    lanes = Lanes([track])
    centre = track.points_at(np.linspace(0, 0.9, 10))
    for lane, radius_m in ((INNER, RADIUS_M - WIDTH_M / 4), (OUTER, RADIUS_M + WIDTH_M / 4)):
        pose = lanes.poses(centre, np.full(10, lane), np.zeros(10, np.intp))
        np.testing.assert_allclose(np.hypot(pose.x, pose.y), radius_m, atol=1e-3)
        turn = -1 if reversed else 1
        heading = np.arctan2(pose.y, pose.x) + turn * np.pi / 2
        np.testing.assert_allclose(np.cos(pose.yaw_rad - heading), 1, atol=1e-3)


def test_each_course_has_its_own_lanes():
    tracks = [circle(), world_track("Oval_track")]
    both, alone = Lanes(tracks), Lanes(tracks[1:])
    centre = tracks[1].points_at(np.linspace(0, 0.9, 10))
    lane = np.arange(10) % 2
    for found, own in zip(
        both.poses(centre, lane, np.ones(10, np.intp)),
        alone.poses(centre, lane, np.zeros(10, np.intp)),
        strict=True,
    ):
        np.testing.assert_array_equal(found, own)


@pytest.mark.parametrize("name", ["reinvent_base", "reInvent2019_track"])
def test_the_path_of_a_bot_is_looked_up_to_a_fifth_of_a_millimetre(name):
    track = world_track(name)
    for border in (track.inner, track.outer):
        points = (track.waypoints + border) / 2
        cells = int(np.ceil(track.length_m / 0.01))
        coarse, fine = _path(track, points, cells), _path(track, points, 2 * cells)
        between = (coarse[1:] + coarse[:-1]) / 2
        assert np.abs(between[:, :2] - fine[1::2, :2]).max() < 2e-4
        # It closes, and it passes through the points of the lane.
        np.testing.assert_allclose(coarse[0, :4], coarse[-1, :4])
        away_m = np.linalg.norm(points[:, None] - fine[None, :, :2], axis=2).min(axis=1)
        assert away_m.max() < 0.02
