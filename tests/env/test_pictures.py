import numpy as np
import pytest
import shapely

from deepracer_exp.config.driving import FloorConfig, PictureRandomizationConfig
from deepracer_exp.env.pictures import GREY, floor_colors
from deepracer_exp.env.randomization.picture_randomization import (
    QUANTITIES,
    PictureRandomization,
)
from deepracer_exp.sim.scenery import MATERIALS, box_corners, paved_area, wall_ring
from tests.env.conftest import drive_and_see

SMALL = "observation=camera_small"
OFF = {name: [1, 1] if name.endswith("_scale") else [0, 0] for name in QUANTITIES}
"""Ranges that change nothing."""


def written(ranges: dict[str, list[float]]) -> str:
    return "{" + ",".join(f"{name}:[{low},{high}]" for name, (low, high) in ranges.items()) + "}"


def lens(k1: float) -> str:
    return f"randomization.pictures={written({'lens_k1': [k1, k1]})}"


def test_without_a_camera_nothing_is_drawn(race_of):
    race = race_of(n_cars=2)
    assert set(race.seen) == {"observation"}
    assert race.pixels.size == 0


@pytest.mark.parametrize(
    ("overrides", "shape"),
    [
        (["observation=camera"], (1, 120, 160)),
        ([SMALL, "observation.camera.color=rgb"], (3, 60, 80)),
        ([SMALL, "observation.camera.frames=3"], (3, 60, 80)),
        (["observation=stereo", "observation.camera.frames=2"], (4, 120, 160)),
    ],
)
def test_the_picture_has_the_shape_that_was_asked_for(race_of, overrides, shape):
    assert race_of(*overrides, n_cars=2).pixels.shape == (2, *shape)


def test_grey_is_the_services_mixture_of_red_green_and_blue(race_of):
    grey, rgb = (race_of(SMALL, f"observation.camera.color={color}").pixels[0] for color in ("grey", "rgb"))
    mixed = np.einsum("chw,c->hw", rgb.astype(float), GREY)
    assert np.abs(mixed - grey[0]).max() < 1.01


def test_a_started_car_has_seen_its_first_picture_all_along_and_then_the_last_ones(race_of):
    race = race_of(SMALL, "observation.camera.frames=3")
    first = race.pixels[0]
    assert np.array_equal(first[0], first[1])
    assert np.array_equal(first[1], first[2])
    one = race_of(SMALL)
    newest = [seen["pixels"][0, 0] for seen in drive_and_see(one, 8)]
    stacks = [seen["pixels"][0] for seen in drive_and_see(race, 8)]
    for at in range(2, 8):
        assert np.array_equal(stacks[at], np.stack(newest[at - 2 : at + 1]))
    assert not np.array_equal(newest[-1], newest[-2])


def test_two_cameras_see_what_one_sees_from_either_side(race_of):
    """Half the distance to the left: what lies ahead moves to the right."""
    left, right = race_of("observation=stereo").pixels[0].astype(int)
    assert not np.array_equal(left, right)
    middle = race_of("observation=camera").pixels[0, 0].astype(int)
    row = 80  # about 0.3 m ahead
    shifts = range(-20, 21)

    def shift_of(picture: np.ndarray) -> int:
        return min(
            shifts, key=lambda by: np.abs(np.roll(middle[row], by)[30:130] - picture[row, 30:130]).sum()
        )

    assert shift_of(left) > 0 > shift_of(right)


def test_a_dropped_observation_repeats_the_picture_too(race_of):
    race = race_of(SMALL, "randomization.observation_dropout=[0.5,0.5]", n_cars=40)
    repeated = np.zeros((2, 40), bool)
    for _ in range(10):
        pixels, features = race.pixels, race.observation
        race.step(np.full(40, 7))
        repeated[0] = (race.pixels == pixels).all(axis=(1, 2, 3))
        repeated[1] = (race.observation == features).all(axis=1)
    assert np.array_equal(*repeated)
    assert 5 < repeated[0].sum() < 35


def test_a_car_that_accelerates_looks_up(race_of):
    """Its nose rises, so the horizon sinks in the picture."""
    flat, leaning = (race_of(SMALL, f"car.tilt_deg_per_mps2={tilt}") for tilt in (0, 2))
    for race in (flat, leaning):
        drive_and_see(race, 3)
    ahead = leaning._batch.acceleration_mps2[0, 0]
    assert ahead > 0.3
    wall = [(race.pixels[0, 0] < 60).argmin(axis=0).mean() for race in (flat, leaning)]
    assert wall[1] > wall[0]


def test_every_material_has_a_colour_of_its_floor():
    floor = FloorConfig(friction=1.0, road_color="#102030", ground_color="#405060", line_color="#708090")
    colors = dict(zip(MATERIALS, floor_colors(floor).tolist(), strict=True))
    assert colors["road"] == [16, 32, 48]
    assert colors["field"] == [64, 80, 96]
    assert colors["line"] == [112, 128, 144]
    assert colors["far_dash"] == [(a + b) / 2 for a, b in zip(colors["road"], colors["dash"], strict=True)]


