"""Films of evaluated laps: recording of the steps, interpolation of poses between them, and encoding."""

import io
from collections.abc import Container, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import track as with_progress
from tensordict import TensorDict
from torch import nn

from deepracer_exp.env.race import Race
from deepracer_exp.env.trace_columns import PACKED, STATUS_CODE
from deepracer_exp.errors import RunFailed, writing
from deepracer_exp.sim.scenery import box_corners
from deepracer_exp.tracks.track import Track

from .evaluator import Evaluator
from .race_protocol import Attempt, RaceProtocol
from .results import USUAL, Evaluation

FRAMES_PER_S = 30.0
_LINGER_S = 1.0
"""Seconds for which the last frame is shown."""
_JUMP_M = 1.0
"""Distance that no car drives in a step, but that a car put back may be away."""
_COLUMNS = [PACKED[name] for name in ("X", "Y", "yaw", "steer", "speed_mps", "progress")]


@dataclass(frozen=True, eq=False)
class Lap:
    """The steps of an attempted lap, n of them, the prepare step first."""

    attempt: Attempt
    track: Track
    title: str
    """Track and conditions."""
    x_m: NDArray[np.float64]
    """Front point of the car, (n,)."""
    y_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    steering_rad: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    progress: NDArray[np.float64]
    """Per cent of this lap."""
    time_s: NDArray[np.float64]
    """Seconds since the start of the lap, penalties included."""
    others: NDArray[np.float64] | None = None
    """Boxes and bots as cameras see them (`sim.camera.take_pictures`), (n, K, 9); None: the car is alone."""
    held: NDArray[np.bool_] | None = None
    """Whether the car stands for the seconds of a penalty, (n,), among others."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def boxes(self) -> NDArray[np.float64]:
        """Return the corners of the others that stand still through the lap, (k, 4, 2)."""
        if self.others is None:
            return np.zeros((0, 4, 2))
        still = (self.others[..., :3] == self.others[:1, :, :3]).all(axis=(0, 2))
        return box_corners(self.others[0, still]).astype(np.float64)

    def share(self, step: int) -> float:
        """Return the share of the lap driven before a step."""
        return float(np.clip(self.progress[step] / 100, 0.0, 1.0))


def in_frames(lap: Lap, control_hz: float) -> tuple[Lap, NDArray[np.intp]]:
    """Return a lap's poses `FRAMES_PER_S` times a second, between those of its steps, and the step before each.

    `control_hz` is how many steps the lap has in a second. Where the car was put back onto the track it does not drive.
    """
    held = np.zeros(len(lap), bool) if lap.held is None else lap.held
    time_steps = np.append(np.arange(0.0, len(lap) - 1, control_hz / FRAMES_PER_S), len(lap) - 1)
    step = time_steps.astype(np.intp)
    after = np.minimum(step + 1, len(lap) - 1)
    passed = time_steps - step
    moved_m = np.hypot(lap.x_m[after] - lap.x_m[step], lap.y_m[after] - lap.y_m[step])
    put_back = (lap.time_s[after] - lap.time_s[step] > 1.5 / control_hz) | (held[after] & ~held[step])
    put_back |= moved_m > _JUMP_M
    part = np.where(put_back, 0.0, passed)

    def between(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values[step] + part * (values[after] - values[step])

    others = lap.others
    if others is not None:
        # Bots drive on while the car is put back.
        others = others.copy()
        others[..., 2] = np.unwrap(others[..., 2], axis=0)
        others = others[step] + passed[:, None, None] * (others[after] - others[step])

    shown = replace(
        lap,
        x_m=between(lap.x_m),
        y_m=between(lap.y_m),
        yaw_rad=between(np.unwrap(lap.yaw_rad)),
        steering_rad=between(lap.steering_rad),
        speed_mps=between(lap.speed_mps),
        progress=between(lap.progress),
        time_s=between(lap.time_s),
        others=others,
        held=held[step],
    )
    return shown, step


class LapRecorder:
    """Records the trace of all trials, and the policy's inputs and outputs in one lap."""

    def __init__(self, evaluator: Evaluator, seen_in: Attempt | None = None) -> None:
        """Record the next evaluation.

        `seen_in` is the lap whose inputs and outputs are kept, of an earlier evaluation of the same policy: pictures of
        all laps would not fit into memory.
        """
        self._evaluator, self._seen_in = evaluator, seen_in
        self._steps: list[NDArray[np.float64]] = []
        self._others: list[NDArray[np.float32]] = []
        self._acted: list[TensorDict] = []

    def __call__(self, race: Race, protocol: RaceProtocol, acted: TensorDict) -> None:
        """Record one control step."""
        self._steps.append(np.column_stack([race.trace, protocol.clock_s]))
        if race.others is not None:
            self._others.append(race.others.boxes(np.arange(race.n_cars)))
        if self._seen_in is not None:
            trial = self._seen_in.trial
            before = self._steps[-2][trial, -1] if len(self._steps) > 1 else -1.0
            if _within(self._seen_in, before, protocol.clock_s[trial]):
                self._acted.append(acted[trial].clone())

    @property
    def acted(self) -> TensorDict:
        """The policy's inputs and outputs in the lap `seen_in`, [n]."""
        return torch.stack(self._acted)

    def rows(self, attempt: Attempt) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the steps of a lap and their numbers in the trial.

        A flying lap begins with the last step of the one before.

        Returns:
            Numbers from 0, (n,); columns of the packed trace and the race clock, (n, columns + 1).
        """
        rows = np.array([step[attempt.trial] for step in self._steps])
        lap_rows = np.flatnonzero(_within(attempt, np.r_[-1.0, rows[:-1, -1]], rows[:, -1]))
        return lap_rows, rows[lap_rows]

    def lap(self, attempt: Attempt) -> Lap:
        """Return the poses of a lap."""
        trial, setup = self._evaluator.trials[attempt.trial], self._evaluator.race.setup
        track = setup.courses[trial.course].tracks[0]
        steps, rows = self.rows(attempt)
        x_m, y_m, yaw_deg, steering_deg, speed_mps, progress = rows[:, _COLUMNS].T
        time_s = rows[:, -1] - attempt.begin_s
        return Lap(
            attempt=attempt,
            track=track,
            title=f"{track.title} · {trial.condition.replace('_', ' ')}",
            x_m=x_m,
            y_m=y_m,
            yaw_rad=np.radians(yaw_deg),
            steering_rad=np.radians(steering_deg),
            speed_mps=speed_mps,
            # A flying lap starts with the last pose of the one before, which has that lap's progress.
            progress=np.where(time_s > 0, progress, 0.0),
            time_s=time_s,
            others=np.array([self._others[step][attempt.trial] for step in steps], np.float64)
            if self._others
            else None,
            held=rows[:, PACKED["episode_status"]] == STATUS_CODE["pause"],
        )


def _within(
    lap: Attempt, before_s: NDArray[np.float64] | float, now_s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether steps belong to a lap; the clock of a finished trial stands still."""
    after_begin, before_end = lap.begin_s - 1e-9 <= now_s, now_s <= lap.begin_s + lap.time_s + 1e-9
    return (now_s > before_s) & after_begin & before_end


