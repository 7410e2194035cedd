"""Recorded frames of the service's camera are explained by the pictures of the place where they were taken."""

from benchmarks import camera
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.pictures import GREY, floor_colors
from deepracer_exp.sim.scenery import build_scenery
from deepracer_exp.tracks.track import Track


def test_the_light_on_the_walls_tells_the_two_halves_of_a_track_apart(reference):
    """Half a lap further on re:Invent 2018 has nearly the same bends; a right-hand one is there only once."""
    frames = camera.read_frames(reference / "camera_frames")[52:64:3]
    config = compose_experiment([f"track={camera.FRAMES_TRACK}"])[0].tracks[camera.FRAMES_TRACK]
    track = Track.from_config(config)
    lens = camera.service_lens(camera.WIDTH, camera.HEIGHT)
    colors = floor_colors(track.floor) @ GREY
    found = camera.compare_frames(frames, lens, track, build_scenery(track), colors)
    assert found["wrong_places"] == 0
    assert found["worst_of_255"] < 8
    assert found["edge_error_px"] < 1


def test_each_wall_of_a_rectangle_has_its_own_light():
    floor = compose_experiment(["track.floor.walls_light=[0.0,0.5,1.0,5.0]"])[0].track.floor
    colors = floor_colors(floor)
    low_x, low_y, high_x, high_y = (
        colors[camera.MATERIALS.index(f"wall_{side}")] for side in ("low_x", "low_y", "high_x", "high_y")
    )
    assert (low_x == 0).all()
    assert (low_y == 0.5 * high_x).all()
    assert high_y.max() == 255
