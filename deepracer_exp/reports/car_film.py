"""The film of a physical car's drive: what it saw, how sure it was of each action, what it did."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.console import Console

from deepracer_exp.analysis.car_drive import UNSURE, Decisions, action_names, in_order, lead, side
from deepracer_exp.aws.logs.car_log import CarLog
from deepracer_exp.evaluation.film import FRAMES_PER_S, write_film

from .car_drive import DrivenPolicy, grey_pictures
from .sight import saliency, under_heat
from .watch import HEIGHT, WIDTH, draw_label, font_of

_EYE = (480, 360)
"""Room for a picture, and as much below it for where a policy of ours looks."""
_PAGE, _RULE, _INK, _FAINT, _CAR, _POLICY = "#14171a", "#343a42", "#f2f4f6", "#98a1ac", "#5b87b8", "#f5a623"
_LONGEST_S = 1.0
"""Time for which a picture is shown at most: the car may stand for 15 s before it closes its log."""
_MARGIN = 32


class DriveFrames:
    """Draws the frames of a drive, `FRAMES_PER_S` a second; each shows the newest picture.

    On the left the picture and, with a policy of ours, where it looks; on the right the probability of each action
    (of the policy an outline), steering and throttle.
    """

    def __init__(self, log: CarLog, policy: DrivenPolicy | None) -> None:
        """Let the policy decide on all pictures."""
        self._log, self._policy = log, policy
        self._decisions: Decisions | None = None if policy is None else policy.decisions(log)
        self._lead, self._order, self._names = lead(log), in_order(log), action_names(log)
        shown_s = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(log.time_s), _LONGEST_S))])
        frames_s = np.arange(0.0, shown_s[-1] + 0.5 / FRAMES_PER_S, 1 / FRAMES_PER_S)
        self._row = np.searchsorted(shown_s, frames_s + 1e-6, side="right") - 1

    def __len__(self) -> int:
        return len(self._row)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        last, frame = -1, np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for row in self._row.tolist():
            if row != last:
                frame = np.asarray(self._draw(row))
            last = row
            yield frame

    def _draw(self, row: int) -> Image.Image:
        frame = Image.new("RGB", (WIDTH, HEIGHT), _PAGE)
        draw = ImageDraw.Draw(frame)
        grey = np.concatenate(list(grey_pictures(self._log, row)), axis=1)
        picture, height = Image.fromarray(grey), _EYE[0] * grey.shape[0] // grey.shape[1]
        frame.paste(picture.resize((_EYE[0], height), Image.Resampling.NEAREST), (0, 0))
        words = [(0, "what it saw")]
        if self._policy is not None:
            acted = self._policy.see(self._log, np.array([row]))[0]
            heat = saliency(self._policy.networks, acted, self._policy.camera)
            frame.paste(under_heat(picture, heat, (_EYE[0], height)), (0, _EYE[1]))
            words.append((_EYE[1], f"where {self._policy.name} looks"[:60]))
        for top, text in words:
            draw_label(ImageDraw.Draw(frame, "RGBA"), (10, top + 8), text)
        self._draw_head(draw, row)
        if self._log.is_discrete:
            self._draw_actions(draw, row)
        self._draw_scale(draw, row, 570, "steering", self._log.steering, -1.0)
        self._draw_scale(draw, row, 660, "throttle", self._log.throttle, 0.0)
        return frame

    def _draw_head(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        left, end = _EYE[0] + _MARGIN, WIDTH - _MARGIN
        draw.text((left, 20), self._log.name[:40], font=font_of(18), fill=_INK)
        draw.text((end, 16), f"{self._log.time_s[row]:.2f} s", font=font_of(26), fill=_INK, anchor="ra")
        if self._lead[row] < UNSURE:
            draw.text((end - 160, 16), "hesitates", font=font_of(26), fill=_POLICY, anchor="ra")

    def _draw_actions(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        """Draw a bar for each action, from left to right as it steers."""
        left, width, top, bottom = _EYE[0] + _MARGIN, WIDTH - _EYE[0] - 2 * _MARGIN, 100, 450
        draw.text((left, 64), "probability of each action", font=font_of(15), fill=_FAINT)
        step = width / len(self._order)
        other = None if self._decisions is None else self._decisions.outputs
        if other is not None and other.shape != self._log.outputs.shape:
            other = None
        for place, action in enumerate(self._order.tolist()):
            middle, half = left + (place + 0.5) * step, 0.4 * step
            begin, end = middle - half, middle + half
            draw.line((begin, bottom, end, bottom), fill=_RULE)
            level = bottom - (bottom - top) * float(self._log.outputs[row, action])
            draw.rectangle((begin, level, end, bottom), fill=_CAR)
            if other is not None:
                level = bottom - (bottom - top) * float(other[row, action])
                draw.rectangle((begin, level, end, bottom), outline=_POLICY, width=2)
            number, _, what = self._names[action].partition(": ")
            words = (number, *what.split(" ")) if step > 44 else (number,)
            for line, text in enumerate(words):
                size = 13 if line == 0 else 11
                draw.text(
                    (middle, bottom + 6 + 16 * line), text, font=font_of(size), fill=_FAINT, anchor="ma"
                )

    def _draw_scale(
        self,
        draw: ImageDraw.ImageDraw,
        row: int,
        y: int,
        name: str,
        driven: NDArray[np.float64],
        low: float,
    ) -> None:
        """Draw steering or throttle, a share from `low` to 1, of the car and of the policy."""
        begin, end = _EYE[0] + _MARGIN, WIDTH - _MARGIN
        draw.rounded_rectangle((begin, y - 4, end, y + 4), 4, fill=_RULE)
        values = [("the car", float(driven[row]), _CAR)]
        if self._decisions is not None:
            values.append(("policy", float(vars(self._decisions)[name][row]), _POLICY))
        for place, (who, value, color) in enumerate(values):
            if not np.isfinite(value):
                continue
            share = (min(max(value, low), 1.0) - low) / (1.0 - low)
            # Left is left: the scale of the steering runs from full lock to the left to that to the right.
            x = begin + (end - begin) * (1.0 - share if low < 0 else share)
            draw.ellipse((x - 9, y - 9, x + 9, y + 9), fill=color)
            text = side(value) if low < 0 else f"{value:.0%}"
            draw.text(
                (begin + 300 * place, y - 38),
                f"{name}, {who}: {text}",
                font=font_of(16),
                fill=color,
                anchor="la",
            )


def film_drive(file: Path, log: CarLog, policy: DrivenPolicy | None, err: Console) -> None:
    """Write the film of a drive (.mp4).

    Raises:
        BadInput: a picture is corrupt.
        RunFailed: the file cannot be written.
    """
    frames = DriveFrames(log, policy)
    write_film(file, frames, len(frames), (WIDTH, HEIGHT), err)