VARIED = (SMALL, "randomization=sim2real")
AMONG = ("race=head_to_bot", "race.boxes.number=2", "track=reInvent2019_track")


def test_light_differs_from_episode_to_episode_and_car_to_car(race_of):
    race = race_of(*VARIED, "episode.start_advance=0", n_cars=6)
    first = race.pixels
    assert len(np.unique(first.mean(axis=(1, 2, 3)).round(2))) == 6
    race.reset()
    assert (np.abs(race.pixels.mean(axis=(1, 2, 3)) - first.mean(axis=(1, 2, 3))) > 0.1).all()


@pytest.mark.parametrize(
    ("quantity", "low", "high", "law"),
    [
        ("brightness_scale", 0.5, 2.0, lambda a, b: b.mean() > 2.5 * a.mean()),
        ("contrast_scale", 0.5, 2.0, lambda a, b: b.std() > 1.5 * a.std()),
        ("gamma_scale", 0.5, 2.0, lambda a, b: b.mean() < 0.7 * a.mean()),
        ("blur", 0.0, 1.0, lambda a, b: np.abs(np.diff(b)).max() < 0.8 * np.abs(np.diff(a)).max()),
        ("pixel_noise", 0.0, 0.1, lambda a, b: 15 < (b - a)[20:].std() < 30),
        ("light", 0.0, 0.9, lambda a, b: np.abs(b - a).max() > 20),
        ("dirt", 0.0, 1.0, lambda a, b: (b <= a).all() and (a - b).max() > 20),
        ("objects", 0, 40, lambda a, b: np.abs(b - a).mean() > 1),
        ("color_noise", 0.0, 0.9, lambda a, b: np.abs(b - a).max() > 20),
        # A higher camera that looks down further, and a wider lens, see the wall's foot in another row.
        ("height_m", 0.0, 0.1, lambda a, b: np.abs(b - a).mean() > 3),
        ("pitch_deg", 0.0, 10.0, lambda a, b: horizon(b) < horizon(a) - 5),
        ("field_of_view_scale", 0.5, 2.0, lambda a, b: np.abs(b - a).mean() > 3),
        ("lens_k1", 0.0, 0.3, lambda a, b: np.abs(b - a).mean() > 3),
    ],
)
def test_each_quantity_does_what_it_says(race_of, quantity, low, high, law):
    """Pictures at the start, with this one alone at its lowest and highest value."""
    pictures = []
    for value in (low, high):
        alone = written({quantity: [value, value]})
        # Walls so far away that there is sky above them.
        race = race_of(SMALL, f"randomization.pictures={alone}", "track.floor.walls_beyond_m=0.91")
        pictures.append(race.pixels[0, 0].astype(float))
    assert law(*pictures)


def test_a_line_keeps_its_colour_where_it_is_drawn_for_the_distance():
    varied = PictureRandomization([PictureRandomizationConfig(color_noise=(0.3, 0.3))] * 4, range(4), [])
    varied.seed(0)
    cars = np.arange(4)
    varied.begin(cars, np.zeros(4, np.int64), np.zeros(4, np.intp))
    seen = varied.colors(cars, np.full((4, len(MATERIALS), 3), 100, np.float32))
    assert len(np.unique(seen[:, [MATERIALS.index(name) for name in ("dash", "kerb", "start")]])) == 36
    for name in ("dash", "kerb", "start"):
        assert (seen[:, MATERIALS.index(f"far_{name}")] == seen[:, MATERIALS.index(name)]).all()


