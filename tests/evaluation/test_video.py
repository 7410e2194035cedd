import ctypes.util
import os

import numpy as np
import pytest
from imageio_ffmpeg import read_frames

from deepracer_exp.runs.run_files import read_config

AHEAD = (
    *("race=object_avoidance", "race.boxes.placement=fixed", "observation.next_objects=1"),
    "race.boxes.positions=[{lap: 0.07, lane: inner}]",
)
"""A box where the car sees it at its start."""
drawable = os.environ.get("MUJOCO_GL") or any(map(ctypes.util.find_library, ("EGL", "OSMesa")))


@pytest.mark.slow
@pytest.mark.skipif(not drawable, reason="this machine has neither EGL nor OSMesa")
@pytest.mark.parametrize(
    ("sees", "given", "box"),
    [
        ((), (), False),
        (("observation=camera", "budget.env_steps=256"), ("evaluation=real_car",), False),
        (AHEAD, (), True),
    ],
)
def test_a_film_shows_the_car_on_its_way_and_what_is_on_the_road(copied, start, tmp_path, sees, given, box):
    """As fast as it drove, also where it acts more often than in the simulator."""
    folder = copied(*sees)
    ended = start(
        *("evaluate", str(folder), *given, "evaluation.trials=1", "evaluation.time_s=2"),
        *("evaluation.held_out=null", "--video", "lap.mp4"),
    ).end()
    assert ended.code == 0, ended.stderr
    frames = read_frames(str(tmp_path / "lap.mp4"))
    about = next(frames)
    assert about["fps"] == 30
    width, height = about["size"]
    pictures = [np.frombuffer(frame, np.uint8).reshape(height, width, 3).astype(int) for frame in frames]
    # Two seconds, or less where the car leaves the road, and the last picture a second more.
    assert 30 < len(pictures) <= 3 * 30 + 2
    road = np.array(list(bytes.fromhex(read_config(folder)["track"]["floor"]["road_color"][1:])))
    seen = (np.abs(pictures[0] - road).max(axis=2) < 12).mean()
    assert seen > 0.02, "no road to be seen"
    assert np.abs(pictures[0] - pictures[-1]).max() > 60, "nothing moves"
    corner = pictures[0][:140, :350]
    assert (corner.min(axis=2) > 230).sum() > 100, "no figures to be seen"
    red, green, blue = pictures[0].transpose(2, 0, 1) / np.maximum(pictures[0][..., 1], 1)
    brown = (np.abs(red - 123 / 97) < 0.06) & (np.abs(blue - 79 / 97) < 0.06) & (green > 0)
    assert bool(brown.sum() > 2000) is box
