"""Our camera beside MuJoCo's renderer, and beside pictures that AWS's simulator took.

    python -m benchmarks.camera [--frames DIR] [--poses 200] [--json FILE]

1. The same scene, 160x120: random poses on three tracks, with pitch and roll. `images_per_s` is ours, one core, in grey
   as policies see it (in colour: `rgb_images_per_s`; with boxes all around: `boxes_images_per_s`);
   `mujoco_images_per_s` is MuJoCo's with one sample a pixel and without shadows, reflections and fog; `times` their
   ratio, measured in turns. `mujoco_640x480_images_per_s` is that of pictures as AWS's simulator takes them, before it
   shrinks them.
2. `difference_of_255`: mean over pixels and channels of the absolute difference from MuJoCo's picture of four times the
   width and height with four samples a pixel, shrunk by taking means; with boxes beside the road.
3. `real_frames` (with `--frames`): pictures of AWS's simulator on re:Invent 2018, in the order in which they were
   taken, whose poses are unknown. Each of every other frame is explained by the pose whose picture differs least, in
   the track's own colours (`own`), and in colours fitted on the rest of the frames (`fitted`), in grey.
   `difference_of_255`: mean over frames of the mean absolute difference, `worst_of_255` the largest; `edge_error_px`:
   mean distance of the white lines' edges in the frame from those in our picture, `edges_beyond_1px` the share of them
   beyond a pixel; `wrong_places`: frames whose pose is farther from those before and after than a car can drive.

MuJoCo draws with the library that `MUJOCO_GL` names; without a graphics card that is Mesa's renderer on the processor.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.pictures import GREY, floor_colors
from deepracer_exp.env.randomization.picture_randomization import PictureRandomization
from deepracer_exp.errors import BadInput
from deepracer_exp.sim.camera import take_pictures
from deepracer_exp.sim.lens import Lens
from deepracer_exp.sim.scenery import MATERIALS, Scenery, build_scenery
from deepracer_exp.tracks.track import Track

from .report import benchmark_parser, number, table, with_exit_code, write_json

TRACKS = ("reinvent_base", "2022_summit_speedway_cw", "Spain_track")
"""With high walls, with a start line, and with kerbs and a low barrier."""
BOXES = 40
WIDTH, HEIGHT = 160, 120
ROUNDS = 5

FRAMES_TRACK = "reinvent_base"
SHARES = np.eye(len(MATERIALS), dtype=np.float32) * 255
"""Colours that make the share of each material a channel of its own."""
COARSE = 8
"""The first search compares pictures shrunk by this factor."""
TURNS = 3
WHITE_SHARE = 0.5
"""A pixel counts as white from this share between road and line on."""
BEGIN_SPREAD = np.array([0.15, 0.15, 0.1, 0.01, 0.01])
"""Standard deviation of the finer search at its beginning: metres and radians."""
CANDIDATES, BEST, SEARCH_ROUNDS = 96, 12, 14
FARTHEST_M = 1.6
"""What a car of 4 m/s drives between two of the frames that are compared, 0.4 s: every sixth of a camera of 15 Hz."""


def service_lens(width: int, height: int) -> Lens:
    """Return the default car's camera."""
    car = compose_experiment([])[0].car
    return Lens(
        width=width,
        height=height,
        field_of_view_rad=1.13,
        x_m=car.camera_x_m,
        y_m=0.0,
        z_m=car.camera_z_m,
        pitch_rad=np.radians(car.camera_pitch_deg),
    )


def boxes_beside(track: Track) -> NDArray[np.float32]:
    """Return boxes as randomized pictures have them, in colour, (boxes, 9)."""
    objects = f"randomization.pictures.objects=[{BOXES},{BOXES}]"
    config = compose_experiment(["randomization=sim2real", objects])[0].randomization.pictures
    randomization = PictureRandomization([config], [0], [track])
    randomization.seed(0)
    randomization.begin(np.zeros(1, np.intp), np.zeros(1, np.int64), np.zeros(1, np.intp))
    boxes = randomization.boxes(np.zeros(1, np.intp))
    assert boxes is not None
    return boxes[0]


