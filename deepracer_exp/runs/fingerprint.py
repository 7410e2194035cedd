"""Fingerprint of a run's configuration and files; a resume with others is refused."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepracer_exp.config.stored import ABSENT, config_differences, describe_differences
from deepracer_exp.env.action_space import ActionSpace, DiscreteActions
from deepracer_exp.env.setup import RaceSetup
from deepracer_exp.errors import BadInput

HARMLESS = (
    "budget",
    "checkpoints.keep",
    "collector.hang_timeout_s",
    "reward.time_limit_s",
    "stopping",
    "tracking",
    "debug",
    "report",
    "trace",
)
"""Keys, or their first parts, without influence on learning. `runs_dir` is where the run is found."""
_MEASURED_BY = "stopping.episodes"
"""Number of episodes behind `lap_share` in every row of metrics.jsonl."""
REMEMBERED_EPISODES = 50
"""Number of remembered episodes where the stopping rule has none."""


def fingerprint(config: Mapping[str, Any], setup: RaceSetup) -> dict[str, Any]:
    """Return the configuration of a run and a hash of each of the files it was made from, JSON types."""
    return {"config": dict(config), "files": _hashes(setup)}


def refuse_changes(
    run_dir: Path, before: Mapping[str, Any], config: Mapping[str, Any], setup: RaceSetup
) -> None:
    """Refuse to resume a run with values or files other than its own.

    `before` is its `fingerprint`; `config` and `setup` are those to resume with.

    Raises:
        BadInput: a value or a file that matters differs; all of them are named.
    """
    different = config_differences([before["config"], config])
    changed = describe_differences(
        {key: values for key, values in different.items() if not _is_harmless(key, values)}
    )
    now = _hashes(setup)
    changed += [f"{file} has other contents" for file in now if now[file] != before["files"].get(file)]
    if changed:
        raise BadInput(
            run_dir,
            f"was started with other values: {'; '.join(changed)}; accepted changes: {', '.join(HARMLESS)}; "
            "`deepracer-exp clone` makes a new run with others",
        )


def _is_harmless(key: str, values: Sequence[Any]) -> bool:
    if key == _MEASURED_BY:
        return len({REMEMBERED_EPISODES if value == ABSENT else value for value in values}) == 1
    return key == "runs_dir" or any(key == part or key.startswith(f"{part}.") for part in HARMLESS)


def _hashes(setup: RaceSetup) -> dict[str, str]:
    tracks = {
        f"track {course.name}": [
            part for track in course.tracks for part in (track.waypoints, track.inner, track.outer)
        ]
        for course in setup.courses
    }
    return {
        f"reward {setup.reward.name}": setup.reward.sha256,
        "action space": _sha256(_commands(setup.actions)),
        **{name: _sha256(parts) for name, parts in tracks.items()},
    }


def _commands(actions: ActionSpace) -> list[np.ndarray]:
    if isinstance(actions, DiscreteActions):
        return [actions.steering_deg, actions.speed_mps]
    return [actions.low, actions.high]


def _sha256(parts: Sequence[np.ndarray]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()
