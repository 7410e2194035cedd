"""The command `watch`: a film of a policy's view, saliency, decisions and driving."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from tensordict import TensorDict
from torch import nn

from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.driving import CameraConfig, LidarConfig, ObservationConfig
from deepracer_exp.config.evaluation import EvaluationConfig
from deepracer_exp.env.action_space import ActionSpace, DiscreteActions
from deepracer_exp.env.lidar_view import reach_of_rays
from deepracer_exp.errors import RunFailed, count, writing
from deepracer_exp.evaluation.evaluator import evaluator_against
from deepracer_exp.evaluation.film import Lap, drive_best_lap, in_frames, write_film
from deepracer_exp.reports.charts.run_pictures import SPEED
from deepracer_exp.runs.checkpoint_files import checkpoint_words
from deepracer_exp.runs.run_files import FILMS
from deepracer_exp.runs.stored_run import StoredRun
from deepracer_exp.sim.lidar_rays import ANGLES_RAD, MOUNT_X_M
from deepracer_exp.sim.scenery import box_corners
from deepracer_exp.tracks.outline import draw_track, extent

from .sight import degrees, is_squashed, picture_of, saliency, under_heat

WIDTH, HEIGHT = 1280, 720
_EYE = (480, 360)
"""Space for the camera pictures, and as much below it for their saliency."""
_PAGE, _RULE, _INK, _FAINT, _CHOSEN, _BAR = "#14171a", "#343a42", "#f2f4f6", "#98a1ac", "#f5a623", "#5b87b8"
_RAY = (255, 255, 255, 80)
_DARK = 80
"""Value of the brightest channel below which a colour is drawn lighter."""
_BOARD_HEIGHT, _ACTIONS_HEIGHT = 84, 216
_FINER = 2


class Frames:
    """Draws the frames of a lap: the car moves in each, its view and decisions change with its steps.

    On the left the camera pictures, enlarged without smoothing, and below it the same under its saliency, each frame
    scaled to its own highest value; on the right the view from above, with the rays of a LIDAR that hit something, and
    what the policy decides. Without a camera the right side is as wide as the frame.
    """

    def __init__(
        self,
        lap: Lap,
        acted: TensorDict,
        policy: nn.Module,
        actions: ActionSpace,
        observation: ObservationConfig,
        car: CarConfig,
    ) -> None:
        """Draw the static parts; `acted` has the policy's inputs and outputs in the n steps of the lap, [n]."""
        self._shown, self._step = in_frames(lap, car.control_hz)
        self._acted, self._policy, self._camera = acted, policy, observation.camera
        self._left = 0 if self._camera is None else _EYE[0]
        self._decision: _Probabilities | _Distribution = (
            _Probabilities(actions, acted["logits"].softmax(-1).numpy(), WIDTH - self._left)
            if isinstance(actions, DiscreteActions)
            else _Distribution(actions.low, actions.high, WIDTH - self._left, is_squashed(policy))
        )
        lidar, room = observation.lidar, (WIDTH - self._left, HEIGHT - _BOARD_HEIGHT - _ACTIONS_HEIGHT)
        seen = None if lidar is None else rays(lap, acted["lidar"].numpy(), lidar, car.front_point_m)
        self._map = _Map(self._shown, room, seen)

    def __len__(self) -> int:
        return len(self._shown)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for step, frames in itertools.groupby(range(len(self)), self._step.__getitem__):
            still = Image.new("RGB", (WIDTH, HEIGHT), _PAGE)
            if self._camera is not None:
                self._draw_sight(still, self._acted[step], self._camera)
            still.paste(self._decision.draw(step, self._acted[step]), (self._left, HEIGHT - _ACTIONS_HEIGHT))
            for row in frames:
                frame = still.copy()
                frame.paste(_board(self._shown, row, WIDTH - self._left), (self._left, 0))
                frame.paste(self._map.draw(row, step), (self._left, _BOARD_HEIGHT))
                yield np.asarray(frame)

    def _draw_sight(self, frame: Image.Image, acted: TensorDict, camera: CameraConfig) -> None:
        picture = picture_of(acted, camera)
        size = _fitted(picture.size, _EYE)
        corner = ((_EYE[0] - size[0]) // 2, (_EYE[1] - size[1]) // 2)
        frame.paste(picture.resize(size, Image.Resampling.NEAREST), corner)
        looked = under_heat(picture, saliency(self._policy, acted, camera), size)
        frame.paste(looked, (corner[0], corner[1] + _EYE[1]))
        draw = ImageDraw.Draw(frame, "RGBA")
        for top, words in ((0, "what it sees"), (_EYE[1], "where it looks")):
            draw_label(draw, (10, top + 8), words)


def _fitted(size: tuple[int, int], room: tuple[int, int]) -> tuple[int, int]:
    """Return the size of a picture in a room: a whole multiple of its own, or reduced if it is larger."""
    scale = min(room[0] / size[0], room[1] / size[1])
    scale = float(int(scale)) if scale >= 1 else scale
    return round(scale * size[0]), round(scale * size[1])


@cache
def font_of(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of films, so many pixels high."""
    return ImageFont.load_default(size)


def draw_label(draw: ImageDraw.ImageDraw, corner: tuple[int, int], words: str) -> None:
    """Write words that can be read on any picture."""
    left, top, right, bottom = draw.textbbox((corner[0] + 7, corner[1] + 3), words, font=font_of(15))
    draw.rounded_rectangle((left - 7, top - 5, right + 7, bottom + 5), 5, fill=(0, 0, 0, 150))
    draw.text((corner[0] + 7, corner[1] + 3), words, font=font_of(15), fill=_INK)


def _board(lap: Lap, row: int, width: int) -> Image.Image:
    """Draw track, lap time, speed and progress."""
    image = Image.new("RGB", (width, _BOARD_HEIGHT), _PAGE)
    draw = ImageDraw.Draw(image)
    share, end = lap.share(row), width - 24
    draw.text((24, 16), lap.title, font=font_of(18), fill=_INK)
    # Right-aligned, so that the numbers do not jump.
    words = (f"{lap.time_s[row]:.2f} s", f"{max(lap.speed_mps[row], 0.0):.2f} m/s", f"{100 * share:.0f}%")
    for right, text in zip((end - 240, end - 90, end), words, strict=True):
        draw.text((right, 12), text, font=font_of(26), fill=_INK, anchor="ra")
    if lap.held is not None and lap.held[row]:
        draw.text((end - 340, 12), "penalty", font=font_of(26), fill=_CHOSEN, anchor="ra")
    draw.rounded_rectangle((24, 56, end, 64), 4, fill=_RULE)
    draw.rounded_rectangle((24, 56, 24 + max(8, (end - 24) * share), 64), 4, fill=_CHOSEN)
    return image


def rays(
    lap: Lap, seen: NDArray[np.float32], lidar: LidarConfig, front_point_m: float
) -> NDArray[np.float64]:
    """Return the sensor and then the end of each ray at each step, metres, (n, 1 + RAYS, 2).

    A scan that is read once more is drawn where it was made, a step before.
    """
    made = np.arange(len(lap))
    made[1:] -= (seen[1:] == seen[:-1]).all(axis=1)
    yaw_rad = lap.yaw_rad[made]
    ahead = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    sensor = np.stack([lap.x_m, lap.y_m], axis=1)[made] + (MOUNT_X_M - front_point_m) * ahead
    angles = yaw_rad[:, None] + np.radians(lidar.yaw_deg) + ANGLES_RAD
    reached = reach_of_rays(lidar, seen)[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([sensor[:, None], sensor[:, None] + reached], axis=1)


class _Map:
    """The track from above with the driven line, coloured by speed, the car and what its LIDAR reads."""

    def __init__(self, lap: Lap, size: tuple[int, int], rays: NDArray[np.float64] | None) -> None:
        """Draw the track; the lap is in frames, the rays in steps."""
        low, high = extent(lap.track)
        scale = float(np.min(np.array(size) / (high - low)))
        road = draw_track(lap.track, _FINER * scale)
        self._canvas = Image.new("RGB", (_FINER * size[0], _FINER * size[1]), lap.track.floor.ground_color)
        left, top = ((self._canvas.width - road.width) // 2, (self._canvas.height - road.height) // 2)
        self._canvas.paste(road, (left, top))
        corner, step = np.array([left, top + road.height]), _FINER * scale * np.array([1, -1])
        self._x, self._y = (corner + (np.stack([lap.x_m, lap.y_m], axis=1) - low) * step).T
        self._rays = None if rays is None else corner + (rays - low) * step
        self._yaw_rad = lap.yaw_rad
        self._others = None if lap.others is None else corner + (box_corners(lap.others) - low) * step
        self._colors_of_others = [] if lap.others is None else lap.others[0, :, 6:].astype(int).tolist()
        # The few steps after a standing start would take half of the colours.
        slow, fast = float(np.percentile(lap.speed_mps, 5)), float(lap.speed_mps.max())
        shares = (lap.speed_mps - slow) / max(fast - slow, 1e-6)
        self._colors = [tuple(color) for color in (255 * SPEED(shares)[:, :3]).astype(int).tolist()]
        self._drawn = 0

    def draw(self, row: int, step: int) -> Image.Image:
        """Return the view of a frame after a step; frames are drawn in their order."""
        pen = ImageDraw.Draw(self._canvas)
        for frame in range(self._drawn + 1, row + 1):
            ends = [(self._x[frame - 1], self._y[frame - 1]), (self._x[frame], self._y[frame])]
            pen.line(ends, fill=self._colors[frame], width=4 * _FINER)
        self._drawn = row
        now = self._canvas.copy()
        if self._others is not None:
            pen = ImageDraw.Draw(now)
            for corners, color in zip(self._others[row].tolist(), self._colors_of_others, strict=True):
                # Bots are nearly as dark as the road.
                fill = _FAINT if max(color) < _DARK else tuple(color)
                pen.polygon([tuple(point) for point in corners], fill, _INK, width=_FINER)
        if self._rays is not None:
            pen = ImageDraw.Draw(now, "RGBA")
            sensor, *ends = self._rays[step].tolist()
            for x, y in ends:
                if x == x:  # not NaN
                    pen.line((*sensor, x, y), fill=_RAY, width=_FINER)
                    pen.ellipse((x - 5, y - 5, x + 5, y + 5), fill=_CHOSEN)
        ahead = np.array([np.cos(self._yaw_rad[row]), -np.sin(self._yaw_rad[row])])
        left = np.array([ahead[1], -ahead[0]])
        corners = ((4, 0), (-19, 8), (-14, 0), (-19, -8))  # an arrow, pixels ahead and to the left
        at_px = np.array([self._x[row], self._y[row]])
        arrow = [tuple(at_px + _FINER * (along * ahead + aside * left)) for along, aside in corners]
        ImageDraw.Draw(now).polygon(arrow, fill="#ffffff", outline="#000000", width=_FINER)
        return now.reduce(_FINER)


class _Probabilities:
    """Bars of the probabilities of discrete actions, from left to right as they steer, slow ones first."""

    def __init__(self, actions: DiscreteActions, probabilities: NDArray[np.float32], width: int) -> None:
        self._order = np.lexsort((actions.speed_mps, -actions.steering_deg))
        self._steering = [degrees(value) for value in actions.steering_deg]
        self._speed = [f"{value:.1f}" for value in actions.speed_mps]
        self._probabilities, self._width = probabilities, width
        # One scale for the lap.
        self._highest = next(share for share in (0.2, 0.5, 1.0) if probabilities.max() <= share or share == 1)

    def draw(self, row: int, acted: TensorDict) -> Image.Image:
        """Return the bars of a step; that of the chosen action is highlighted."""
        image = Image.new("RGB", (self._width, _ACTIONS_HEIGHT), _PAGE)
        draw = ImageDraw.Draw(image)
        chosen, shares = int(acted["action"]), self._probabilities[row]
        step = (self._width - 48) / len(self._order)
        top, bottom = 38, _ACTIONS_HEIGHT - 52
        draw.text(
            (24, 12), f"probability of each action, up to {self._highest:.0%}", font=font_of(15), fill=_FAINT
        )
        words = f"{self._steering[chosen]}, {self._speed[chosen]} m/s: {shares[chosen]:.0%}"
        draw.text((self._width - 24, 12), words, font=font_of(15), fill=_CHOSEN, anchor="ra")
        for y in (top, bottom):
            draw.line((24, y, self._width - 24, y), fill=_RULE)
        size = 14 if step > 40 else 11
        for place, action in enumerate(self._order):
            middle, half = 24 + (place + 0.5) * step, 0.4 * step
            height = (bottom - top) * float(shares[action]) / self._highest
            color, ink = (_CHOSEN, _CHOSEN) if action == chosen else (_BAR, _FAINT)
            draw.rectangle((middle - half, bottom - height, middle + half, bottom), fill=color)
            draw.text((middle, bottom + 6), self._steering[action], font=font_of(size), fill=ink, anchor="ma")
            draw.text((middle, bottom + 24), self._speed[action], font=font_of(size), fill=ink, anchor="ma")
        return image


class _Distribution:
    """Mean and standard deviation of steering and speed, on the ranges of a continuous action space."""

    def __init__(
        self, low: NDArray[np.float64], high: NDArray[np.float64], width: int, squashed: bool
    ) -> None:
        self._low, self._high, self._width = low, high, width
        self._squashed = squashed

    def draw(self, row: int, acted: TensorDict) -> Image.Image:
        """Return the two scales."""
        image = Image.new("RGB", (self._width, _ACTIONS_HEIGHT), _PAGE)
        draw = ImageDraw.Draw(image)
        half = 0.5 * (self._high - self._low)
        loc, scale = acted["loc"].numpy(), acted["scale"].numpy()
        means = self._low + half * ((np.tanh(loc) if self._squashed else loc.clip(-1, 1)) + 1)
        # Where the values are squashed, their spread is too: half of what a deviation to either side changes.
        deviations = half * (0.5 * (np.tanh(loc + scale) - np.tanh(loc - scale)) if self._squashed else scale)
        draw.text((24, 8), "mean and standard deviation", font=font_of(15), fill=_FAINT)
        begin, end = 24, self._width - 24
        for row, (name, unit, digits) in enumerate((("steering", "°", 1), ("speed", " m/s", 2))):
            # Left is left: the steering's scale runs from its highest value down.
            ends = (self._high[row], self._low[row]) if row == 0 else (self._low[row], self._high[row])
            mean, deviation, y = float(means[row]), float(deviations[row]), 74 + 80 * row
            marked, span = mean + deviation * np.array([-1, 0, 1]) - ends[0], ends[1] - ends[0]
            shares = marked / span if span else np.full(3, 0.5)
            low, middle, high = np.sort(begin + (end - begin) * shares.clip(0.0, 1.0))
            draw.rounded_rectangle((begin, y - 5, end, y + 5), 5, fill=_RULE)
            draw.rounded_rectangle((low, y - 5, high, y + 5), 5, fill=_BAR)
            draw.ellipse((middle - 10, y - 10, middle + 10, y + 10), fill=_CHOSEN)
            words = f"{name} {mean:.{digits}f}{unit} ± {deviation:.{digits}f}"
            draw.text((self._width / 2, y - 32), words, font=font_of(16), fill=_INK, anchor="ma")
            for x, value, anchor in ((begin, ends[0], "la"), (end, ends[1], "ra")):
                draw.text((x, y + 12), f"{value:g}{unit}", font=font_of(13), fill=_FAINT, anchor=anchor)
        return image


def film_run(
    run: StoredRun,
    protocol: EvaluationConfig,
    file: Path | None,
    out: Console,
    err: Console,
    rival: StoredRun | None = None,
) -> None:
    """Race a run's checkpoint under a protocol and film its fastest lap on the usual conditions.

    `file` is the .mp4 to write; None: named after the checkpoint, in the run's folder. `rival` is as for
    `evaluator_against`.

    Raises:
        BadInput: the checkpoint, a track or a condition cannot be used.
        RunFailed: a car's state became NaN, or the file cannot be written.
    """
    stored = run.read_policy()
    torch.set_num_threads(1)
    evaluator = evaluator_against(rival, run.experiment, replace(protocol, held_out=None))
    err.print(
        f"{run.path.name}, {checkpoint_words(stored.path.name)}: {count(len(evaluator.trials), 'trial')}",
    )
    policy = stored.networks.policy
    lap, acted = drive_best_lap(evaluator, policy)
    if file is None:
        file = run.path / FILMS / f"{stored.path.name}.mp4"
        with writing(file.parent, failure=RunFailed):
            file.parent.mkdir(exist_ok=True)
    setup = evaluator.race.setup
    frames = Frames(lap, acted, policy, setup.actions, setup.observation, setup.car)
    write_film(file, frames, len(frames), (WIDTH, HEIGHT), err)
    out.print(f"  film  {file}", soft_wrap=True)