def random_poses(track: Track, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return poses near the centre line, some degrees off in every direction, (count, 5)."""
    ndist, side_m = generator.random(count), generator.uniform(-0.3, 0.3, count) * track.width_m
    return poses_on(track, ndist, side_m, *generator.normal(0, [[0.3], [0.03], [0.03]], (3, count)))


def poses_on(
    track: Track,
    ndist: NDArray[np.float64],
    side_m: NDArray[np.float64],
    turn_rad: NDArray[np.float64],
    *lean_rad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return poses (N, 5) to the left of the centre line, turned from it, with a pitch and a roll."""
    x, y, yaw = track.start_pose(ndist)
    return np.column_stack([x - side_m * np.sin(yaw), y + side_m * np.cos(yaw), yaw + turn_rad, *lean_rad])


def pictures(
    lens: Lens,
    scenery: Scenery,
    poses: NDArray[np.float64],
    colors: NDArray[np.float32],
    boxes: NDArray[np.float32] | None = None,
) -> NDArray[np.uint8]:
    """Return our pictures, (N, channels, height, width), of the same boxes (B, 6 + channels) for all."""
    out = np.empty((len(poses), colors.shape[-1], lens.height, lens.width), np.uint8)
    everyone = np.broadcast_to(colors, (len(poses), *colors.shape))
    same = None if boxes is None else np.broadcast_to(boxes, (len(poses), *boxes.shape))
    return take_pictures(lens, scenery, poses, np.zeros(len(poses), np.intp), everyone, out, boxes=same)


def per_second(count: int, work: Callable[..., object], *arguments: object) -> float:
    """Return how many of `count` things are done a second of processor time."""
    began = time.process_time()
    work(*arguments)
    return count / (time.process_time() - began)


def compare_with_mujoco(count: int) -> dict[str, Any]:
    """Measure speed and difference on each track."""
    from .mujoco_scene import SceneRenderer, build_scene

    generator = np.random.default_rng(0)
    lens, large = service_lens(WIDTH, HEIGHT), service_lens(4 * WIDTH, 4 * HEIGHT)
    rates: dict[str, list[float]] = {"ours": [], "rgb": [], "boxes": [], "mujoco": [], "mujoco 640x480": []}
    times, differences = [], {}
    for name in TRACKS:
        track = Track.from_config(compose_experiment([f"track={name}"])[0].tracks[name])
        colors = floor_colors(track.floor)
        grey = (colors @ GREY)[:, None]
        scenery, poses = build_scenery(track), random_poses(track, -(-count // len(TRACKS)), generator)
        boxes = boxes_beside(track)
        grey_boxes = np.column_stack([boxes[:, :6], boxes[:, 6:] @ GREY])
        fast = SceneRenderer(build_scene(track, lens, colors, 0), WIDTH, HEIGHT)
        plain = SceneRenderer(build_scene(track, large, colors, 0), 4 * WIDTH, 4 * HEIGHT)
        exact = SceneRenderer(build_scene(track, large, colors, 4, boxes), 4 * WIDTH, 4 * HEIGHT)
        for some in (grey, colors):
            pictures(lens, scenery, poses, some)
        pictures(lens, scenery, poses, grey, grey_boxes), fast.take(poses[0])
        many = np.tile(poses, (20, 1))
        for _ in range(ROUNDS):
            rates["ours"].append(per_second(len(many), pictures, lens, scenery, many, grey))
            rates["rgb"].append(per_second(len(many), pictures, lens, scenery, many, colors))
            rates["boxes"].append(per_second(len(many), pictures, lens, scenery, many, grey, grey_boxes))
            rates["mujoco"].append(per_second(len(poses), fast.take_all, poses))
            times.append(rates["ours"][-1] / rates["mujoco"][-1])
        rates["mujoco 640x480"].append(per_second(len(poses), plain.take_all, poses))
        theirs = exact.take_all(poses).reshape(-1, HEIGHT, 4, WIDTH, 4, 3).mean(axis=(2, 4))
        ours = np.moveaxis(pictures(lens, scenery, poses, colors, boxes), 1, -1)
        differences[name] = float(np.abs(theirs - ours).mean())
        for renderer in (fast, plain, exact):
            renderer.close()
    middle = {key: float(np.median(values)) for key, values in rates.items()}
    return {
        "images_per_s": middle["ours"],
        "rgb_images_per_s": middle["rgb"],
        "boxes_images_per_s": middle["boxes"],
        "mujoco_images_per_s": middle["mujoco"],
        "mujoco_640x480_images_per_s": middle["mujoco 640x480"],
        "times": float(np.median(times)),
        "difference_of_255": float(np.mean(list(differences.values()))),
        "difference_by_track": differences,
        "poses": count,
    }


def explain_frames(folder: Path, lens: Lens) -> dict[str, Any]:
    """Fit colours on half of the frames, find their poses, and compare the others.

    The picture of a pose is linear in the colours: drawn with a channel for each material, it says what share of each
    pixel every material covers. So colours are fitted by least squares, poses by search, in turns.

    Raises:
        BadInput: the folder has no pictures.
    """
    frames = read_frames(folder)
    track = Track.from_config(compose_experiment([f"track={FRAMES_TRACK}"])[0].tracks[FRAMES_TRACK])
    scenery = build_scenery(track)
    own = colors = floor_colors(track.floor) @ GREY
    fitted, held_out = frames[::2], frames[1::2]
    for _ in range(TURNS):
        poses = find_poses(fitted, lens, track, scenery, colors)
        colors = fit_colors(fitted, lens, scenery, poses)
    return {
        "own": compare_frames(held_out, lens, track, scenery, own),
        "fitted": compare_frames(held_out, lens, track, scenery, colors),
        "frames": len(held_out),
        **{f"grey_{name}": float(value) for name, value in zip(MATERIALS, colors, strict=True)},
    }


def read_frames(folder: Path) -> NDArray[np.float32]:
    """Return the pictures in a folder in grey, in the order of their names, (n, 120, 160), 0 to 255.

    Raises:
        BadInput: the folder has no pictures, or one is of another size.
    """
    files = sorted(folder.glob("*.png"))
    if not files:
        raise BadInput(f"--frames {folder}: no *.png there; accepted: a folder of pictures, 160x120")
    frames = [np.asarray(Image.open(file).convert("RGB"), np.float32) @ GREY for file in files]
    for file, frame in zip(files, frames, strict=True):
        if frame.shape != (HEIGHT, WIDTH):
            raise BadInput(f"--frames {file}: {frame.shape[1]}x{frame.shape[0]}; accepted: {WIDTH}x{HEIGHT}")
    return np.stack(frames)


def compare_frames(
    frames: NDArray[np.float32], lens: Lens, track: Track, scenery: Scenery, colors: NDArray[np.float32]
) -> dict[str, Any]:
    """Return how pictures in these greys, (materials,), differ from frames, each at the pose that explains it best."""
    poses = find_poses(frames, lens, track, scenery, colors)
    ours = pictures(lens, scenery, poses, colors[:, None])[:, 0].astype(np.float32)
    differences = np.abs(ours - frames).mean(axis=(1, 2))
    errors = np.concatenate([edge_errors_px(*pair, colors) for pair in zip(frames, ours, strict=True)])
    moved_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    far = np.concatenate([[False], moved_m > FARTHEST_M, [False]])
    return {
        "difference_of_255": float(differences.mean()),
        "worst_of_255": float(differences.max()),
        "edge_error_px": float(errors.mean()),
        "edges_beyond_1px": float((errors > 1.0).mean()),
        "wrong_places": int((far[:-1] & far[1:]).sum()),
        "median_pitch_deg": float(np.degrees(lens.pitch_rad + np.median(poses[:, 3]))),
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
    for _ in range(SEARCH_ROUNDS):
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


@with_exit_code
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("camera", __doc__, command=None)
    parser.add_argument("--frames", type=Path, help="folder of pictures of AWS's simulator, 160x120")
    parser.add_argument("--poses", type=int, default=200)
    options = parser.parse_args(arguments)
    if "MUJOCO_GL" not in os.environ:
        # MuJoCo reads it when it is imported, which has already happened.
        os.environ["MUJOCO_GL"] = "egl"
        os.execv(sys.executable, [sys.executable, "-m", "benchmarks.camera", *(arguments or sys.argv[1:])])
    summary = compare_with_mujoco(options.poses)
    rows = [(key, number(value, 2)) for key, value in summary.items() if isinstance(value, float)]
    if options.frames is not None:
        summary["real_frames"] = explain_frames(options.frames, service_lens(WIDTH, HEIGHT))
        for colors in ("own", "fitted"):
            found = summary["real_frames"][colors]
            rows += [
                (f"real frames, {colors} colours: {key}", number(value, 2)) for key, value in found.items()
            ]
    print(table(("figure", "value"), rows))
    write_json(options.json, summary)


if __name__ == "__main__":
    sys.exit(main())
