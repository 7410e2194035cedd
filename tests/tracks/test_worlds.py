"""The worlds of the service, compared with its own route files and with recordings."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.worlds.catalogue import find_world, leaders, worlds
from deepracer_exp.aws.worlds.routes import is_first_of_equals, read_route, recognise, world_rows
from deepracer_exp.errors import BadInput
from deepracer_exp.tracks.track import world_track

# The world each recording says it was driven on.
RECORDINGS = {
    "race_pace/console_v5_baseline.tar.gz": "2022_reinvent_champ_ccw",
    "race_pace/console_v5_one_bot_ppo.tar.gz": "2022_reinvent_champ_ccw",
    "race_pace/console_v5_reinvent_base.log.gz": "reinvent_base",
    "race_pace/console_v5_v2.tar.gz": "Spain_track",
    "race_pace/console_v5_v3.tar.gz": "Spain_track",
    "race_pace/drfc_v5_2022_june_pro.log.gz": "2022_june_pro",
    "race_pace/drfc_v5_FS_June2020.log.gz": "FS_June2020",
    "race_pace/droa_v6_continuous.tar.gz": "reInvent2019_wide_cw",
    "race_pace/droa_v6_training.tar.gz": "Spain_track",
    "console_training/sim-trace": "reinvent_base",
}


@cache
def places_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded places and the closest waypoint recorded with each."""
    steps = read_recording(path).steps
    return steps[["X", "Y"]].to_numpy(np.float64), steps["closest_waypoint"].to_numpy(np.intp)


@pytest.fixture(params=RECORDINGS)
def recorded(request, reference):
    """Return a world, and what `places_of` returns of a recording on it."""
    return RECORDINGS[request.param], *places_of(reference / request.param)


def test_recorded_closest_waypoints_are_those_of_the_world(recorded):
    name, places, recorded_waypoint = recorded
    track = world_track(name)
    found = track.project(places)
    behind_m, ahead_m = (
        np.linalg.norm(places - track.waypoints[index], axis=1) for index in (found.previous, found.next)
    )
    nearer = np.where(behind_m <= ahead_m, found.previous, found.next)
    assert np.mean(nearer != recorded_waypoint) <= 0.007


def test_a_recording_is_recognised_by_its_waypoint_numbers(recorded):
    name, places, recorded_waypoint = recorded
    few = slice(None, None, max(1, len(places) // 300))
    best = recognise(places[few], recorded_waypoint[few])[0]
    assert (best.name, best.reversed) == (name, False)


def test_places_of_no_world_are_not_recognised():
    line = world_track("Oval_track").waypoints
    assert not recognise(line + 7.0, np.arange(len(line)))


def test_every_world_has_its_number_of_rows():
    for name, world in worlds().items():
        assert len(world_rows(name)) == world.rows, name


FIRST = frozenset(leaders())
"""One world of each family; the others differ in width, direction or scenery."""


@pytest.mark.parametrize(
    "name", [name if name in FIRST else pytest.param(name, marks=pytest.mark.slow) for name in worlds()]
)
def test_every_world_makes_a_course_with_all_its_rows(name):
    rows, track = world_rows(name), world_track(name)
    np.testing.assert_array_equal(track.waypoints, rows[:, :2])
    assert track.closed == (name != "Straight_track")
    found = track.project(track.waypoints)
    assert np.isfinite(found.heading_rad).all()
    assert (np.diff(found.ndist[:-1]) >= 0).all()
    # Where a border crosses itself within a millimetre, there are tiny further polygons and holes.
    road = max(shapely.get_parts(track.road), key=shapely.area)
    assert sum(shapely.area(shapely.Polygon(hole)) > 0.01 for hole in road.interiors) == track.closed
    assert track.road.area - road.area < 1e-4
    assert track.on_road(track.points_at(np.linspace(0.001, 0.999, 1000))).all()


def test_a_repeated_waypoint_has_two_numbers_and_one_direction():
    track = world_track("Spain_track")
    (second,) = np.flatnonzero(~is_first_of_equals(track.waypoints))
    place = track.project(track.waypoints[second][None]).ndist
    around = track.points_at(place[:, None] + np.array([[-1e-4, 0.0, 1e-4]]))[0]
    found = track.project(around)
    assert found.previous.tolist() == [second - 2, second, second]
    assert found.next.tolist() == [second - 1, second + 1, second + 1]
    pose = track.start_pose(place)
    toward = track.waypoints[second + 1] - track.waypoints[second]
    assert pose.yaw_rad == pytest.approx(np.arctan2(toward[1], toward[0]))


@pytest.mark.parametrize(
    "name", ["Bowtie_track", "Oval_track", "Spain_track", "Straight_track", "reinvent_base"]
)
def test_a_world_has_the_coordinates_of_its_route_file(reference, name):
    route = read_route(reference / f"routes/{name}.npy")
    np.testing.assert_allclose(world_rows(name), route, rtol=0, atol=0.5001e-4)


def test_variants_stand_beside_the_world_they_are_of():
    families = [world.family for world in worlds().values()]
    assert (len(families), len(leaders())) == (134, 68)
    assert sorted(families) == families
    assert leaders()[-3:] == ("reinvent_base", "thunder_hill_open", "thunder_hill_pro")


@pytest.mark.parametrize(
    ("called", "name"),
    [
        ("reinvent_base", "reinvent_base"),
        ("REINVENT_BASE", "reinvent_base"),
        ("arn:aws:deepracer:us-east-1::track/Spain_track", "Spain_track"),
        ("re:Invent 2018", "reinvent_base"),
        ("2022 re:Invent Championship", "2022_reinvent_champ"),
        ("Shanghai Sudu", "China_eval_track"),
        ("European Seaside Circuit - Buildings", "Monaco_building"),
        ("moon", None),
        ("", None),
    ],
)
def test_a_world_goes_by_its_name_and_by_its_official_one(called, name):
    assert find_world(called) == name


def test_an_unknown_world_is_refused_in_one_line():
    with pytest.raises(BadInput, match=r"^Oval: no such world \(did you mean Oval_track\?\); .* all 134$"):
        world_track("Oval")
