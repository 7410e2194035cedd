"""The picture of docs/camera.md: tracks as the camera sees them, and episodes that differ by randomization.

python -m benchmarks.camera_picture
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.race import Race
from deepracer_exp.env.setup import build_setup

OUTPUT = Path(__file__).parents[1] / "docs" / "images" / "camera.png"
TRACKS = (
    "2022_summit_speedway",
    "reinvent_base",
    "Spain_track",
    "Oval_track",
    "reinvent_wood",
    "reinvent_carpet",
    "Bowtie_track",
    "Monaco",
)
STEPS = 6
"""Steps straight ahead until the picture is taken."""
GAP = 4


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    output = parser.parse_args().output
    # The first car is a little before the start line.
    begin = "episode.start_offset=0.965"
    tracks = look(f"track=[{','.join(TRACKS)}]", begin)
    episodes = look("randomization=sim2real")
    rows = [beside(pictures) for pictures in (tracks[:4], tracks[4:], episodes[:4], episodes[4:])]
    width = rows[0].shape[1]
    Image.fromarray(np.vstack(rows)[GAP:, GAP:]).quantize(128).save(output, optimize=True)
    print(f"{output}: {width} pixels wide, {output.stat().st_size / 1e3:.0f} kB")


def look(*overrides: str) -> NDArray[np.uint8]:
    """Return what eight cars see after a few steps, (8, height, width, 3)."""
    setup = build_setup(
        compose_experiment(["observation=camera", "observation.camera.color=rgb", *overrides])[0]
    )
    race = Race(setup, len(TRACKS))
    race.reset()
    for _ in range(STEPS):
        race.step(np.zeros((len(TRACKS), 2)))
    return np.moveaxis(race.pixels, 1, -1)


def beside(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures in a row, with white gaps above and to the left."""
    framed = np.pad(pictures, ((0, 0), (GAP, 0), (GAP, 0), (0, 0)), constant_values=255)
    return np.hstack(list(framed))


if __name__ == "__main__":
    main()
