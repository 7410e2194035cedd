"""The real `deepracer-exp train`, run as a racer runs it."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def train(overrides: Sequence[str], folder: Path) -> Path:
    """Run `deepracer-exp train` in `folder` and return the run's folder.

    Raises:
        SystemExit: the command did not end with exit code 0; the message is its own.
    """
    command = [str(Path(sys.executable).with_name("deepracer-exp")), "train", *overrides]
    before = set(folder.glob("runs/*/*/summary.json"))
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr}")
    (summary,) = set(folder.glob("runs/*/*/summary.json")) - before
    return summary.parent


def read_summary(run: Path) -> dict[str, Any]:
    """Return a run's summary.json."""
    summary: dict[str, Any] = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return summary


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's metrics.jsonl."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
