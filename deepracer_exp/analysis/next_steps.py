"""What to do next with a run, as commands to paste."""

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

COMMAND = "deepracer-exp"


def next_steps(run: Path, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return commands for a run, the first to be given first, each with what it does.

    Args:
        run: its folder.
        summary: its summary.json.
    """
    word = shlex.quote(run_word(run))
    resume = _resume(word, summary)
    if summary["status"] in ("interrupted", "failed"):
        steps = [resume] if resume else []
        resume = None
    else:
        steps = []
    if summary["iteration"]:
        steps += [
            (f"{COMMAND} evaluate run={word}", "race the best checkpoint"),
            (f"{COMMAND} evaluate run={word} --video lap.mp4", "film its fastest lap"),
            (f"{COMMAND} clone run={word}", "train on from it, at a tenth of the learning rate"),
        ]
    return [*steps, resume] if resume else steps


def run_word(run: Path) -> str:
    """Return what a run is called on the command line: its name where commands look for runs, else its folder."""
    return run.name if run.resolve().parents[1] == Path("runs").resolve() else str(run)


def _resume(word: str, summary: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return how the run itself is continued, None where the rest of an experiment's budget decides."""
    line = f"{COMMAND} resume {word}"
    if summary["status"] in ("interrupted", "failed"):
        return line, "continue it from its last checkpoint"
    begin, _, limit = str(summary["reason"]).partition("budget reached: ")
    if begin:
        return f"{line} stopping=none", "continue it until its budget is used"
    spent = {
        "env_steps": summary["env_steps"],
        "iterations": summary["iteration"],
        "minutes": math.ceil(summary["wall_clock_s"] / 60),
    }
    return (
        (f"{line} budget.{limit}={2 * spent[limit]}", "continue it for as long again")
        if limit in spent
        else None
    )
