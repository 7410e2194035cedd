"""Robustness of a policy to its pictures: which decide badly, because a small, irrelevant change turns the wheels."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from deepracer_exp.aws.models.car_controls import full_scale
from deepracer_exp.config.driving import CameraConfig
from deepracer_exp.env.action_space import ActionSpace, Commands, metadata_of

from .sight import degrees, picture_of, saliency, under_heat

BAD_SHARE = 0.5
"""Share of full lock by which a change must turn the steering for a picture to decide badly."""
_BATCH = 64
_SHOWN, _ACROSS, _WIDTH, _LINE = 8, 4, 320, 44
"""Pictures on a sheet, in a row; pixels of one and of the words below it."""
_APART = 8
"""Pictures between two on a sheet: neighbours look alike."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class TriedPictures:
    """The n pictures of a drive, and the change of steering by small changes of them."""

    acted: TensorDict
    """Inputs and outputs of the policy, [n]."""
    commands: Commands
    turned_deg: Mapping[str, NDArray[np.float64]]
    """By the name of the change, degrees of the action space, to the left, (n,) each."""
    full_lock_deg: float
    """Angle of the action space that is full lock."""

    @property
    def bad(self) -> NDArray[np.intp]:
        """The pictures that decide badly, the worst first."""
        worst_deg = np.max(np.abs(list(self.turned_deg.values())), axis=0)
        order = np.argsort(-worst_deg, kind="stable")
        bad: NDArray[np.intp] = order[worst_deg[order] > BAD_SHARE * self.full_lock_deg]
        return bad

    @property
    def bad_share(self) -> float:
        """Their share of all pictures."""
        return len(self.bad) / len(self.commands[0])

    def words(self) -> str:
        """Return their number: ``9 of 242 (4%)``."""
        return f"{len(self.bad)} of {len(self.commands[0])} ({self.bad_share:.0%})"

    def by_change(self) -> str:
        """Return their number by change: ``darker 5, blurred 4``."""
        least_deg = BAD_SHARE * self.full_lock_deg
        turned = {name: int((np.abs(deg) > least_deg).sum()) for name, deg in self.turned_deg.items()}
        return ", ".join(f"{name} {bad}" for name, bad in turned.items() if bad)


def _scaled(pixels: Pixels, factor: float) -> Pixels:
    return np.rint(pixels * np.float32(factor)).clip(0, 255).astype(np.uint8)


def _lowered(pixels: Pixels, rows: int) -> Pixels:
    """Shift pictures down by a number of rows; the row at the edge is repeated."""
    height = pixels.shape[-2]
    return pixels[..., np.clip(np.arange(height) - rows, 0, height - 1), :]


CHANGES: Mapping[str, Callable[[Pixels], Pixels]] = {
    "darker": lambda pixels: _scaled(pixels, 0.8),
    "brighter": lambda pixels: _scaled(pixels, 1.25),
    # The camera is pitched by some 0.8 degrees.
    "2 pixels higher": lambda pixels: _lowered(pixels, -2),
    "2 pixels lower": lambda pixels: _lowered(pixels, 2),
    "blurred": lambda pixels: gaussian_filter(pixels, (0, 0, 1.0, 1.0)),
}
"""Small changes of pictures (n, channels, height, width) that should not turn the wheels."""


def try_pictures(policy: nn.Module, acted: TensorDict, actions: ActionSpace) -> TriedPictures:
    """Let a policy decide again on changed pictures; `acted` has its inputs and outputs in n steps, [n]."""
    steering_deg, speed_mps = actions.commands(acted["action"].numpy())
    pixels = acted["pixels"].numpy()
    turned_deg = {}
    for name, change in CHANGES.items():
        seen = acted.clone()
        seen["pixels"] = torch.from_numpy(np.ascontiguousarray(change(pixels)))
        decided = actions.commands(decide(policy, seen)["action"].numpy())
        turned_deg[name] = decided[0] - steering_deg
    lock_deg = full_scale(metadata_of(actions)).steering_deg
    return TriedPictures(acted, (steering_deg, speed_mps), turned_deg, lock_deg)


def decide(policy: nn.Module, seen: TensorDict) -> TensorDict:
    """Return a policy's inputs and outputs in n steps, with its most probable actions, [n]."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return torch.cat([policy(part.clone()) for part in seen.split(_BATCH)])


def spread_out(rows: NDArray[np.intp], place: NDArray[Any], least: float, most: int) -> list[int]:
    """Select the first of some rows whose places have a least distance from one another, at most `most`."""
    chosen: list[int] = []
    for row in rows.tolist():
        if len(chosen) == most:
            break
        if all(abs(place[row] - place[other]) >= least for other in chosen):
            chosen.append(row)
    return chosen


def pictures_sheet(tried: TriedPictures, policy: nn.Module, camera: CameraConfig) -> Image.Image:
    """Draw the worst pictures that decide badly under their saliency, each with its decisions."""
    shown = spread_out(tried.bad, np.arange(len(tried.commands[0])), _APART, _SHOWN)
    height = _WIDTH * camera.height // (camera.width * (2 if camera.stereo_m else 1))
    rows = -(-len(shown) // _ACROSS)
    sheet = Image.new("RGB", (_ACROSS * _WIDTH, rows * (height + _LINE)), "#14171a")
    draw = ImageDraw.Draw(sheet)
    for place, step in enumerate(shown):
        left, top = place % _ACROSS * _WIDTH, place // _ACROSS * (height + _LINE)
        picture = picture_of(tried.acted[step], camera)
        heat = saliency(policy, tried.acted[step], camera)
        sheet.paste(under_heat(picture, heat, (_WIDTH - 4, height)), (left + 2, top))
        steering_deg = tried.commands[0][step]
        change = max(tried.turned_deg, key=lambda name: abs(tried.turned_deg[name][step]))
        words = (
            f"picture {step + 1} of {len(tried.commands[0])}: {degrees(steering_deg)}",
            f"{change}: {degrees(steering_deg + tried.turned_deg[change][step])}",
        )
        for line, text in enumerate(words):
            draw.text((left + 8, top + height + 3 + 19 * line), text, font_size=15, fill="#f2f4f6")
    return sheet
