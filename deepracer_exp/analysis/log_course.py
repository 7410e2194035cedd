"""Which courses a recording was driven on."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from pydantic import TypeAdapter, ValidationError

from deepracer_exp.config import options
from deepracer_exp.config.track import TrackConfig
from deepracer_exp.errors import BadInput
from deepracer_exp.formats.recording import LogProblem, Recording
from deepracer_exp.formats.run_files import read_config
from deepracer_exp.tracks.track import Track

_SAMPLE = 2000
"""Rows of a course that are looked at to find out which it is."""
_LENGTH_NEAR = 0.01
"""Share by which a logged length may differ from that of the course."""
_INSIDE = 0.95
"""Share of the rows that must be on or just beside the road."""
_BESIDE_M = 0.3
"""How far beside the road a car still gets before its episode ends."""


@dataclass(frozen=True, kw_only=True)
class Courses:
    """The courses of a recording, in the direction in which most of its rows were driven."""

    tracks: Mapping[str, Track]
    """By the name in `steps.track`."""
    problems: tuple[LogProblem, ...]
    """Courses that were not found, with the reason."""


def find_courses(recording: Recording) -> Courses:
    """Find the course of each name in a recording's `steps.track`.

    A run of ours has its courses in its config.yaml. Other names are looked up in the catalogue; a name that is
    unknown or not told is found by the course's length and by where the car drove.
    """
    own, problems = _own_courses(recording)
    tracks: dict[str, Track] = {}
    names = recording.steps["track"].astype("category")
    for code, name in enumerate(names.cat.categories):
        rows = np.flatnonzero(names.cat.codes.to_numpy() == code)
        if not len(rows):
            continue
        sample = recording.steps.iloc[rows[:: max(1, len(rows) // _SAMPLE)]]
        head = recording.steps.iloc[rows[: 10 * _SAMPLE]]
        told = str(name) or recording.track or ""
        config = own.get(told) or _known(told) or _driven_on(sample)
        if config is None:
            problems.append(LogProblem(recording.name, None, _unknown(told, sample)))
            continue
        try:
            track = Track.from_config(config, reversed=False)
            tracks[str(name)] = Track.from_config(config, reversed=True) if _backwards(track, head) else track
        except BadInput as error:
            problems.append(LogProblem(recording.name, None, str(error)))
    return Courses(tracks=tracks, problems=tuple(problems))


def catalogue_track(name: str, reversed: bool = False) -> Track:
    """Return a course of the catalogue, or of a route file (.npy) or a YAML of knots.

    Raises:
        BadInput: there is no such course.
    """
    if name.endswith((".npy", ".yaml", ".yml")):
        template = next(config for one in options.options("track") if (config := _known(one)) is not None)
        return Track.from_config(replace(template, file=name), reversed=reversed)
    config = _known(name)
    if config is None:
        raise BadInput(
            f"track={name}: no such track; accepted: {', '.join(options.options('track'))}, or a file"
        )
    return Track.from_config(config, reversed=reversed)


def _own_courses(recording: Recording) -> tuple[dict[str, TrackConfig], list[LogProblem]]:
    """Return the courses of a run's config.yaml by their names in its trace."""
    for file in recording.files:
        if file.name == "config.yaml":
            try:
                track = read_config(file.parent).get("track")
                one = isinstance(track, Mapping) and "name" in track
                parts = (
                    {} if not isinstance(track, Mapping) else {str(track["name"]): track} if one else track
                )
                return {str(name): _typed(part, str(file)) for name, part in parts.items()}, []
            except BadInput as error:
                return {}, [LogProblem(str(file), None, str(error))]
    return {}, []


def _known(name: str) -> TrackConfig | None:
    """Return the course of the catalogue that has the name, in any case of letters."""
    name = name.rsplit("/", 1)[-1].lower()
    found = next((option for option in options.options("track") if option.lower() == name), None)
    return None if found is None else _option(Path(options.find(f"track/{found}.yaml")))


@cache
def _option(path: Path) -> TrackConfig:
    values: dict[str, Any] = {}
    own = yaml.safe_load(path.read_text(encoding="utf-8"))
    for base in own.pop("defaults", []):
        if base != "_self_":
            values |= yaml.safe_load((path.parent / f"{base}.yaml").read_text(encoding="utf-8"))
    for key, value in own.items():
        both = isinstance(value, dict) and isinstance(values.get(key), dict)
        values[key] = values[key] | value if both else value
    return _typed(values, str(path))


def _typed(values: Mapping[str, Any], source: str) -> TrackConfig:
    try:
        return TypeAdapter(TrackConfig).validate_python(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise BadInput(
            f"{source}: track.{key}: {first['msg']}; accepted: a course as in conf/track/"
        ) from None


def _driven_on(sample: pd.DataFrame) -> TrackConfig | None:
    """Return the course of the catalogue on which the rows lie, None where they lie on none."""
    points = sample[["X", "Y"]].to_numpy(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    length_m = float(sample["track_len"].median())
    best: tuple[float, TrackConfig] | None = None
    for name in options.options("track"):
        config = _known(name)
        if config is None or not len(points):
            continue
        track = Track.from_config(config, reversed=False)
        if abs(track.length_m - length_m) > _LENGTH_NEAR * track.length_m:
            continue
        off_m = np.abs(track.project(points).offset_m)
        if np.mean(off_m < track.width_max_m / 2 + _BESIDE_M) >= _INSIDE:
            middle = float(np.median(off_m))
            # Courses of one shape differ in their floors only; the first one, by name, stands for all.
            if best is None or middle < best[0] - 1e-9:
                best = middle, config
    return None if best is None else best[1]


def _backwards(track: Track, head: pd.DataFrame) -> bool:
    """Tell whether progress grows against the order of the waypoints in most episodes."""
    head = head.sort_values("episode", kind="stable")
    points = head[["X", "Y"]].to_numpy(np.float64)
    gone = np.diff(track.project(points).ndist)
    gone = (gone + 0.5) % 1.0 - 0.5 if track.closed else gone
    gained = np.diff(head["progress"].to_numpy(np.float64))
    same = head["episode"].to_numpy()[1:] == head["episode"].to_numpy()[:-1]
    looked_at = same & (np.abs(gained) < 20.0) & np.isfinite(gone)
    return float(np.sum((gone * gained)[looked_at])) < 0.0


def _unknown(name: str, rows: pd.DataFrame) -> str:
    who = f"track {name!r} is" if name else "the name of the track is not told, and it is"
    return (
        f"{who} none of the catalogue ({float(rows['track_len'].median()):.3f} m long); "
        "what needs its shape is left out"
    )
