"""The camera against rays followed one by one, which know of nothing but geometry."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from deepracer_exp.sim.camera import Lens, take_pictures
from deepracer_exp.sim.scenery import (
    CURVES_UNTIL_M,
    DASH_LENGTH_M,
    DASH_PITCH_M,
    DASH_WIDTH_M,
    DASHES_UNTIL_M,
    LINE_WIDTH_M,
    MATERIALS,
    WALL_HEIGHT_M,
    build_scenery,
    join_sceneries,
)
from deepracer_exp.tracks.track import Track, world_track

WALLS_M = 0.91
SHARES = 255 * np.eye(len(MATERIALS), dtype=np.float32)
LENS = Lens(
    width=40, height=30, field_of_view_rad=1.13, x_m=0.1453, y_m=0.0, z_m=0.1303, pitch_rad=math.radians(15)
)
TRACKS = ("reinvent_base", "Spain_track", "Straight_track")
SCENERIES = {
    name: build_scenery(track.waypoints, (track.inner, track.outer), track.road, WALLS_M)
    for name in TRACKS
    for track in [world_track(name)]
}


def shares(name: str, poses: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    """Return the share of each material in each pixel, (N, materials, height, width)."""
    out = np.empty((len(poses), len(MATERIALS), lens.height, lens.width), np.uint8)
    colors = np.broadcast_to(SHARES, (len(poses), *SHARES.shape))
    take_pictures(lens, SCENERIES[name], poses, np.zeros(len(poses), np.intp), colors, out)
    return out / 255.0


def pose_on(track: Track, ndist: float, side: float, angles: tuple[float, float, float]) -> np.ndarray:
    """Return a pose beside the centre line, (1, 5)."""
    pose = track.start_pose(np.array([ndist]))
    yaw = pose.yaw_rad[0]
    x, y = pose.x[0] - side * math.sin(yaw), pose.y[0] + side * math.cos(yaw)
    return np.array([[x, y, yaw + angles[0], *angles[1:]]])


def rays(lens: Lens, pose: np.ndarray, per_pixel: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the eye and the directions of `per_pixel` squared rays for each pixel, in the world."""
    _, _, yaw, pitch, roll = pose
    about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array(
        [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    )
    about_x = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    chassis = about_z @ about_y @ about_x
    eye = np.array([pose[0], pose[1], 0]) + chassis @ [lens.x_m, lens.y_m, lens.z_m]
    focal = 0.5 * lens.width / math.tan(0.5 * lens.field_of_view_rad)
    columns = (np.arange(lens.width * per_pixel) + 0.5) / per_pixel - 0.5 * lens.width
    rows = (np.arange(lens.height * per_pixel) + 0.5) / per_pixel - 0.5 * lens.height
    down, right = np.meshgrid(rows, columns, indexing="ij")
    ahead = np.stack([np.full_like(down, focal), -right, -down], axis=-1)
    tilt = lens.pitch_rad
    tilted = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    return eye, ahead @ (chassis @ tilted).T


def followed(track: Track, pose: np.ndarray, lens: Lens, per_pixel: int) -> np.ndarray:
    """Return the share of each material in each pixel by following rays, (materials, height, width)."""
    eye, ahead = rays(lens, pose, per_pixel)
    low_x, low_y, high_x, high_y = track.road.bounds
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(ahead[..., 2] < 0, -eye[2] / ahead[..., 2], np.inf)
        to_x = (np.where(ahead[..., 0] > 0, high_x + WALLS_M, low_x - WALLS_M) - eye[0]) / ahead[..., 0]
        to_y = (np.where(ahead[..., 1] > 0, high_y + WALLS_M, low_y - WALLS_M) - eye[1]) / ahead[..., 1]
    wall = np.minimum(to_x, to_y)
    seen = np.where(to_x < to_y, MATERIALS.index("wall_x"), MATERIALS.index("wall_y"))
    seen[eye[2] + wall * ahead[..., 2] > WALL_HEIGHT_M] = MATERIALS.index("sky")
    on_floor = floor < wall
    at = eye[:2] + floor[on_floor][:, None] * ahead[on_floor][:, :2]
    points = shapely.points(at)
    material = np.full(len(at), MATERIALS.index("field"))
    shapely.prepare(track.road)
    road = shapely.contains(track.road, points)
    material[road] = MATERIALS.index("road")
    lines = shapely.union_all(
        [shapely.LineString(line).buffer(LINE_WIDTH_M) for line in (track.inner, track.outer)]
    )
    shapely.prepare(lines)
    material[road & shapely.contains(lines, points)] = MATERIALS.index("line")
    center = shapely.LineString(track.waypoints)
    beside = road & (shapely.distance(center, points) < 0.5 * DASH_WIDTH_M)
    near = np.linalg.norm(at - eye[:2], axis=1) < DASHES_UNTIL_M
    phase = shapely.line_locate_point(center, points) % DASH_PITCH_M
    material[beside & (phase < DASH_LENGTH_M) & near] = MATERIALS.index("dash")
    material[beside & ~near] = MATERIALS.index("far_dash")
    seen[on_floor] = material
    counted = np.stack([seen == index for index in range(len(MATERIALS))]).astype(float)
    shape = (len(MATERIALS), lens.height, per_pixel, lens.width, per_pixel)
    return counted.reshape(shape).mean(axis=(2, 4))


@pytest.mark.parametrize("name", TRACKS)
@pytest.mark.parametrize(
    ("ndist", "side", "angles"),
    [(0.1, 0.0, (0.0, 0.0, 0.0)), (0.4, 0.2, (0.5, 0.05, -0.04)), (0.8, -0.25, (-2.0, -0.08, 0.06))],
)
def test_a_pixel_is_the_mean_of_what_its_rays_meet(name, ndist, side, angles):
    """Of the far centre line only the colour that dashes run together to is drawn: it and dashes count as one."""
    track = world_track(name)
    pose = pose_on(track, ndist, side, angles)
    ours, theirs = shares(name, pose)[0], followed(track, pose[0], LENS, 16)
    dash, far = MATERIALS.index("dash"), MATERIALS.index("far_dash")
    error = np.abs(ours - theirs)
    error[[dash, far]] = 0
    # The centre line takes its place from the road.
    error[MATERIALS.index("road")] = np.abs((ours - theirs)[[MATERIALS.index("road"), dash, far]].sum(axis=0))
    assert error.mean() < 0.001
    # Where curves are drawn with fewer points, single pixels of the far edge differ.
    assert np.quantile(error, 0.999) < 0.1
    assert ours[dash].sum() == pytest.approx(theirs[dash].sum(), rel=0.2, abs=2.0)


@settings(max_examples=60)
@given(
    name=st.sampled_from(TRACKS),
    ndist=st.floats(0, 0.999),
    side=st.floats(-0.5, 0.5),
    angles=st.tuples(st.floats(-math.pi, math.pi), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15)),
)
def test_materials_share_every_pixel_completely(name, ndist, side, angles):
    total = shares(name, pose_on(world_track(name), ndist, side, angles)).sum(axis=1)
    # Each share is rounded to 1 / 255; a road that touches itself on the way is counted where it is.
    assert np.abs(total - 1).max() < len(MATERIALS) * 0.51 / 255


