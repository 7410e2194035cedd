"""Laws of route files and files of knots; tests/test_user_files.py has those of hostile files."""

import numpy as np
import pytest

from deepracer_exp.aws.worlds.routes import read_knots, read_route
from deepracer_exp.errors import BadInput

STRIP = np.column_stack(
    [np.arange(5.0), np.zeros(5), np.arange(5.0), np.ones(5), np.arange(5.0), -np.ones(5)]
)
SQUARE = "knots: [[0, 0], [4, 0], [4, 4], [0, 4]]\n"


def with_value(value: float) -> np.ndarray:
    rows = STRIP.copy()
    rows[3, 4] = value
    return rows


@pytest.mark.parametrize("rows", [STRIP, STRIP.astype(np.int32), STRIP[[0, 0, 1, 2, 2, 3, 4]]])
def test_a_route_comes_back_as_it_was_written(tmp_path, rows):
    path = tmp_path / "Straße 1.npy"
    np.save(path, rows)
    np.testing.assert_array_equal(read_route(path), rows)
    assert read_route(path).dtype == np.float64


@pytest.mark.parametrize(
    ("array", "complaint"),
    [
        (STRIP[:, :5], r"shape \(5, 5\)"),
        (STRIP.ravel(), r"shape \(30,\)"),
        (STRIP[:2], "2 distinct rows"),
        (STRIP[:0], "0 distinct rows"),
        (STRIP[[0, 0, 0, 1]], "2 distinct rows"),
        (STRIP[[0, 1, 0]], "closed course"),
        (with_value(np.nan), "row 3, column 4 is nan"),
        (with_value(-np.inf), "row 3, column 4 is -inf"),
        (with_value(2e5), r"row 3, column 4 is 200000"),
        (STRIP.astype(complex), "complex128"),
        (STRIP > 0, "bool"),
        (STRIP.astype(object), "not a NumPy array file"),
    ],
)
def test_a_malformed_route_gives_one_line_that_names_the_file(tmp_path, array, complaint):
    path = tmp_path / "route.npy"
    np.save(path, array)
    with pytest.raises(BadInput, match=complaint) as caught:
        read_route(path)
    assert str(path) in str(caught.value)
    assert "accepted" in str(caught.value)


def test_knots_alone_with_a_width_make_a_closed_course(tmp_path):
    (tmp_path / "a.yaml").write_text(SQUARE + "width_m: 1\n")
    course = read_knots(tmp_path / "a.yaml")
    assert (course.closed, course.title, course.width_m) == (True, None, 1.0)
    assert course.knots == ((0, 0), (4, 0), (4, 4), (0, 4))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("- 1", "should be an object"),
        ("knots: [", "not YAML: .* in line 2"),
        (SQUARE, "width_m: .*required"),
        (SQUARE + "width_m: 1\nwidth: 1", "width: Unexpected"),
        (SQUARE + "width_m: 1\n7: 1", "7: Unexpected"),
        (SQUARE + "width_m: 0", "width_m: .* greater than 0"),
        (SQUARE + "width_m: wide", "width_m: .* valid number"),
        (SQUARE + "width_m: true", "width_m: .* valid number"),
        (SQUARE + "width_m: [1, .nan]", "width_m: "),
        (SQUARE + "width_m: 1\nclosed: maybe", "closed: .* valid boolean"),
        ("width_m: 1\nknots: 5", "knots: "),
        ("width_m: 1\nknots: [[0, 0], [1, 2, 3]]", r"knots: 1: "),
        ("width_m: 1\nknots: [[0, 0], [1, .inf]]", r"knots: 1: 1: "),
        ("width_m: 1\nknots: !!python/object/apply:os.getcwd []", "not YAML"),
    ],
)
def test_a_malformed_file_of_knots_gives_one_line_that_names_it(tmp_path, content, complaint):
    path = tmp_path / "course.yaml"
    path.write_text(content)
    with pytest.raises(BadInput, match=complaint) as caught:
        read_knots(path)
    assert str(path) in str(caught.value)
    assert "accepted" in str(caught.value)
