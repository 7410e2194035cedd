"""Recordings of the service to fit to and to measure on: their versions, parts, bands of speed and intervals."""

import dataclasses
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.replay import WARM_UP_STEPS, Windows, cut_windows, errors, replay
from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.config.car import CarConfig
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import BadInput

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

LENGTHS = {"one_second": 15, "three_second": 45}
"""Control steps to predict."""
VERSIONS = (4, 5, 6)
"""Of the service's simulation: those with a car of their own, `car=deepracer_v4` and so on."""
BANDS = {"low": (0.0, 1.5), "middle": (1.5, 2.5), "high": (2.5, np.inf)}
"""Mean commanded speed over a window, m/s: from, to below."""
_EVERY_ROWS = 5
_TRIED = 1000
"""Windows by which the version of a recording is found if the recording does not state it."""
_RESAMPLED = 500
_CONFIDENCE = 0.95
_ARCHIVE = re.compile(r"\.(?:tar|tgz|tar\.(?:gz|bz2|xz)|(?:log|txt)\.(?:gz|bz2|xz))$")


@dataclasses.dataclass(frozen=True)
class Recorded:
    """One recording of a service's car: a training, an evaluation or a race."""

    name: str
    """Of the file or folder; if it holds several recordings, with the recording's stream."""
    version: int
    stated: bool
    """Whether the recording states its version; else it is the one whose car predicts the recording best."""
    steps: pd.DataFrame
    windows: dict[str, Windows]
    """By the names of `LENGTHS`."""


class Median(NamedTuple):
    """Median error in metres with a 95% interval that resamples episodes; None without windows."""

    windows: int
    episodes: int
    error_m: float | None
    interval_m: tuple[float, float] | None


def car_named(name: str) -> CarConfig:
    """Return the car of an option of `conf/car/`.

    Raises:
        BadInput: there is none of that name.
    """
    return compose_experiment([f"car={name}"])[0].car


def read_recorded(paths: Sequence[Path]) -> list[Recorded]:
    """Read recordings; in a folder of archives, those of each archive.

    Raises:
        BadInput: there is nothing, or nothing that can be read.
    """
    cars = {version: car_named(f"deepracer_v{version}") for version in VERSIONS}
    found = []
    for path in dict.fromkeys(one for given in paths for one in _archives(given)):
        recording = read_recording(path)
        for problem in recording.problems:
            print(problem, file=sys.stderr)
        name, metadata = path.resolve().name, recording.metadata
        stated = metadata is not None and "version" in metadata.set_keys and metadata.version in VERSIONS
        streams = list(recording.steps.groupby("stream", sort=False, observed=True))
        for stream, steps in streams:
            windows = {
                length: cut_windows(steps, cars[VERSIONS[0]].front_point_m, count, _EVERY_ROWS)
                for length, count in LENGTHS.items()
            }
            version = (
                metadata.version if metadata is not None and stated else _nearest(cars, windows["one_second"])
            )
            of = name if len(streams) == 1 else f"{name} {stream}"
            found.append(Recorded(of, version, stated, steps, windows))
    if not found:
        raise BadInput(f"--traces {' '.join(map(str, paths))}: no recorded steps; accepted: recorded drives")
    return found


def describe(one: Recorded) -> str:
    """Return a line for a recording: version, windows, and how many were left out."""
    source = "as it states" if one.stated else "the nearest: it states none"
    windows = one.windows["one_second"]
    return (
        f"{one.name}: version {one.version}, {source}; {len(windows)} windows of a second, {windows.left_out} left "
        "out, since the car was paused or put elsewhere"
    )


def _archives(path: Path) -> list[Path]:
    """Return the recordings in a folder that holds nothing but archives, else the path itself."""
    inside = sorted(path.iterdir()) if path.is_dir() else []
    return inside if inside and all(_ARCHIVE.search(one.name) for one in inside) else [path]


def _nearest(cars: dict[int, CarConfig], windows: Windows) -> int:
    """Return the version whose car predicts a recording best."""
    some = windows.choose(np.linspace(0, len(windows) - 1, min(_TRIED, len(windows))).astype(np.intp))
    if not len(some):
        return VERSIONS[-1]
    off = {
        version: np.median(errors(replay(car, some), some).distance_m[:, -1]) for version, car in cars.items()
    }
    return min(VERSIONS, key=lambda version: float(np.nan_to_num(off[version], nan=np.inf)))


def join(parts: Sequence[Windows]) -> Windows:
    """Return the windows of several recordings as one; their episodes stay distinct."""
    apart, begin = [], 0
    for part in parts:
        apart.append(part.episode + begin)
        begin += int(part.episode.max(initial=-1)) + 1
    columns = {
        one.name: np.concatenate([getattr(part, one.name) for part in parts])
        for one in dataclasses.fields(Windows)
        if one.name not in ("episode", "left_out")
    }
    return Windows(**columns, episode=np.concatenate(apart), left_out=sum(part.left_out for part in parts))


def mean_speed_mps(windows: Windows) -> Floats:
    """Return the mean speed that is commanded in each window."""
    mean: Floats = windows.action[:, WARM_UP_STEPS:, 0].mean(axis=1)
    return mean


def in_band(windows: Windows, band: str) -> Mask:
    """Return for each window whether its mean commanded speed is in a band."""
    low, high = BANDS[band]
    mean_mps = mean_speed_mps(windows)
    inside: Mask = (mean_mps >= low) & (mean_mps < high)
    return inside


def sample(windows: Windows, most: int, seed: int) -> Windows:
    """Return at most `most` windows: an equal share from each band, or all of a smaller one."""
    rng = np.random.default_rng(seed)
    groups = [rng.permutation(np.flatnonzero(in_band(windows, band))) for band in BANDS]
    chosen: list[NDArray[np.intp]] = []
    left = most
    # The smallest first: what it does not take is left for the others.
    for at, group in enumerate(sorted(groups, key=len)):
        chosen.append(group[: left // (len(groups) - at)])
        left -= len(chosen[-1])
    return windows.choose(np.sort(np.concatenate(chosen)))


def median_error(off_m: Floats, episode: NDArray[np.int64]) -> Median:
    """Return the median of errors, and its interval by the bootstrap over episodes.

    Args:
        off_m: errors of windows, (M,).
        episode: the episode that each is from, (M,).
    """
    names, number = np.unique(episode, return_inverse=True)
    if not len(names):
        return Median(0, 0, None, None)
    order = np.argsort(off_m)
    ordered, number = off_m[order], number[order]
    rng = np.random.default_rng(0)
    medians = np.empty(_RESAMPLED)
    for at in range(_RESAMPLED):
        weight = np.cumsum(
            np.bincount(rng.integers(len(names), size=len(names)), minlength=len(names))[number]
        )
        medians[at] = ordered[np.searchsorted(weight, 0.5 * weight[-1])]
    edge = 0.5 * (1.0 - _CONFIDENCE)
    low, high = np.quantile(medians, [edge, 1.0 - edge])
    return Median(len(off_m), len(names), float(np.median(off_m)), (float(low), float(high)))


def by_band(off_m: Floats, windows: Windows) -> dict[str, Median]:
    """Return the median errors in each band and, as `all`, over all."""
    bands = {band: in_band(windows, band) for band in BANDS} | {"all": np.full(len(windows), True)}
    return {band: median_error(off_m[of], windows.episode[of]) for band, of in bands.items()}
