"""The camera against rays that are followed one by one through the geometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deepracer_exp.sim.camera import take_pictures
from deepracer_exp.sim.camera_boxes import FACE_LIGHT
from deepracer_exp.sim.lens import NEAREST_M, Lens
from deepracer_exp.sim.scenery import (
    CURVES_UNTIL_M,
    DASH_WIDTH_M,
    DASHES_UNTIL_M,
    LINE_WIDTH_M,
    MATERIALS,
    START_AHEAD_M,
    START_CHECKS,
    START_LENGTH_M,
    START_WIDTH_M,
    Scenery,
    box_corners,
    build_scenery,
    join_sceneries,
    paved_area,
    wall_ring,
)
from deepracer_exp.tracks.track import PLAIN_FLOOR, Track, world_track

SHARES = 255 * np.eye(len(MATERIALS), dtype=np.float32)
LENS = Lens(
    width=40, height=30, field_of_view_rad=1.13, x_m=0.1453, y_m=0.0, z_m=0.1303, pitch_rad=math.radians(15)
)
TRACKS = ("reinvent_base", "Spain_track", "Straight_track")
SCENERIES = {name: build_scenery(world_track(name)) for name in TRACKS}
RACEWAY = replace(
    PLAIN_FLOOR,
    lines_inside=False,
    dash_length_m=0.076,
    dash_gap_m=0.055,
    kerb_color="#880c0c",
    start_line_color="#3f3e3d",
    walls_beyond_m=0.82,
    walls_height_m=0.19,
    walls_follow_road=True,
)


def shares(scenery: Scenery, poses: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    """Return the share of each material in each pixel, (N, materials, height, width)."""
    out = np.empty((len(poses), len(MATERIALS), lens.height, lens.width), np.uint8)
    colors = np.broadcast_to(SHARES, (len(poses), *SHARES.shape))
    take_pictures(lens, scenery, poses, np.zeros(len(poses), np.intp), colors, out)
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
    ring = wall_ring(track)
    sides = np.diff(ring, axis=0)
    outwards = np.column_stack([sides[:, 1], -sides[:, 0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(ahead[..., 2] < 0, -eye[2] / ahead[..., 2], np.inf)
        speed = ahead[..., :2] @ outwards.T
        reached = np.where(speed > 0, ((ring[:-1] - eye[:2]) * outwards).sum(axis=1) / speed, np.inf)
    wall = reached.min(axis=-1)
    # A rectangle's sides, counter-clockwise, lead up the high x, then back along the high y, and so on.
    by_direction = {
        (0, 1): "wall_high_x",
        (-1, 0): "wall_high_y",
        (0, -1): "wall_low_x",
        (1, 0): "wall_low_y",
    }
    names = [
        "wall_low_x" if track.floor.walls_follow_road else by_direction[tuple(s)] for s in np.sign(sides)
    ]
    seen = np.array([MATERIALS.index(name) for name in names])[reached.argmin(axis=-1)]
    seen[eye[2] + wall * ahead[..., 2] > track.floor.walls_height_m] = MATERIALS.index("sky")
    on_floor = floor < wall
    at = eye[:2] + floor[on_floor][:, None] * ahead[on_floor][:, :2]
    points = shapely.points(at)
    material = np.full(len(at), MATERIALS.index("field"))
    material[shapely.contains(paved_area(track), points)] = MATERIALS.index("line")
    shapely.prepare(track.road)
    road = shapely.contains(track.road, points)
    material[road] = MATERIALS.index("road")
    lines = shapely.union_all(
        [shapely.LineString(line).buffer(LINE_WIDTH_M) for line in (track.inner, track.outer)]
    )
    shapely.prepare(lines)
    if track.floor.lines_inside:
        material[road & shapely.contains(lines, points)] = MATERIALS.index("line")
    center = shapely.LineString(track.waypoints)
    beside = road & (shapely.distance(center, points) < 0.5 * DASH_WIDTH_M)
    near = np.linalg.norm(at - eye[:2], axis=1) < DASHES_UNTIL_M
    length_m = track.floor.dash_length_m
    phase = shapely.line_locate_point(center, points) % (length_m + track.floor.dash_gap_m)
    material[beside & (phase < length_m) & near] = MATERIALS.index("dash")
    material[beside & ~near] = MATERIALS.index("far_dash")
    if track.floor.start_line_color is not None:
        pose = track.start_pose(np.zeros(1))
        x, y = (at - track.waypoints[0]).T
        cos, sin = np.cos(pose.yaw_rad), np.sin(pose.yaw_rad)
        i = (x * cos + y * sin - START_AHEAD_M) / START_LENGTH_M + 0.5
        j = (y * cos - x * sin) / START_WIDTH_M + 0.5
        on_start = road & (i > 0) & (i < 1) & (j > 0) & (j < 1)
        dark = (np.floor(i * START_CHECKS[0]) + np.floor(j * START_CHECKS[1])) % 2 == 0
        material[on_start] = np.where(dark, MATERIALS.index("start"), MATERIALS.index("line"))[on_start]
    seen[on_floor] = material
    counted = np.stack([seen == index for index in range(len(MATERIALS))]).astype(float)
    shape = (len(MATERIALS), lens.height, per_pixel, lens.width, per_pixel)
    return counted.reshape(shape).mean(axis=(2, 4))


@pytest.mark.parametrize(
    ("name", "ndist", "side", "angles"),
    [
        ("reinvent_base", 0.1, 0.0, (0.0, 0.0, 0.0)),
        ("Spain_track", 0.4, 0.2, (0.5, 0.05, -0.04)),
        ("Straight_track", 0.8, -0.25, (-2.0, -0.08, 0.06)),
    ],
)
def test_a_pixel_is_the_mean_of_what_its_rays_meet(name, ndist, side, angles):
    """The far centre line has the colour that its dashes run together to: this and `dash` count as one material."""
    track = world_track(name)
    pose = pose_on(track, ndist, side, angles)
    ours, theirs = shares(SCENERIES[name], pose)[0], followed(track, pose[0], LENS, 12)
    dash, far = MATERIALS.index("dash"), MATERIALS.index("far_dash")
    error = np.abs(ours - theirs)
    error[[dash, far]] = 0
    # The centre line takes its place from the road.
    error[MATERIALS.index("road")] = np.abs((ours - theirs)[[MATERIALS.index("road"), dash, far]].sum(axis=0))
    assert error.mean() < 0.001
    # Where curves are drawn with fewer points, single pixels of the far edge differ.
    assert np.quantile(error, 0.999) < 0.1
    assert ours[dash].sum() == pytest.approx(theirs[dash].sum(), rel=0.2, abs=2.0)


# Poses from which a stretch of road was drawn twice or not at all: its points are fewer from a distance on, and the two
# versions of it measured that distance from different places. The start line and its dark fields did likewise.
@example("reinvent_base", 0.0, -0.38671875, (0.0, -0.0625, 0.0))
@example("2022_may_pro_cw", 0.0, 0.09507465559873014, (0.0, 0.0, 0.0))
@example("thunder_hill_open", 0.4995926836335468, 0.5181280445398155, (0.0, 0.0, 0.0))
@example("reInvent2019_wide_mirrored", 0.0, 0.3396509153890918, (0.0, 0.0, 0.0))
@example("2022_summit_speedway_ccw", 0.0, 0.19076217488568625, (0.0, 0.0, 0.0))
@settings(max_examples=60)
@given(
    name=st.sampled_from(TRACKS),
    ndist=st.floats(0, 0.999),
    side=st.floats(-0.5, 0.5),
    angles=st.tuples(st.floats(-math.pi, math.pi), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15)),
)
def test_materials_share_every_pixel_completely(name, ndist, side, angles):
    track = world_track(name)
    scenery = SCENERIES.get(name) or build_scenery(track)
    total = shares(scenery, pose_on(track, ndist, side, angles)).sum(axis=1)
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
    x = np.linspace(0, 30, 31)
    rows = np.column_stack([x, 0 * x, x, 0 * x + 0.5, x, 0 * x - 0.5])
    scenery = build_scenery(
        Track.from_route(rows, "endless", floor=replace(PLAIN_FLOOR, walls_beyond_m=None))
    )
    sky_rows = shares(scenery, np.zeros((1, 5)), lens)[0, MATERIALS.index("sky")].sum(axis=0)
    # The field ends 20 m away, a row below the horizon.
    assert np.abs(sky_rows - 26.1).max() < 1.2


def test_curves_lose_points_only_where_pixels_are_large():
    assert CURVES_UNTIL_M > DASHES_UNTIL_M


def test_a_track_looks_the_same_to_cars_that_drive_it_the_other_way():
    tracks = [replace(world_track("Spain_track", reversed=way), floor=RACEWAY) for way in (False, True)]
    poses = np.concatenate([pose_on(tracks[0], ndist, 0.1, (0.2, 0.0, 0.0)) for ndist in (0.985, 0.3)])
    forward, backward = (shares(build_scenery(track), poses) for track in tracks)
    assert np.abs(forward - backward).max() < 1.5 / 255


@pytest.mark.parametrize(("ndist", "angle"), [(0.985, 0.0), (0.3, 0.4)])
def test_a_raceway_has_lines_outside_its_border_kerbs_a_start_line_and_a_barrier(ndist, angle):
    track = replace(world_track("Spain_track"), floor=RACEWAY)
    pose = pose_on(track, ndist, 0.1, (angle, 0.0, 0.0))
    ours, theirs = shares(build_scenery(track), pose)[0], followed(track, pose[0], LENS, 12)
    place = {name: index for index, name in enumerate(MATERIALS)}
    # Stripes and dashes take their place from what they lie on, wherever they begin.
    groups = [
        ["road", "dash", "far_dash"],
        ["line", "kerb", "far_kerb"],
        ["start"],
        ["field"],
        ["wall_low_x"],
        ["sky"],
    ]
    for group in groups:
        error = np.abs((ours - theirs)[[place[name] for name in group]].sum(axis=0))
        assert error.mean() < 0.002
        assert np.quantile(error, 0.99) < 0.15
    red = ours[place["kerb"]].sum() + 0.5 * ours[place["far_kerb"]].sum()
    assert 0.1 < red / ours[[place["line"], place["kerb"], place["far_kerb"]]].sum() < 0.4
    assert (theirs[place["start"]].sum() > 5) == (ndist > 0.9)


# Ahead of a car at the start of reinvent_base, which drives along the x axis.
EYE = pose_on(world_track("reinvent_base"), 0.1, 0.0, (0.0, 0.02, -0.03))


def box(
    ahead_m: float, left_m: float, turned: float, length: float, width: float, height: float, color: float
):
    x, y, yaw = EYE[0, :3]
    cos, sin = math.cos(yaw), math.sin(yaw)
    at = (x + ahead_m * cos - left_m * sin, y + ahead_m * sin + left_m * cos)
    return [*at, yaw + turned, length, width, height, color]


def boxed(*boxes: list[float]) -> np.ndarray:
    """Return the grey picture with boxes, (height, width)."""
    greys = np.linspace(30, 220, 12, dtype=np.float32)
    opposite = [MATERIALS.index(name) for name in ("wall_low_x", "wall_low_y")]
    colors = np.append(greys, greys[opposite])[None, :, None]
    out = np.empty((1, 1, LENS.height, LENS.width), np.uint8)
    some = np.array([boxes], np.float32) if boxes else None
    scenery = SCENERIES["reinvent_base"]
    return take_pictures(LENS, scenery, EYE, np.zeros(1, np.intp), colors, out, boxes=some)[0, 0].astype(
        float
    )


def met_boxes(boxes: np.ndarray, per_pixel: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of each pixel that boxes cover, and their colours' part of it, by following rays."""
    eye, ahead = rays(LENS, EYE[0], per_pixel)
    nearest, grey = np.full(ahead.shape[:2], np.inf), np.zeros(ahead.shape[:2])
    for x, y, yaw, length, width, height, color in boxes:
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        begin, along = turn @ (eye - [x, y, 0.5 * height]), ahead @ turn.T
        half = 0.5 * np.array([length, width, height])
        with np.errstate(divide="ignore", invalid="ignore"):
            enter = (-np.sign(along) * half - begin) / along
            leave = (np.sign(along) * half - begin) / along
        first = enter.max(axis=-1)
        met = (first < leave.min(axis=-1)) & (first > 0) & (first < nearest)
        nearest[met] = first[met]
        grey[met] = color * np.array(FACE_LIGHT)[[1, 2, 0]][enter.argmax(axis=-1)][met]
    shape = (LENS.height, per_pixel, LENS.width, per_pixel)
    return np.isfinite(nearest).reshape(shape).mean(axis=(1, 3)), grey.reshape(shape).mean(axis=(1, 3))