def by_lens(k1: float, width: int = 160, height: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel looks: columns and rows from the middle of a pinhole's picture."""
    y, x = np.mgrid[:height, :width] + 0.5 - np.array([height / 2, width / 2])[:, None, None]
    scale = 1 + k1 * (x**2 + y**2) / (width**2 + height**2) * 4
    return x * scale, y * scale


@pytest.mark.parametrize("k1", [-0.3, 0.3])
def test_a_lens_shows_what_a_pinhole_shows_at_the_formulas_place(race_of, k1):
    bent = race_of("observation=camera", lens(k1))
    pinhole = race_of("observation=camera", "observation.camera.width=640", "observation.camera.height=480")
    large = pinhole.pixels[0, 0].astype(float)

    def difference(k1: float) -> float:
        x, y = by_lens(k1)
        within = (np.abs(x) < 79) & (np.abs(y) < 59)
        at = (4 * (y + 60)).astype(int).clip(0, 479), (4 * (x + 80)).astype(int).clip(0, 639)
        return float(np.abs(large[at] - bent.pixels[0, 0])[within].mean())

    assert difference(k1) < 0.3 * difference(0.0)


@pytest.mark.parametrize("k1", [-0.2, 0.2])
def test_a_straight_line_off_the_middle_bends_by_the_formulas_amount(race_of, k1):
    race = race_of("observation=camera", lens(k1))
    mount, everyone = race._pictures._lenses[0].mount, np.arange(1)
    focal = race._varied.mounts(everyone, mount)[0, 4] / mount[4]
    brightness = np.clip(100 + 20 * (np.arange(160) - 79.5 - 50 * focal), 0, 200)
    line = np.tile(brightness, (1, 1, 120, 1)).round().astype(np.uint8)  # its middle 50 pixels to the right
    bent = race._varied.disturb(everyone, line, np.zeros(1, np.int64))[0, 0].astype(float)
    columns = [np.interp(100, row[:159], np.arange(159) - 79.5) for row in bent]
    x, _ = by_lens(k1)
    expected = [np.interp(50, row, np.arange(160) - 79.5) for row in x]
    assert np.ptp(expected) > 2.5
    assert columns == pytest.approx(expected, abs=0.15)


def test_each_of_two_cameras_shows_its_own_picture_through_the_lens(race_of):
    pair, straight = race_of("observation=stereo", lens(0.2)), race_of("observation=stereo")
    start, road = pair._batch.read(), np.zeros(1, np.intp)
    for eye, seen, plain in zip(pair._pictures._lenses, pair.pixels[0], straight.pixels[0], strict=True):
        alone = race_of("observation=camera", lens(0.2))
        alone._pictures._lenses = [eye]
        assert np.array_equal(alone._pictures.first(np.arange(1), start, road)[0, 0], seen)
        assert not np.array_equal(seen, plain)
    assert not np.array_equal(*pair.pixels[0])


def test_a_lens_changes_no_other_draw(race_of):
    plain, bent = (
        race_of(*VARIED, f"randomization.pictures.lens_k1=[{k1},{k1}]", n_cars=4) for k1 in (0, 0.1)
    )
    place = QUANTITIES.index("lens_k1")
    assert np.array_equal(*(np.delete(race._varied._values, place, axis=1) for race in (plain, bent)))
    for name in ("_boxes", "_dirt", "_spot", "_color_factor", "_noise_start"):
        assert np.array_equal(getattr(plain._varied, name), getattr(bent._varied, name))


def test_boxes_and_bots_look_different_in_every_episode_and_stand_where_they_stand(race_of):
    race = race_of(*VARIED, *AMONG, n_cars=3)
    ids = np.arange(3)
    looks = []
    for _ in range(2):
        plain = race.others.boxes(ids)
        varied = race._varied.others(ids, plain)
        np.testing.assert_array_equal(varied[..., :3], plain[..., :3])
        scale = varied[..., 3:6] / plain[..., 3:6]
        np.testing.assert_allclose(scale, np.broadcast_to(scale[..., :1], scale.shape), rtol=1e-5)
        assert scale.min() >= 0.85 - 1e-5
        assert scale.max() <= 1.15 + 1e-5
        looks.append(varied[..., 3:])
        race.reset()
    both = np.concatenate(looks)
    assert len(np.unique(both[..., 0])) == both[..., 0].size
    assert (np.ptp(both[..., 3:], axis=0) > 0).any()


def test_the_looks_of_others_change_no_other_draw(race_of):
    alone = race_of(*VARIED, "track=reInvent2019_track", n_cars=4)
    among = race_of(*VARIED, *AMONG, n_cars=4)
    for name in ("_values", "_boxes", "_dirt", "_spot", "_color_factor", "_noise_start"):
        assert np.array_equal(getattr(alone._varied, name), getattr(among._varied, name))


@pytest.mark.parametrize("track", ["reinvent_base", "Spain_track"])
def test_objects_stand_beside_the_road_between_the_walls_and_apart(race_of, track):
    race = race_of(*VARIED, f"track={track}", "randomization.pictures.objects=[9,9]", n_cars=8)
    boxes = race._varied.boxes(np.arange(8))
    course = race.setup.track
    walls = shapely.Polygon(wall_ring(course))
    for car in boxes:
        standing = car[car[:, 5] > 0]
        areas = shapely.polygons(box_corners(standing.astype(float)))
        assert len(areas) > 2
        assert (shapely.distance(areas, paved_area(course)) > 0.04).all()
        assert (shapely.distance(areas, walls.exterior) > 0.04).all()
        assert shapely.contains(walls, areas).all()
        assert len(shapely.STRtree(areas).query(areas, "intersects")[0]) == len(areas)
    assert len(np.unique(boxes[:, :, 0])) > 20
    race.reset(np.array([1]))
    again = race._varied.boxes(np.arange(8))
    assert not np.array_equal(again[1], boxes[1])
    assert np.array_equal(again[[0, 2]], boxes[[0, 2]])


def horizon(picture: np.ndarray) -> float:
    return float((picture < 60).argmin(axis=0).mean())


def test_pictures_without_randomization_are_those_with_ranges_that_change_nothing(race_of):
    plain = race_of(SMALL)
    nothing = race_of(SMALL, f"randomization.pictures={written(OFF)}")
    np.testing.assert_equal(drive_and_see(plain, 5), drive_and_see(nothing, 5))
