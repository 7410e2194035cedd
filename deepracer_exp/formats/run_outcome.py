"""What came of a run, and what a racer does next: for everything that tells either."""

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .run_files import RunRecord

COMMAND = "deepracer-exp"
_UNKNOWN = "\N{EN DASH}"


def outcome(run: RunRecord) -> list[tuple[str, str]]:
    """Return what was driven and what came of it, in names and values, the evaluation before the training."""
    tracks, reward = run.config.get("track") or {}, run.config.get("reward") or {}
    courses = [tracks] if "title" in tracks else list(tracks.values())
    names = [f"{one['title']}{_way(one)}" for one in courses if isinstance(one, Mapping) and "title" in one]
    found = [
        ("Track", ", ".join(names) or _UNKNOWN),
        ("Reward", str(reward.get("name") or reward.get("file") or _UNKNOWN)),
    ]
    best = run.summary.get("best")
    if best:
        held_out = best.get("held_out_completion")
        found += [
            (
                "Lap time in evaluation",
                _number(best.get("eval_lap_time_s"), "{:.2f} s, mean of the complete laps"),
            ),
            ("Completion in evaluation", _number(best.get("eval_completion"), "{:.0f} %")),
            *(
                [("On conditions not trained on", _number(held_out, "{:.0f} %"))]
                if held_out is not None
                else []
            ),
            ("Best checkpoint", f"{best['iteration']:06d}, after iteration {best['iteration']}"),
        ]
    elif run.summary:
        found.append(("In evaluation", "not evaluated"))
    if run.summary:
        found += [
            (
                "Fastest lap of the training",
                _number(run.summary.get("best_lap_time_s"), "{:.2f} s", "no complete lap"),
            ),
            ("How it ended", f"{run.summary.get('status', _UNKNOWN)}: {run.summary.get('reason', _UNKNOWN)}"),
        ]
    else:
        found.append(("How it ended", "not yet: it is running, or was killed"))
    return found


def next_steps(run: RunRecord) -> list[tuple[str, str]]:
    """Return what to do next, each with its command to paste."""
    # Relative to where everything is called from; a name is found in the default folder alone.
    default = run.path.resolve().parent.parent == Path("runs").resolve()
    which = run.path.name if default else str(run.path)
    steps = []
    if run.summary.get("status") not in (None, "failed"):
        steps = [
            ("Race its best checkpoint on fresh laps", command("evaluate", f"run={which}")),
            ("Film its fastest lap", command("evaluate", f"run={which}", "--video", "lap.mp4")),
            ("Train on from it at a tenth of the learning rate", command("clone", f"run={which}")),
        ]
    return [*steps, _resume(run, which)]


def command(*arguments: str) -> str:
    """Return a command of ours, quoted for a shell."""
    return shlex.join([COMMAND, *arguments])


def _resume(run: RunRecord, which: str) -> tuple[str, str]:
    """Return how this run is resumed: what ended it would end it again."""
    if (run.summary.get("stopping") or {}).get("rule") and run.summary.get("status") in (
        "finished",
        "hopeless",
    ):
        return "Resume it without its stopping rule", command("resume", which, "stopping=none")
    if run.summary.get("status") == "finished":
        more = 2 * int(run.summary.get("env_steps") or 0)
        return "Resume it with twice the steps", command("resume", which, f"budget.env_steps={more}")
    return "Resume it", command("resume", which)


def _way(track: Mapping[str, Any]) -> str:
    return "" if track.get("direction", "forward") == "forward" else f", {track['direction']}"


def _number(value: Any, form: str, otherwise: str = "no complete lap") -> str:
    known = isinstance(value, int | float) and math.isfinite(value)
    return form.format(value) if known else otherwise
