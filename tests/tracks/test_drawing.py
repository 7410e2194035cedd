import matplotlib.image
import pytest

from deepracer_exp.tracks.drawing import ARROWS, draw_picture, draw_terminal


@pytest.mark.parametrize("name", ["reinvent_base", "Spain_track", "Straight_track", "Monaco"])
@pytest.mark.parametrize(("columns", "rows"), [(60, 16), (100, 12), (12, 30), (2, 2)])
def test_a_terminal_drawing_fits_its_box_and_fills_one_side(catalogue_track, name, columns, rows):
    lines = draw_terminal(catalogue_track(name), columns, rows).split("\n")
    assert len(lines) <= rows
    longest = max(map(len, lines))
    assert longest <= columns
    assert len(lines) == rows or longest >= columns - 1


def test_the_arrow_turns_with_the_direction(catalogue_track):
    def arrow(*course: str) -> set[str]:
        return set(draw_terminal(catalogue_track(*course), 60, 16)) & set(ARROWS)

    assert arrow("reinvent_base") == {"→"}
    assert arrow("reinvent_base", "reversed") == {"←"}


@pytest.mark.parametrize("course", [("Spain_track",), ("Straight_track", "reversed")])
def test_a_picture_shows_the_colours_of_the_floor(catalogue_track, tmp_path, course):
    track = catalogue_track(*course)
    draw_picture(track, tmp_path / "course.png")
    image = (matplotlib.image.imread(tmp_path / "course.png")[..., :3] * 255).round().astype(int)
    assert max(image.shape) > 1000
    for color in (track.floor.road_color, track.floor.ground_color, track.floor.line_color):
        wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
        assert (image == wanted).all(axis=2).mean() > 0.001
