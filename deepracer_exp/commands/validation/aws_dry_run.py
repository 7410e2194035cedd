"""Call a reward function as deepracer-on-aws' validator does, and return its objections."""

import json
import math
import signal
import subprocess
import sys
from typing import Any

import numpy as np

from deepracer_exp.rewards.reward import MAX_REWARD
from deepracer_exp.rewards.source import RewardSource, source_with_constants
from deepracer_exp.tracks.track import Track

from .aws_rules import AwsFinding, late_imports

_MODULE = "deepracer_exp.commands.validation.aws_calls"
_LIMIT_S = 5.0
"""CPU seconds of a call."""
_LONGEST_S = 120.0
"""Time limit of a function that waits without computing."""
_OBJECTS = 6


def dry_run_findings(source: RewardSource, track: Track) -> list[AwsFinding]:
    """Return the reasons why the validator would refuse a function after calling it; empty if it would accept it.

    The function is called in a process of its own. As there, the module is loaded once for all calls and run again in
    the same namespace before each of them.
    """
    situations = validator_params(track)
    answers, ending = _answers(source, situations)
    if "load" not in answers:
        return [AwsFinding(0, f"cannot be imported: {ending}")]
    if answers["load"] is not None:
        return [AwsFinding(0, answers["load"])]
    findings: list[AwsFinding] = []
    signature = answers.get("signature")
    if signature is not None:
        text = f"reward_function{signature}: exactly one parameter is accepted, reward_function(params)"
        findings.append(AwsFinding(0, text))
    if "imports" in answers:
        findings += late_imports(source_with_constants(source), **answers["imports"])
    wrong: dict[str, list[str]] = {}
    for name in situations:
        what = answers.get(name, ending)
        if what is not None:
            wrong.setdefault(what, []).append(name)
        if name not in answers:
            break
    return findings + [AwsFinding(0, f"{what}, called {', '.join(names)}") for what, names in wrong.items()]


def _answers(source: RewardSource, situations: dict[str, dict[str, Any]]) -> tuple[dict[str, Any], str]:
    """Return the result of each finished step of `aws_calls`, and the ending of the process."""
    request = {
        "path": source.path,
        "text": source_with_constants(source),
        "limit_s": _LIMIT_S,
        "most": MAX_REWARD,
        "situations": situations,
    }
    command = [sys.executable, "-P", "-m", _MODULE]
    stdin = json.dumps(request, default=np.ndarray.tolist).encode()
    try:
        process = subprocess.run(command, input=stdin, capture_output=True, timeout=_LONGEST_S, check=False)
    except subprocess.TimeoutExpired as error:
        output, ending = error.stdout or b"", f"took longer than {_LONGEST_S:g} s"
    else:
        output, code = process.stdout, process.returncode
        ending = (
            f"took longer than {_LIMIT_S:g} s of CPU"
            if code == -signal.SIGPROF
            else f"ended its process with code {code}"
        )
        if not output:
            raise RuntimeError(f"{_MODULE} did not start: {process.stderr.decode(errors='replace')}")
    return dict(map(json.loads, output.splitlines())), ending


def validator_params(track: Track) -> dict[str, dict[str, Any]]:
    """Return the params with which the validator calls a function, by situation.

    They are not those of a training: 24 of the 27 keys, some numbers are integers, `waypoints` is an array (n, 2) of
    the inner border, the track is reversed, and six objects stand on it. Source: get_params in deepracer-on-aws,
    test_reward_function.py; the objects are placed evenly here.
    """
    inner, outer, center = track.inner, track.outer, track.waypoints
    n = len(inner)
    width_m = math.dist(inner[0], outer[0])
    to_outer = (outer[0] - center[0]) / math.dist(outer[0], center[0])
    beside = center[0] + to_outer * width_m
    waypoint = np.linspace(0, n, _OBJECTS, endpoint=False, dtype=np.intp)
    distances_m = track.length_m * (waypoint + 1) / n

    def params(
        x_y: np.ndarray,
        progress: int,
        steps: int,
        speed: float,
        steering_angle: float,
        heading: float = 359.9,
        closest_waypoints: tuple[int, int] = (0, 1),
        is_offtrack: bool = False,
    ) -> dict[str, Any]:
        return {
            "all_wheels_on_track": not is_offtrack,
            "x": x_y[0],
            "y": x_y[1],
            "distance_from_center": width_m if is_offtrack else 0,
            "heading": heading,
            "progress": progress,
            "steps": steps,
            "speed": speed,
            "steering_angle": steering_angle,
            "track_width": width_m,
            "waypoints": inner.copy(),
            "closest_waypoints": list(closest_waypoints),
            "is_left_of_center": True,
            "is_reversed": True,
            "track_length": float(np.hypot(*np.diff(inner, axis=0).T).sum()),
            "closest_objects": [0, 1],
            "objects_location": center[waypoint].tolist(),
            "objects_left_of_center": [True, True, False, True, False, True],
            "object_in_camera": True,
            "objects_speed": [0.2] * _OBJECTS,
            "objects_heading": np.linspace(-2.0, 2.0, _OBJECTS).tolist(),
            "objects_distance": distances_m.tolist(),
            "is_crashed": False,
            "is_offtrack": is_offtrack,
        }

    return {
        "at the start": params((inner[0] + center[0]) / 2, 0, 1, 0.5, 6, 0),
        "on the start line": params(inner[0], 0, 1, 0.1, 0.2, 0),
        "half-way": params(inner[n // 2], 50, 100, 1.0, 6, closest_waypoints=(3, 4)),
        "off the track": params(beside, 0, 1, 1, 15, is_offtrack=True),
        "at the finish": params(inner[-1], 100, 10_000, 5.0, 0, closest_waypoints=(n - 2, n - 1)),
    }
