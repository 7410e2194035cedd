"""What came of a run, and what to do next with it, as commands to paste."""

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepracer_exp.runs.files import RunRecord
from deepracer_exp.runs.result import FIGURES, read_result

COMMAND = "deepracer-exp"


def outcome(run: RunRecord) -> list[tuple[str, str]]:
    """Return what was driven, how good the best policy is in evaluation and how the run ended, in names and values.

    Raises:
        BadInput: its summary.json is not what a training writes.
    """
    tracks, reward = run.config.get("track") or {}, run.config.get("reward") or {}
    courses = [
        one for one in ([tracks] if "title" in tracks else tracks.values()) if isinstance(one, Mapping)
    ]
    names = [f"{one.get('title')}, {one.get('direction', 'forward')}" for one in courses]
    found = [
        ("Track", "; ".join(name.removesuffix(", forward") for name in names)),
        ("Reward", str(reward.get("name") or reward.get("file"))),
    ]
    result = read_result(run.path)
    if result is not None and result.evaluated:
        known = [(name, getattr(result, key), form) for name, key, form, _ in FIGURES]
        found += [
            (f"{name[0].upper()}{name[1:]}", form.format(value))
            for name, value, form in known
            if value is not None
        ]
        found.append(("Evaluated, the best", f"checkpoint {result.iteration:06d}"))
    elif run.summary:
        found.append(("Evaluated", "never"))
    ended = (
        f"{run.summary['status']}: {run.summary['reason']}" if run.summary else "not yet, or it was killed"
    )
    return [*found, ("How it ended", ended)]


def next_steps(run: Path, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return commands for a run folder with its summary.json, each with what it does, the first to be used first."""
    word = shlex.quote(run_word(run))
    resume = f"{COMMAND} resume {word}"
    steps = []
    if summary["iteration"]:
        steps += [
            (f"{COMMAND} evaluate {word}", "race the best checkpoint"),
            (f"{COMMAND} evaluate {word} --video lap.mp4", "film its fastest lap"),
            (f"{COMMAND} clone {word}", "train on from it, at a tenth of the learning rate"),
        ]
    if summary["status"] in ("interrupted", "failed"):
        return [(resume, "continue it from its last checkpoint"), *steps]
    rule, _, limit = str(summary["reason"]).partition("budget reached: ")
    spent = {
        "env_steps": summary["env_steps"],
        "iterations": summary["iteration"],
        "minutes": math.ceil(summary["wall_clock_s"] / 60),
    }
    if rule:
        steps.append((f"{resume} stopping=none", "continue it until its budget is used"))
    elif limit in spent:  # else the rest of an experiment's budget decides
        steps.append((f"{resume} budget.{limit}={2 * spent[limit]}", "continue it for as long again"))
    return steps


def run_word(run: Path) -> str:
    """Return what a run is called on the command line: its name where commands look for runs, else its folder."""
    return run.name if run.resolve().parents[1] == Path("runs").resolve() else str(run)
