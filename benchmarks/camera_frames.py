"""Pictures of AWS's simulator whose poses are unknown: find the poses, fit the colours, and compare.

The picture of a pose is linear in the colours: drawn with a channel for each material, it says what share of each pixel
every material covers. So colours are fitted by least squares, poses by search, in turns.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt

from deepracer_exp.env.pictures import GREY, floor_colors
from deepracer_exp.errors import BadInput
from deepracer_exp.sim.camera import Lens
from deepracer_exp.sim.scenery import MATERIALS, Scenery, build_scenery
from deepracer_exp.tracks.track import Track, world_track

from .camera import pictures, poses_on

TRACK = "reinvent_base"
SHARES = np.eye(len(MATERIALS), dtype=np.float32) * 255
"""Colours that make the share of each material a channel of its own."""
COARSE = 8
"""The first search compares pictures shrunk by this factor."""
TURNS = 3
WHITE_SHARE = 0.5
"""A pixel counts as white from this share between road and line on."""
BEGIN_SPREAD = np.array([0.15, 0.15, 0.1, 0.01, 0.01])
"""Standard deviation of the finer search at its beginning: metres and radians."""
CANDIDATES, BEST, ROUNDS = 96, 12, 14


def explain_frames(folder: Path, lens: Lens) -> dict[str, Any]:
    """Fit colours on half of the frames and compare the others.

    Raises:
        BadInput: the folder has no pictures.
    """
    files = sorted(folder.glob("*.png"))
    if not files:
        raise BadInput(f"--frames {folder}: no *.png there; accepted: a folder of pictures, 160x120")
    frames = np.stack([np.asarray(Image.open(file).convert("RGB"), np.float32) @ GREY for file in files])
    track = world_track(TRACK)
    scenery = build_scenery(track)
    colors = floor_colors(track.floor) @ GREY
    fitted, held_out = frames[::2], frames[1::2]
    for _ in range(TURNS):
        poses = find_poses(fitted, lens, track, scenery, colors)
        colors = fit_colors(fitted, lens, scenery, poses)
    poses = find_poses(held_out, lens, track, scenery, colors)
    ours = pictures(lens, scenery, poses, colors[:, None])[:, 0].astype(np.float32)
    differences = np.abs(ours - held_out).mean(axis=(1, 2))
    errors = [edge_errors_px(a, b, colors) for a, b in zip(held_out, ours, strict=True)]
    return {
        "difference_of_255": float(differences.mean()),
        "edge_error_px": float(np.median(np.concatenate(errors))),
        "frames": len(held_out),
        "fitted": len(fitted),
        "median_pitch_deg": float(np.degrees(lens.pitch_rad + np.median(poses[:, 3]))),
        **{f"grey_{name}": float(value) for name, value in zip(MATERIALS, colors, strict=True)},
    }


def find_poses(
    frames: NDArray[np.float32], lens: Lens, track: Track, scenery: Scenery, colors: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the pose that explains each frame best, (N, 5)."""
    small = replace(lens, width=lens.width // COARSE, height=lens.height // COARSE)
    shape = (len(frames), small.height, COARSE, small.width, COARSE)
    shrunk = frames.reshape(shape).mean(axis=(2, 4)).reshape(len(frames), -1)
    ndist = np.arange(0, 1, 0.05 / track.length_m)
    side_m, turn_rad = np.linspace(-0.45, 0.45, 7) * track.width_m, np.linspace(-0.7, 0.7, 15)
    grid = [axis.ravel() for axis in np.meshgrid(ndist, side_m, turn_rad, [0.0], [0.0], indexing="ij")]
    tried = poses_on(track, *grid)
    drawn = pictures(small, scenery, tried, colors[:, None]).reshape(len(tried), -1).astype(np.float32)
    generator = np.random.default_rng(0)
    found = []
    for frame, look in zip(frames, shrunk, strict=True):
        best = tried[np.argsort(np.abs(drawn - look).mean(axis=1))[:BEST]]
        found.append(_refine(frame, best, lens, scenery, colors, generator))
    return np.stack(found)


def _refine(
    frame: NDArray[np.float32],
    best: NDArray[np.float64],
    lens: Lens,
    scenery: Scenery,
    colors: NDArray[np.float32],
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the best of poses drawn ever closer around the best so far."""
    spread = BEGIN_SPREAD
    for _ in range(ROUNDS):
        around = best[generator.integers(len(best), size=CANDIDATES)]
        tried = np.concatenate([best, around + spread * generator.normal(size=around.shape)])
        drawn = pictures(lens, scenery, tried, colors[:, None])[:, 0].astype(np.float32)
        best = tried[np.argsort(np.abs(drawn - frame).mean(axis=(1, 2)))[:BEST]]
        spread = 0.7 * spread
    found: NDArray[np.float64] = best[0]
    return found


def fit_colors(
    frames: NDArray[np.float32], lens: Lens, scenery: Scenery, poses: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the materials' greys that explain the frames at these poses best (least squares), (materials,)."""
    normal, right = np.zeros((len(MATERIALS), len(MATERIALS))), np.zeros(len(MATERIALS))
    for frame, pose in zip(frames, poses, strict=True):
        shares = pictures(lens, scenery, pose[None], SHARES)[0].reshape(len(MATERIALS), -1) / 255.0
        normal += shares @ shares.T
        right += shares @ frame.ravel()
    # A material that is never seen stays black.
    return np.linalg.lstsq(normal, right, rcond=None)[0].astype(np.float32)


def edge_errors_px(
    frame: NDArray[np.float32], ours: NDArray[np.float32], colors: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return how far each edge pixel of the white lines in a frame is from the nearest in our picture."""
    line, field = colors[MATERIALS.index("line")], colors[MATERIALS.index("field")]
    white = field + WHITE_SHARE * (line - field)
    theirs, mine = (_edge(picture > white) for picture in (frame, ours))
    if not theirs.any() or not mine.any():
        return np.zeros(0)
    distance: NDArray[np.float64] = distance_transform_edt(~mine)[theirs]
    return distance


def _edge(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels of a mask that have a neighbour outside it."""
    inner = mask.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(mask, step, axis)
    edge = mask & ~inner
    edge[[0, -1]] = edge[:, [0, -1]] = False
    return edge
