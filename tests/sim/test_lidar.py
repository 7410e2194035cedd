"""The LIDAR's rays against walls and boxes whose distances are known."""

import numpy as np
import pytest
import shapely

from deepracer_exp.sim.lidar_rays import ANGLES_RAD, MOUNT_Z_M, RAYS, box_sides, scan


def sides(low_x: float, low_y: float, high_x: float, high_y: float) -> np.ndarray:
    return (
        shapely.get_coordinates(shapely.box(low_x, low_y, high_x, high_y))
        .repeat(2, axis=0)[1:-1]
        .reshape(4, 4)
    )


ROOM = sides(0.0, 0.0, 4.0, 2.5)


def poses_in(low: float, high: tuple[float, float], count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    x, y = (low + (far - 2 * low) * rng.random(count) for far in high)
    return np.stack([x, y, rng.uniform(-np.pi, np.pi, count)], axis=1)


def test_in_a_room_every_ray_ends_at_the_nearest_of_its_four_walls():
    poses = poses_in(0.1, (4.0, 2.5), 300)
    angle = poses[:, 2:] + ANGLES_RAD
    cos, sin = np.cos(angle), np.sin(angle)
    to_x = np.where(cos > 0, 4.0 - poses[:, :1], -poses[:, :1]) / cos
    to_y = np.where(sin > 0, 2.5 - poses[:, 1:2], -poses[:, 1:2]) / sin
    distances = scan(poses, np.tile(ROOM, (300, 1, 1)))
    assert distances == pytest.approx(np.minimum(to_x, to_y), abs=1e-9)


def test_a_sensor_turned_by_one_ray_sees_the_same_ring_moved_by_one():
    walls = np.vstack([ROOM, sides(3.0, 1.0, 3.2, 1.3)])[None]
    pose = np.array([[1.3, 0.7, 0.4]])
    turned = pose + np.array([0, 0, ANGLES_RAD[1] - ANGLES_RAD[0]])
    assert scan(turned, walls)[0, :-1] == pytest.approx(scan(pose, walls)[0, 1:], abs=1e-9)


def test_among_segments_that_cross_the_nearest_hides_the_others():
    segments = np.random.default_rng(1).uniform(-3, 3, (7, 4))
    pose = np.array([0.3, -0.2, 1.0])
    lines = shapely.union_all([shapely.LineString(some.reshape(2, 2)) for some in segments])
    eye = shapely.Point(pose[:2])
    expected = np.full(RAYS, np.inf)
    for ray, angle in enumerate(pose[2] + ANGLES_RAD):
        end = pose[:2] + 10 * np.array([np.cos(angle), np.sin(angle)])
        crossed = shapely.LineString([pose[:2], end]).intersection(lines)
        if not crossed.is_empty:
            expected[ray] = eye.distance(crossed)
    assert np.isinf(expected).any()
    distances = scan(pose[None], segments[None])[0]
    assert distances == pytest.approx(expected, abs=1e-9)


def test_each_sensor_sees_its_own_walls_and_nothing_where_there_are_none():
    walls = np.stack([np.full((4, 4), np.nan), ROOM, ROOM + 10])
    poses = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [11.0, 11.0, 0.0]])
    nothing, here, there = scan(poses, walls)
    assert np.isinf(nothing).all()
    assert here == pytest.approx(there)
    assert here[RAYS // 2] == pytest.approx(3.0 / np.cos(ANGLES_RAD[RAYS // 2]))


def test_a_box_is_read_where_it_stands_and_hides_the_wall_behind_it():
    ray = 50
    to_box = 0.8 + ANGLES_RAD[ray]
    # Turned towards the sensor, its near side 1.1 m away and 0.2 m wide; as high as the sensor, it is not seen.
    boxes = np.array([[[1.3 * np.cos(to_box), 1.3 * np.sin(to_box), to_box, 0.4, 0.2, MOUNT_Z_M + 0.01]]])
    boxes = np.concatenate([boxes, np.where(np.arange(6) == 5, MOUNT_Z_M, boxes)])
    poses = np.tile([0.0, 0.0, 0.8], (2, 1))
    walls = np.tile(ROOM - [2, 1, 2, 1], (2, 1, 1))
    empty = scan(poses, walls)
    seen, low = scan(poses, np.hstack([walls, box_sides(boxes)]))
    off = ANGLES_RAD - ANGLES_RAD[ray]
    struck = (np.cos(off) > 0) & (np.abs(np.tan(off)) * 1.1 <= 0.1)
    assert struck.sum() == 3
    assert (seen[struck] < empty[0, struck]).all()
    assert seen == pytest.approx(np.where(struck, 1.1 / np.cos(off), empty[0]), abs=1e-9)
    assert np.array_equal(low, empty[1])