@pytest.mark.parametrize("seed", range(3))
def test_boxes_cover_what_rays_meet_first(seed):
    generator = np.random.default_rng(seed)
    places = [(ahead, left) for ahead in (-0.2, 0.7, 1.6, 2.6) for left in (-0.7, 0.0, 0.7)]
    boxes = np.array(
        [
            box(*place, *generator.uniform([-3, 0.05, 0.05, 0.02, 0], [3, 0.6, 0.6, 0.5, 255]))
            for place in places
            if place != (-0.2, 0.0)
        ]
    )
    covered, grey = met_boxes(boxes, 16)
    ours = boxed(*boxes)
    expected = boxed() * (1 - covered) + grey
    # Where the outlines of two boxes share a pixel, the nearer is taken to cover the same share of both.
    assert np.abs(ours - expected).mean() < 0.4
    assert np.quantile(np.abs(ours - expected), 0.99) < 6
    # What is behind a box, be it a line, is not seen through it.
    assert np.abs(ours - grey)[covered == 1].mean() < 1
    assert np.array_equal(ours, boxed(*generator.permutation(boxes)))


def test_a_nearer_box_hides_a_farther_one_even_if_its_middle_is_farther():
    near, far = box(0.6, 0, 0.1, 0.05, 0.6, 0.5, 200), box(1.2, 0, 0.4, 0.2, 0.2, 0.2, 20)
    assert np.array_equal(boxed(near, far), boxed(near))
    # A long one along the road, whose middle is farther than the box behind it.
    long, beside = box(2.5, 0.3, 0, 4.4, 0.05, 0.9, 200), box(1.4, 0.6, 0, 0.2, 0.2, 0.2, 20)
    assert np.array_equal(boxed(beside, long), boxed(long))
    assert not np.array_equal(boxed(beside), boxed())


