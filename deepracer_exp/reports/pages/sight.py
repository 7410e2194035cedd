"""A policy's camera pictures and their saliency: the places that its decision depends on."""

from functools import cache

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal

from deepracer_exp.config.driving import CameraConfig
from deepracer_exp.env.action_space import ActionSpace
from deepracer_exp.evaluation.film import Lap, png

from .page import Glimpse, png_uri

SPACING, SPREAD = 12, 18
"""Blurred places along the picture's width, and the width in standard deviations of one of them."""
_BLUR = 0.04
"""Standard deviation of the blur, in picture widths."""
_HEAT = matplotlib.colormaps["inferno"]
_DIMMED, _COVER = 0.5, 0.8
"""Brightness of a picture under its heat map, and how much of it the highest value covers."""
GLIMPSES, _ENLARGED = 8, 240
"""Pictures of a lap, and the width of one under its heat map, pixels."""


def saliency(policy: nn.Module, acted: TensorDict, camera: CameraConfig) -> NDArray[np.float32]:
    """Return the saliency of a decision: its dependence on each place of its pictures.

    The policy reads `pixels` and perhaps more and writes `logits` or `loc`; `acted` has its inputs and outputs in one
    step, [].

    A place is blurred, in all pictures of its camera, and the policy decides again: the score of a place is the square
    of the change in the log-probability of the chosen action, for a continuous policy in the mean of steering and
    speed (Greydanus et al. 2018, Visualizing and Understanding Atari Agents, arXiv:1711.00138, section 3.1).

    Returns:
        0 to 1, the highest of them 1, for `picture_of` of the same step, (height, width).
    """
    height, width = camera.height, camera.width
    masks = torch.from_numpy(_masks(height, width))  # (places, height, width)
    places, cameras, colors = len(masks), 2 if camera.stereo_m else 1, 3 if camera.color == "rgb" else 1
    eye_of = torch.arange(camera.shape[0]) // colors % cameras  # of each channel
    pixels = acted["pixels"].float()
    blurred = torch.from_numpy(gaussian_filter(pixels.numpy(), (0, _BLUR * width, _BLUR * width)))
    scores = torch.empty(cameras, places)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for eye in range(cameras):
            of_eye = (eye_of == eye).float()[:, None, None]  # (channels, 1, 1)
            mixed = pixels + (blurred - pixels) * masks[:, None] * of_eye
            seen = acted.expand(places + 1).clone()
            seen["pixels"] = torch.cat([pixels[None], mixed]).round().byte()
            decided = _decision(policy(seen), acted, is_squashed(policy))
            scores[eye] = 0.5 * (decided[1:] - decided[0]).square().sum(-1)
    weighted = (torch.einsum("ep,phw->ehw", scores, masks) / masks.sum(0)).numpy()
    beside = np.concatenate(list(weighted), axis=1)
    return (beside / max(float(beside.max()), 1e-12)).astype(np.float32)


def is_squashed(policy: nn.Module) -> bool:
    """Return whether a policy's continuous actions are the hyperbolic tangents of its normal distribution, as SAC's."""
    return any(getattr(module, "distribution_class", None) is TanhNormal for module in policy.modules())


def _decision(out: TensorDict, acted: TensorDict, squashed: bool) -> Tensor:
    """Return the values by which decisions are compared, [..., 1 or 2]."""
    if "loc" in out:
        return out["loc"].tanh() if squashed else out["loc"]
    return out["logits"].log_softmax(-1)[..., acted["action"].item(), None]


@cache
def _masks(height: int, width: int) -> NDArray[np.float32]:
    """Return a bump at each place of a grid over the picture, (places, height, width)."""
    sizes = (max(1, round(SPACING * height / width)), SPACING)
    y, x = (
        (np.arange(count) + 0.5) / count * size for count, size in zip(sizes, (height, width), strict=True)
    )
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5
    deviation = width / SPREAD
    down = np.exp(-0.5 * ((rows - y[:, None]) / deviation) ** 2)
    across = np.exp(-0.5 * ((columns - x[:, None]) / deviation) ** 2)
    bumps = down[:, None, :, None] * across[None, :, None, :]
    return bumps.reshape(-1, height, width).astype(np.float32)


def picture_of(acted: TensorDict, camera: CameraConfig) -> Image.Image:
    """Return the newest picture of a step; those of two cameras side by side, the left one first."""
    pixels = acted["pixels"].numpy()
    now = pixels[-(len(pixels) // camera.frames) :]
    beside = np.concatenate(np.split(now, 2), axis=2) if camera.stereo_m else now
    return Image.fromarray(np.moveaxis(np.broadcast_to(beside, (3, *beside.shape[1:])), 0, -1).copy())


def under_heat(picture: Image.Image, heat: NDArray[np.float32], size: tuple[int, int]) -> Image.Image:
    """Return a picture, enlarged to width and height in pixels and dimmed, under the heat of its `saliency`."""
    grey = np.asarray(picture.convert("L").resize(size, Image.Resampling.NEAREST), np.float32)[..., None]
    heat = np.asarray(Image.fromarray(heat).resize(size, Image.Resampling.BILINEAR)).clip(0, 1)
    share = _COVER * heat[..., None]
    mixed = _DIMMED * grey * (1 - share) + 255 * _HEAT(heat)[..., :3] * share
    return Image.fromarray(mixed.astype(np.uint8))


def degrees(steering_deg: float) -> str:
    """Return a steering angle with its sign, + to the left."""
    return f"{steering_deg:+.0f}°" if abs(steering_deg) >= 0.5 else "0°"


def glimpses(
    lap: Lap, acted: TensorDict, policy: nn.Module, actions: ActionSpace, camera: CameraConfig
) -> list[Glimpse]:
    """Return a policy's views and decisions at places evenly spread over a lap.

    `acted` has its inputs and outputs in the n steps of the lap, [n].
    """
    strip = []
    steering_deg, speed_mps = actions.commands(acted["action"].numpy())
    for step in np.unique(np.linspace(1, len(lap) - 1, GLIMPSES + 1).astype(int)[:-1]):
        picture = picture_of(acted[step], camera)
        size = (_ENLARGED * picture.width // camera.width, _ENLARGED * camera.height // camera.width)
        looked = under_heat(picture, saliency(policy, acted[step], camera), size)
        strip.append(
            Glimpse(
                seen=png_uri(png(picture)),
                looked=png_uri(png(looked)),
                where=f"{100 * lap.share(step):.0f}% of the lap",
                decision=f"{degrees(steering_deg[step])}, {speed_mps[step]:.1f} m/s",
            )
        )
    return strip