def test_cars_are_drawn_as_if_each_were_alone():
    generator = np.random.default_rng(0)
    scenery = join_sceneries([SCENERIES[name] for name in TRACKS])
    index = np.array([2, 0, 1, 0], np.intp)
    poses = np.concatenate(
        [
            pose_on(world_track(TRACKS[k]), *generator.random(2) * 0.3, tuple(generator.normal(0, 0.1, 3)))
            for k in index
        ]
    )
    colors = generator.uniform(0, 255, (4, len(MATERIALS), 3)).astype(np.float32)
    together = take_pictures(LENS, scenery, poses, index, colors, np.empty((4, 3, 30, 40), np.uint8))
    for car, k in enumerate(index):
        alone = take_pictures(
            LENS,
            SCENERIES[TRACKS[k]],
            poses[car : car + 1],
            np.zeros(1, np.intp),
            colors[car : car + 1],
            np.empty((1, 3, 30, 40), np.uint8),
        )
        assert np.array_equal(alone[0], together[car])
    assert len(np.unique(together)) > 50


def test_the_horizon_is_where_the_pitch_puts_it():
    """Camera 15 degrees down, 160x120: the horizon of the service's camera is 26.1 rows from the top."""
    lens = Lens(**{**vars(LENS), "width": 160, "height": 120})
    scenery = build_scenery(*_endless())
    pose = np.array([[0.0, 0.0, 0.0, 0.0, 0.0]])
    colors = np.broadcast_to(SHARES, (1, *SHARES.shape))
    out = take_pictures(
        lens, scenery, pose, np.zeros(1, np.intp), colors, np.empty((1, len(MATERIALS), 120, 160), np.uint8)
    )
    sky_rows = out[0, MATERIALS.index("sky")].sum(axis=0) / 255
    # The field ends 20 m away, a row below the horizon.
    assert np.abs(sky_rows - 26.1).max() < 1.2


def _endless() -> tuple:
    x = np.linspace(0, 30, 31)
    center, left, right = (np.column_stack([x, np.full(31, y)]) for y in (0.0, 0.5, -0.5))
    return center, (left, right), shapely.Polygon(np.concatenate([left, right[::-1]])), None


def test_curves_lose_points_only_where_pixels_are_large():
    assert CURVES_UNTIL_M > DASHES_UNTIL_M
