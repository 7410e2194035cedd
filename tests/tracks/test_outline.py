import numpy as np
import pytest
import shapely

from deepracer_exp.tracks.outline import Outline, draw_track, extent


@pytest.mark.parametrize("course", [("reinvent_base",), ("Spain_track", "reversed"), ("Straight_track",)])
def test_the_road_that_is_drawn_is_the_road_that_the_rules_know(catalogue_track, course):
    track = catalogue_track(*course)
    outline = Outline.of(track)
    low, high = outline.corners(0.3)
    random = np.random.default_rng(0)
    points = random.uniform(low, high, (4000, 2))
    # Beside the border the width of its line decides.
    points = points[shapely.distance(track.road.boundary, shapely.points(points)) > 0.05]
    road = track.on_road(points)
    assert 0.05 < road.mean() < 0.95
    # Even-odd: each ring turns road into ground and ground into road.
    rings = [shapely.contains_xy(shapely.Polygon(ring), *points.T) for ring in outline.rings]
    assert (np.logical_xor.reduce(rings) == road).all()
    assert [shapely.is_ccw(shapely.LinearRing(ring)) for ring in outline.rings] == [True, False][: len(rings)]

    image = np.asarray(draw_track(track, 60.0))
    x, y = ((points - extent(track)[0]) * 60.0).astype(int).T
    pixels = image[len(image) - 1 - y, x]
    ground = np.array(list(bytes.fromhex(track.floor.ground_color[1:])))
    assert ((pixels == ground).all(axis=1) == ~road).mean() > 0.999
