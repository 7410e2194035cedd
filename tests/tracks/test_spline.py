import numpy as np
import pytest
import shapely

from deepracer_exp.aws.worlds.routes import rows_from_knots
from deepracer_exp.errors import BadInput

SQUARE = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 6.0], [0.0, 6.0]])


def test_the_line_runs_through_every_knot_of_an_uneven_set():
    knots = np.array([[0.0, 0.0], [5.0, 0.0], [5.5, 0.3], [6.0, 5.0], [0.0, 6.0], [-0.4, 5.5]])
    rows = rows_from_knots(knots, np.array([0.5]), closed=True)
    assert shapely.distance(shapely.LineString(rows[:, :2]), shapely.points(knots)).max() < 0.03


@pytest.mark.parametrize("knots", [SQUARE, SQUARE[::-1]], ids=["counter-clockwise", "clockwise"])
def test_the_inner_border_is_inside_the_ring_in_either_order(knots):
    rows = rows_from_knots(knots, np.array([0.8]), closed=True)
    inner, center, outer = (shapely.Polygon(rows[:, k : k + 2]).area for k in (2, 0, 4))
    assert inner < center < outer


def test_a_width_for_each_knot_is_the_width_at_that_knot():
    widths_m = np.array([0.6, 1.2, 0.9, 0.7])
    rows = rows_from_knots(SQUARE, widths_m, closed=True)
    nearest = [np.linalg.norm(rows[:, :2] - knot, axis=1).argmin() for knot in SQUARE]
    found = np.linalg.norm(rows[nearest, 4:] - rows[nearest, 2:4], axis=1)
    np.testing.assert_allclose(found, widths_m, atol=0.02)


def test_rows_are_evenly_spaced_at_about_15_cm_and_end_in_the_first():
    rows = rows_from_knots(SQUARE, 1.0, closed=True)
    np.testing.assert_array_equal(rows[0], rows[-1])
    step_m = np.linalg.norm(np.diff(rows[:, :2], axis=0), axis=1)
    assert step_m.min() > 0.145
    assert step_m.max() < 0.155


def test_the_border_inside_a_tight_bend_has_no_fold():
    hairpin = np.array([[0.0, 0.0], [5.0, 0.0], [5.6, 0.5], [5.0, 1.0], [0.0, 1.0], [-3.0, 0.5]])
    rows = rows_from_knots(hairpin, np.array([0.9]), closed=True)
    inner = rows[:, 2:4]
    moved = np.r_[True, (np.diff(inner, axis=0) != 0).any(axis=1)]
    assert shapely.LinearRing(inner[moved][:-1]).is_simple
    # A border point is never nearer to the centre line than half the width, chords aside.
    gap_m = shapely.distance(shapely.LinearRing(rows[:-1, :2]), shapely.points(inner))
    assert gap_m.min() > 0.44


def test_a_road_wider_than_the_space_between_its_stretches_is_refused():
    eight = np.array([[0.0, 0.0], [4.0, 4.0], [8.0, 0.0], [8.0, 8.0], [4.0, 4.5], [0.0, 8.0]])
    with pytest.raises(BadInput, match="a border crosses itself at"):
        rows_from_knots(eight, np.array([1.5]), closed=True)