def test_a_box_behind_the_camera_or_of_no_height_changes_nothing():
    assert np.array_equal(boxed(box(-0.5, 0, 0.3, 0.4, 0.4, 0.4, 255)), boxed())
    assert np.array_equal(boxed(box(1, 0, 0.3, 0.4, 0.4, 0, 255)), boxed())


def painted_range(boxes: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the grey picture without boxes, and the brightest and darkest that a face of one can be."""
    faces = np.outer(boxes[:, 6], FACE_LIGHT)
    alone = boxed()
    return np.minimum(alone, faces.min()), max(alone.max(), faces.max())


@pytest.mark.parametrize("seed", range(8))
def test_boxes_in_each_other_and_around_the_camera_only_mix_colours_that_are_there(seed):
    generator = np.random.default_rng(seed)
    # Some around the eye, some beside and behind it, most of them overlapping.
    low, high = [-0.4, -0.4, -3, 0.05, 0.05, 0.02, 0], [1.2, 0.4, 3, 1.0, 0.8, 0.5, 255]
    boxes = np.array([box(*generator.uniform(low, high)) for _ in range(12)])
    # Of a face less than NEAREST_M before the eye nothing is seen.
    outlines = shapely.polygons(box_corners(boxes))
    away_m = shapely.distance(outlines, shapely.Point(rays(LENS, EYE[0], 1)[0][:2]))
    boxes = boxes[(away_m == 0) | (away_m > 2 * NEAREST_M)]
    darkest, brightest = painted_range(boxes)
    ours = boxed(*boxes)
    # Shares below 0 or above 1 of any colour would leave this range; each of 12 boxes may round once.
    assert (ours >= darkest - 6).all()
    assert (ours <= brightest + 6).all()
    covered, _ = met_boxes(boxes, 8)
    # Where no ray meets a box nothing is painted, but for corners between rays; where all do, nothing of the road is
    # seen, but for outlines of two boxes that share a pixel.
    assert np.abs(ours - boxed())[covered == 0].max(initial=0) < 255 / 64 + 2
    light = boxes.copy()
    light[:, 6] = 255
    faces = np.outer(light[:, 6], FACE_LIGHT)
    assert (boxed(*light)[covered == 1] >= faces.min() - 6).mean() > 0.99


def test_of_boxes_in_each_other_the_one_with_the_nearer_middle_is_whole():
    near, far = box(0.8, 0.05, 0.2, 0.4, 0.3, 0.25, 200), box(0.95, -0.05, -0.4, 0.4, 0.3, 0.4, 20)
    covered, _ = met_boxes(np.array([near]), 8)
    whole = covered == 1
    assert whole.sum() > 50
    for both in (boxed(near, far), boxed(far, near)):
        assert np.abs(both - boxed(near))[whole].max() <= 255 / 64
        assert not np.array_equal(both, boxed(near))


def test_a_camera_inside_a_box_sees_out_of_it():
    eye = LENS.x_m, LENS.y_m
    around = box(*eye, 0.3, 0.4, 0.3, 0.25, 200)
    assert np.array_equal(boxed(around), boxed())
    ahead = box(1.0, 0.1, 0.2, 0.4, 0.3, 0.25, 20)
    assert np.array_equal(boxed(around, ahead), boxed(ahead))


def test_a_box_that_ends_below_the_camera_covers_the_bottom_of_the_picture():
    under = box(0.4, 0, 0.1, 1.2, 1.0, 0.06, 200)
    covered, grey = met_boxes(np.array([under]), 16)
    ours = boxed(under)
    assert (covered[-1] == 1).all()
    assert np.abs(ours - boxed() * (1 - covered) - grey).mean() < 0.4
    assert (np.abs(ours[-1] - 200 * FACE_LIGHT[0]) <= 1).all()


def test_a_box_that_begins_behind_the_camera_covers_what_rays_meet():
    beside = box(0.2, 0.35, 0.05, 1.6, 0.3, 0.4, 200)
    covered, grey = met_boxes(np.array([beside]), 16)
    assert 0.05 < covered.mean() < 0.6
    assert np.abs(boxed(beside) - boxed() * (1 - covered) - grey).mean() < 0.4
