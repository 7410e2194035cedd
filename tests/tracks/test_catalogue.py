from pathlib import Path

import numpy as np
import pytest
import shapely

from deepracer_exp.config.track import TrackConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.routes import read_route
from deepracer_exp.tracks.track import Track

CATALOGUE = sorted(path.stem for path in (Path(__file__).parents[2] / "conf/track").glob("*.yaml"))

# world: published length in metres, median width in metres, order of the points
PUBLISHED = {
    "2022_summit_speedway": (25.173, 1.067, "ccw"),
    "AWS_track": (69.254, 0.838, "ccw"),
    "Bowtie_track": (17.428, 0.724, "ccw"),
    "Canada_Training": (21.743, 0.719, "ccw"),
    "Monaco": (60.266, 1.449, "cw"),
    "Oval_track": (19.55, 0.666, "ccw"),
    "Spain_track": (59.998, 0.914, "cw"),
    "Straight_track": (5.707, 0.61, "open"),
    "Tokyo_Training_track": (22.63, 1.157, "ccw"),
    "Vegas_track": (22.551, 1.067, "ccw"),
    "Virtual_May19_Train_track": (19.452, 0.733, "ccw"),
    "caecer_loop": (35.091, 1.282, "ccw"),
    "reInvent2019_track": (23.118, 1.067, "ccw"),
    "reInvent2019_wide": (16.635, 1.067, "ccw"),
    "reinvent_base": (17.709, 0.762, "ccw"),
    "reinvent_carpet": (17.709, 0.762, "ccw"),
    "reinvent_concrete": (17.709, 0.762, "ccw"),
    "reinvent_wood": (17.709, 0.762, "ccw"),
}


def test_the_catalogue_is_complete():
    assert set(CATALOGUE) == set(PUBLISHED)


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_course_has_the_published_length_width_and_order(catalogue_track, name):
    length_m, width_m, order = PUBLISHED[name]
    track = catalogue_track(name)
    assert track.name == name
    assert track.length_m == pytest.approx(length_m, rel=0.003)
    assert track.width_m == pytest.approx(width_m, abs=0.002)
    assert track.closed == (order != "open")
    assert track.is_clockwise == (order == "cw")


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_road_is_one_piece_on_which_the_whole_centre_line_lies(catalogue_track, name):
    track = catalogue_track(name)
    assert track.road.geom_type == "Polygon"
    assert len(track.road.interiors) == (1 if track.closed else 0)
    inside = track.points_at(np.linspace(0.001, 0.999, 2000))
    assert track.on_road(inside).all()
    found = track.project(inside)
    widths_m = track.border_distances(inside, found.center).track_width_m
    # Chords across a bend take at most a few millimetres off each side.
    assert widths_m.min() > 0.95 * track.width_m


@pytest.mark.parametrize(
    "name", ["reinvent_base", "Bowtie_track", "Oval_track", "Spain_track", "Straight_track"]
)
def test_a_course_of_knots_passes_within_2_cm_of_the_published_route(catalogue_track, reference, name):
    rows = read_route(reference / f"routes/{name}.npy")
    line = shapely.LineString(catalogue_track(name).waypoints)
    assert shapely.distance(line, shapely.points(rows[:, :2])).max() < 0.02


@pytest.mark.parametrize(
    "name", ["reinvent_base", "Bowtie_track", "Oval_track", "Spain_track", "Straight_track"]
)
def test_a_route_file_takes_the_place_of_the_knots(track_config, reference, name):
    config = track_config("Monaco", f"track.file='{reference}/routes/{name}.npy'")
    track = Track.from_config(config)
    length_m, width_m, order = PUBLISHED[name]
    assert (track.name, track.title) == (name, name)
    assert track.length_m == pytest.approx(length_m, abs=0.001)
    assert track.width_m == pytest.approx(width_m, abs=0.002)
    assert (track.closed, track.is_clockwise) == (order != "open", order == "cw")


@pytest.mark.parametrize("floor", ["carpet", "concrete", "wood"])
def test_the_floors_of_reinvent_share_its_shape_and_differ_in_grip(track_config, floor):
    base: TrackConfig = track_config("reinvent_base")
    other: TrackConfig = track_config(f"reinvent_{floor}")
    assert (other.knots, other.width_m, other.closed) == (base.knots, base.width_m, base.closed)
    assert other.floor.friction != base.floor.friction
    assert other.floor.road_color != base.floor.road_color


def test_a_file_of_knots_names_its_course(track_config, tmp_path):
    path = tmp_path / "Über den Hof.yaml"
    path.write_text("title: Hof\nwidth_m: 0.8\nknots: [[0, 0], [4, 0], [4, 3], [0, 3]]\n", encoding="utf-8")
    track = Track.from_config(track_config("Monaco", f"track.file='{path}'"))
    assert (track.name, track.title, track.closed, track.width_m) == (
        "Über den Hof",
        "Hof",
        True,
        pytest.approx(0.8),
    )


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("tight.yaml", "width_m: 4\nknots: [[0, 0], [9, 0], [9, 1], [0, 1]]", "border"),
        ("few.yaml", "width_m: 1\nknots: [[0, 0], [9, 0], [9, 1]]", "3 knots; accepted are at least 4"),
        ("widths.yaml", "width_m: [1, 2]\nknots: [[0, 0], [9, 0], [9, 9], [0, 9]]", "2 values for 4 knots"),
        ("again.yaml", "width_m: 1\nknots: [[0, 0], [9, 0], [9, 0], [0, 9]]", r"knots\[2\] repeats"),
        ("shut.yaml", "width_m: 1\nknots: [[0, 0], [9, 0], [9, 9], [0, 0]]", "last knot repeats the first"),
        ("road.txt", "", "accepted are .npy"),
        ("missing.npy", None, "No such file"),
    ],
)
def test_a_file_that_makes_no_course_gives_one_line_that_names_it(
    track_config, tmp_path, name, content, complaint
):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    config = track_config("Monaco", f"track.file='{path}'")
    with pytest.raises(BadInput, match=complaint) as caught:
        Track.from_config(config)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "accepted" in str(caught.value)
