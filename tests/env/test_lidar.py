import dataclasses
from itertools import pairwise

import numpy as np
import pytest
import shapely

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.lidar_view import reach_of_rays, readings
from deepracer_exp.env.race import Race
from deepracer_exp.sim.lidar_rays import ANGLES_RAD, MOUNT_X_M, MOUNT_Z_M
from deepracer_exp.sim.scenery import box_corners
from tests.env.conftest import drive_and_see

LIDAR, STILL, FAR = "observation=lidar", "observation.lidar.noise_m=0", "observation.lidar.reach_m=12"
PLAIN = compose_experiment([LIDAR])[0].observation.lidar


def field_of(race: Race) -> shapely.Polygon:
    """Return what the walls surround."""
    track = race.setup.track
    return shapely.box(*track.road.bounds).buffer(track.floor.walls_beyond_m, join_style="mitre")


def distances_to(race: Race, car: int, outlines: shapely.Geometry) -> np.ndarray:
    """Return how far each ray of a car that looks back gets, at most 12 m."""
    x, y, yaw = (float(values[car]) for values in race._batch.read()[:3])
    eye = np.array([x + MOUNT_X_M * np.cos(yaw), y + MOUNT_X_M * np.sin(yaw)])
    angles = yaw + np.pi + ANGLES_RAD
    ends = eye + 30 * np.column_stack([np.cos(angles), np.sin(angles)])
    hits = shapely.intersection([shapely.LineString([eye, end]) for end in ends], outlines)
    return np.minimum(shapely.distance(shapely.Point(eye), hits), 12.0)


def test_it_looks_back_and_sideways_at_the_walls_around_the_field(race_of):
    race = race_of(LIDAR, STILL, FAR)
    assert race.lidar[0] == pytest.approx(distances_to(race, 0, field_of(race).exterior), abs=1e-5)
    back = race_of(LIDAR, STILL, FAR, "observation.lidar.yaw_deg=0")
    assert np.abs(back.lidar - race.lidar).max() > 0.5


@pytest.mark.parametrize("sensors", [LIDAR, "observation=camera_lidar"])
def test_each_car_sees_the_boxes_of_its_own_episode(race_of, sensors):
    varied = (sensors, STILL, FAR, "randomization=sim2real", "randomization.pictures.objects=[30,30]")
    race = race_of(*varied, "randomization.observation_dropout=[0,0]", n_cars=3)
    drive_and_see(race, 2)
    race.reset(np.array([1]))
    boxes, walls = race._varied.boxes(np.arange(3)).astype(float), field_of(race).exterior
    for car in range(3):
        high = shapely.polygons(box_corners(boxes[car][boxes[car, :, 5] > MOUNT_Z_M]))
        read = distances_to(race, car, shapely.union_all([walls, *shapely.boundary(high)]))
        assert race.lidar[car] == pytest.approx(read, abs=1e-5)
        assert (read < distances_to(race, car, walls)).any()


def test_where_a_world_has_no_walls_it_sees_nothing(race_of):
    assert (race_of(LIDAR, "track.floor.walls_beyond_m=null").lidar == 1).all()


@pytest.mark.parametrize(("changes", "reach_m"), [({}, 1.0), ({"reach_m": 3.0}, 3.0)])
def test_distances_are_clipped(changes, reach_m):
    distances = np.array([[0.02, 0.4, 5.0, np.inf]])
    read = readings(dataclasses.replace(PLAIN, **changes), distances)
    assert read.tolist() == [pytest.approx([0.15, 0.4, reach_m, reach_m])]


def test_a_sector_is_one_where_its_nearest_ray_is_within_reach():
    distances = np.full((1, 64), 0.5)
    distances[0, [0, 15, 40]] = 0.49, 0.2, np.inf
    assert readings(dataclasses.replace(PLAIN, kind="sectors"), distances).tolist() == [
        [1, 1, 0, 0, 0, 0, 0, 0]
    ]


@pytest.mark.parametrize(("sectors", "values", "reach_m"), [(8, 8, 2.0), (4, 7, 0.7), (64, 3, 0.9)])
def test_a_discretized_sector_marks_the_step_of_its_nearest_ray(sectors, values, reach_m):
    config = dataclasses.replace(
        PLAIN, kind="discretized", sectors=sectors, values_per_sector=values, reach_m=reach_m
    )
    distances = np.random.default_rng(0).uniform(0.1, 1.5 * reach_m, (30, 64))
    seen = readings(config, distances).reshape(30, sectors, values)
    nearest = np.maximum(distances.reshape(30, sectors, -1).min(axis=2), 0.15)
    assert np.array_equal(seen.sum(axis=2), nearest < reach_m)
    some = np.argwhere(seen)
    low, high = some[:, 2] * reach_m / values, (some[:, 2] + 1) * reach_m / values
    marked = nearest[some[:, 0], some[:, 1]]
    assert ((low <= marked + 1e-12) & (marked < high + 1e-12)).all()
    assert config.size == sectors * values


def test_rays_reach_to_what_is_seen_or_to_the_end_of_its_step():
    distances = np.random.default_rng(0).uniform(0.2, 3.0, (30, 64))
    reached = reach_of_rays(PLAIN, readings(PLAIN, distances))
    assert reached == pytest.approx(np.where(distances < 1.0, distances, np.nan), nan_ok=True)
    config = dataclasses.replace(PLAIN, kind="discretized", sectors=16, values_per_sector=5, reach_m=2.0)
    nearest = np.repeat(distances.reshape(30, 16, 4).min(axis=2), 4, axis=1)
    reached = reach_of_rays(config, readings(config, distances))
    assert np.array_equal(np.isnan(reached), nearest >= 2.0)
    beyond = (reached - nearest)[nearest < 2.0]
    assert (beyond >= 0).all()
    assert (beyond <= 0.4).all()


def test_two_of_three_steps_bring_a_new_scan(race_of):
    race = race_of(LIDAR, FAR)
    scans = [race.lidar, *(seen["lidar"] for seen in drive_and_see(race, 12))]
    new = [not np.array_equal(*pair) for pair in pairwise(scans)]
    assert new == [False, True, True] * 4


def test_noise_has_the_deviation_that_was_asked_for_and_differs_from_car_to_car(race_of):
    options = (LIDAR, FAR, "episode.start_advance=0")
    still, noisy = (race_of(*options, f"observation.lidar.noise_m={m}", n_cars=50).lidar for m in (0, 0.02))
    noise = (noisy - still)[still < 11.5]
    assert noise.std() == pytest.approx(0.02, rel=0.1)
    assert len(np.unique(noisy, axis=0)) > len(np.unique(still, axis=0))
