"""The best lap of an evaluation as a film."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from imageio_ffmpeg import write_frames
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import track as with_progress

from deepracer_exp.env.race import Race
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.formats.trace import PACKED

from .evaluator import Evaluator
from .result import USUAL, Evaluation
from .scene import Scene, View
from .stewards import Attempt, Stewards

WIDTH, HEIGHT = 960, 544
"""Multiples of 16, as video codecs want them."""
_LINGER_S = 1.0
"""The last picture stays so long."""
_COLUMNS = [PACKED[name] for name in ("X", "Y", "yaw", "steer", "speed_mps", "progress")]


@dataclass(frozen=True)
class _Moment:
    """One control step of all trials."""

    rows: NDArray[np.float64]
    """Columns `_COLUMNS`, (N, 6)."""
    clock_s: NDArray[np.float64]


class Film:
    """Records all trials while they are driven, and then films the best lap."""

    def __init__(self, evaluator: Evaluator, file: Path, view: View):
        """Remember what is to be filmed.

        Args:
            evaluator: what will be driven.
            file: an .mp4 to write.
            view: from behind the car, or from above.

        Raises:
            BadInput: the file is no .mp4, or its folder is not there.
        """
        if file.suffix != ".mp4" or not file.parent.is_dir():
            raise BadInput(f"--video {file}: an .mp4 in a folder that is there is wanted")
        self.file, self._view = file, view
        self._evaluator = evaluator
        self._moments: list[_Moment] = []

    def record(self, race: Race, stewards: Stewards) -> None:
        """Take note of one control step."""
        self._moments.append(_Moment(race.trace[:, _COLUMNS], stewards.clock_s.copy()))

    def write(self, evaluation: Evaluation, told: Console) -> None:
        """Film the fastest lap on the usual conditions, or the one that came furthest where none is complete.

        Raises:
            RunFailed: the file cannot be written.
        """
        best = max(
            evaluation.on(USUAL).attempts, key=lambda a: (a.complete, -a.time_s if a.complete else a.progress)
        )
        trial, setup = self._evaluator.trials[best.trial], self._evaluator.race.setup
        course = setup.courses[trial.course]
        hertz = setup.car.control_hz
        rows = self._lap(best)
        driven_m = np.cumsum(rows[:, 4]) / hertz
        title = f"{course.tracks[0].title} · {trial.condition.replace('_', ' ')}"
        with Scene(course.tracks[0], setup.car, self._view, WIDTH, HEIGHT) as scene:
            writer = write_frames(str(self.file), (WIDTH, HEIGHT), fps=hertz, quality=8, macro_block_size=16)
            try:
                writer.send(None)
                for at in with_progress(range(len(rows)), "filming", console=told, transient=True):
                    x, y, yaw_deg, steer_deg, speed_mps, progress, clock_s = rows[at]
                    picture = scene.draw(x, y, np.radians(yaw_deg), np.radians(steer_deg), driven_m[at])
                    frame = _overlay(picture, title, clock_s - best.begin_s, speed_mps, progress)
                    writer.send(frame)
                for _ in range(round(_LINGER_S * hertz)):
                    writer.send(frame)
            except OSError as error:
                raise RunFailed(f"{self.file}: cannot be written: {error.strerror or error}") from error
            finally:
                writer.close()

    def _lap(self, lap: Attempt) -> NDArray[np.float64]:
        """Return the rows of a lap, columns `_COLUMNS` and the race clock."""
        rows = np.array([np.r_[m.rows[lap.trial], m.clock_s[lap.trial]] for m in self._moments])
        clock_s = rows[:, -1]
        # The clock of a trial that is over stands still.
        going = np.r_[True, np.diff(clock_s) > 0]
        return rows[going & (clock_s >= lap.begin_s - 1e-9) & (clock_s <= lap.begin_s + lap.time_s + 1e-9)]


def _overlay(
    picture: NDArray[np.uint8], title: str, lap_s: float, speed_mps: float, progress: float
) -> NDArray[np.uint8]:
    """Write lap time, speed and progress on a picture."""
    image = Image.fromarray(picture).convert("RGBA")
    shade = Image.new("RGBA", image.size)
    draw = ImageDraw.Draw(shade)
    large, small = _font(34), _font(18)
    right = 330
    draw.rounded_rectangle((16, 16, right + 14, 122), 10, fill=(0, 0, 0, 150))
    draw.text((30, 22), title, font=small, fill=(235, 235, 235, 255))
    white = (255, 255, 255, 255)
    # Flush right, so that the figures do not jump.
    draw.text((150, 46), f"{lap_s:.2f} s", font=large, fill=white, anchor="ra")
    draw.text((right, 46), f"{max(speed_mps, 0.0):.2f} m/s", font=large, fill=white, anchor="ra")
    # A flying lap begins with the last pose of the one before, which shows that lap's end.
    share = float(np.clip(progress, 0.0, 100.0)) / 100 if lap_s > 0 else 0.0
    draw.rectangle((30, 98, right, 108), fill=(255, 255, 255, 60))
    draw.rectangle((30, 98, 30 + (right - 30) * share, 108), fill=(245, 166, 35, 255))
    framed: NDArray[np.uint8] = np.asarray(Image.alpha_composite(image, shade).convert("RGB"))
    return np.ascontiguousarray(framed)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)
