"""The pictures of docs/camera.md and docs/randomization.md: tracks as the camera sees them, and differing episodes.

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

OUTPUT = Path(__file__).parents[1] / "docs" / "images"
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
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=OUTPUT, help="their folder")
    folder = parser.parse_args().output
    # The first car is a little before the start line.
    tracks = look(f"track=[{','.join(TRACKS)}]", "episode.start_offset=0.965")
    for name, pictures in (("camera", tracks), ("randomization", look("randomization=sim2real"))):
        rows = [beside(pictures[:4]), beside(pictures[4:])]
        file = folder / f"{name}.png"
        Image.fromarray(np.vstack(rows)[GAP:, GAP:]).quantize(128).save(file, optimize=True)
        print(f"{file}: {file.stat().st_size / 1e3:.0f} kB")


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
