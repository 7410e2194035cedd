import numpy as np
import pytest

from deepracer_exp.deepracer.routes import read_knots, read_route
from deepracer_exp.errors import BadInput

STRIP = np.column_stack(
    [np.arange(5.0), np.zeros(5), np.arange(5.0), np.ones(5), np.arange(5.0), -np.ones(5)]
)
SQUARE = "knots: [[0, 0], [4, 0], [4, 4], [0, 4]]\n"


def with_value(value: float) -> np.ndarray:
    rows = STRIP.copy()
    rows[3, 4] = value
    return rows


def test_a_route_comes_back_as_it_was_written(tmp_path):
    path = tmp_path / "Straße 1.npy"
    np.save(path, STRIP)
    np.testing.assert_array_equal(read_route(path), STRIP)


def test_whole_numbers_are_metres_too(tmp_path):
    np.save(tmp_path / "a.npy", STRIP.astype(np.int32))
    assert read_route(tmp_path / "a.npy").dtype == np.float64


def test_rows_that_repeat_the_centre_point_stay(tmp_path):
    rows = STRIP[[0, 0, 1, 2, 2, 3, 4]]
    np.save(tmp_path / "a.npy", rows)
    np.testing.assert_array_equal(read_route(tmp_path / "a.npy"), rows)


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
        (STRIP.astype(str), "str"),
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
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x93NUMPY\x01\x00", b"PK\x03\x04 torn"])
def test_a_file_that_is_no_array_gives_one_line(tmp_path, content):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(BadInput, match="accepted") as caught:
        read_route(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_a_torn_route_gives_one_line(tmp_path):
    np.save(tmp_path / "whole.npy", STRIP)
    (tmp_path / "torn.npy").write_bytes((tmp_path / "whole.npy").read_bytes()[:-9])
    with pytest.raises(BadInput, match="accepted"):
        read_route(tmp_path / "torn.npy")


def test_an_archive_or_a_folder_is_no_route(tmp_path):
    np.savez(tmp_path / "a.npz", rows=STRIP)
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(BadInput, match="not a NumPy array file"):
        read_route(tmp_path / "a.npy")
    with pytest.raises(BadInput, match="folder"):
        read_route(tmp_path)


def test_knots_alone_with_a_width_make_a_closed_course(tmp_path):
    (tmp_path / "a.yaml").write_text(SQUARE + "width_m: 1\n")
    course = read_knots(tmp_path / "a.yaml")
    assert (course.closed, course.title, course.width_m.tolist()) == (True, None, [1.0])
    assert course.knots.shape == (4, 2)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "no keys"),
        ("- 1", "no keys"),
        ("knots: [", "not YAML: .* in line 2"),
        (SQUARE, "width_m is missing"),
        ("width_m: 1", "knots is missing"),
        (SQUARE + "width: 1", r"unknown key 'width' \(did you mean width_m\?\)"),
        (SQUARE + "width_m: 1\n7: 1", "unknown key 7"),
        (SQUARE + "width_m: 0", "width_m has 0"),
        (SQUARE + "width_m: wide", "width_m has 'wide'"),
        (SQUARE + "width_m: [1, .nan]", "width_m has nan"),
        (SQUARE + "width_m: true", "width_m has True"),
        (SQUARE + "width_m: 1\nclosed: maybe", "closed is 'maybe'"),
        (SQUARE + "width_m: 1\ntitle: [a]", "title is"),
        ("width_m: 1\nknots: 5", "knots is 5"),
        ("width_m: 1\nknots: [[0, 0], [1, 2, 3]]", r"knots\[1\] is \[1, 2, 3\]"),
        ("width_m: 1\nknots: [[0, 0], [1, .inf]]", r"knots\[1\] is \[1, inf\]"),
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
    assert "\n" not in str(caught.value)