def best_attempt(evaluation: Evaluation, trials: Container[int] | None = None) -> Attempt:
    """Return the fastest lap on the usual conditions, or the one with the most progress if none is complete.

    `trials` are those that count; None: all.
    """
    attempts = [
        attempt for attempt in evaluation.on(USUAL).attempts if trials is None or attempt.trial in trials
    ]
    return max(attempts, key=lambda a: (a.complete, -a.time_s if a.complete else a.progress))


def drive_best_lap(
    evaluator: Evaluator, policy: nn.Module, trials: Container[int] | None = None
) -> tuple[Lap, TensorDict]:
    """Drive all trials, and again to record the fastest usual lap: every drive of a policy is the same.

    `trials` are those that count; None: all.

    Returns:
        The lap of n steps, and the policy's inputs and outputs in these, [n].
    """
    best = best_attempt(evaluator(policy), trials)
    recorder = LapRecorder(evaluator, best)
    evaluator(policy, recorder)
    return recorder.lap(best), recorder.acted


def write_film(
    file: Path,
    frames: Iterable[NDArray[np.uint8]],
    count: int,
    size: tuple[int, int],
    err: Console,
) -> None:
    """Encode `count` frames, (height, width, 3), as an .mp4 of `FRAMES_PER_S`; the last one is shown for a second.

    `size` is their width and height, multiples of 16 as video codecs want them.

    Raises:
        RunFailed: the file cannot be written.
    """
    from imageio_ffmpeg import write_frames  # not everything that records laps films them

    writer = write_frames(str(file), size, fps=FRAMES_PER_S, quality=8, macro_block_size=16)
    with writing(file, failure=RunFailed), closing(writer):
        writer.send(None)
        for frame in with_progress(frames, "rendering", count, console=err, transient=True):
            writer.send(frame)
        for _ in range(round(_LINGER_S * FRAMES_PER_S)):
            writer.send(frame)


def png(image: Image.Image) -> bytes:
    """Return a picture as the bytes of a PNG."""
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
