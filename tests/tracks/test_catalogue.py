import pytest

from deepracer_exp.tracks.track import Track
from tests.conftest import refused

# world: published length in metres, median width in metres, order of the points
PUBLISHED = {
    "2022_reinvent_champ_cw": (33.275, 0.95, "cw"),
    "AWS_track": (69.254, 0.838, "ccw"),
    "Bowtie_track": (17.428, 0.724, "ccw"),
    "Monaco": (60.266, 1.449, "cw"),
    "Oval_track": (19.55, 0.666, "ccw"),
    "Spain_track": (59.998, 0.914, "cw"),
    "Straight_track": (5.707, 0.61, "open"),
    "reInvent2019_wide_mirrored": (16.635, 1.067, "ccw"),
    "reinvent_base": (17.709, 0.762, "ccw"),
    "reinvent_wood": (17.709, 0.762, "ccw"),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_course_has_the_published_length_width_and_order(catalogue_track, name):
    length_m, width_m, order = PUBLISHED[name]
    track = catalogue_track(name)
    assert track.name == name
    assert track.length_m == pytest.approx(length_m, abs=0.001)
    assert track.width_m == pytest.approx(width_m, abs=0.001)
    assert track.closed == (order != "open")
    assert track.is_clockwise == (order == "cw")


@pytest.mark.parametrize("name", ["reinvent_base", "Straight_track"])
def test_a_route_file_takes_the_place_of_the_world(track_config, reference, name):
    config = track_config("Monaco", file=f"{reference}/routes/{name}.npy")
    track = Track.from_config(config)
    length_m, width_m, order = PUBLISHED[name]
    assert (track.name, track.title) == (name, name)
    assert track.length_m == pytest.approx(length_m, abs=0.001)
    assert track.width_m == pytest.approx(width_m, abs=0.002)
    assert (track.closed, track.is_clockwise) == (order != "open", order == "cw")


def test_a_file_of_knots_names_its_course(track_config, tmp_path):
    path = tmp_path / "Über den Hof.yaml"
    path.write_text("title: Hof\nwidth_m: 0.8\nknots: [[0, 0], [4, 0], [4, 3], [0, 3]]\n", encoding="utf-8")
    track = Track.from_config(track_config("Monaco", file=str(path)))
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
        ("again.yaml", "width_m: 1\nknots: [[0, 0], [9, 0], [9, 0], [0, 9]]", "knots[2] repeats"),
        ("shut.yaml", "width_m: 1\nknots: [[0, 0], [9, 0], [9, 9], [0, 0]]", "last knot repeats the first"),
        ("road.txt", "", "accepted: .npy"),
        ("missing.npy", None, "No such file"),
    ],
)
def test_a_file_that_makes_no_course_gives_one_line_that_names_it(
    track_config, tmp_path, name, content, complaint
):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    config = track_config("Monaco", file=str(path))
    said = refused(Track.from_config, config)
    assert complaint in said
    assert str(path) in said
    assert "accepted" in said
