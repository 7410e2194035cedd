"""The real `deepracer-exp`, run as a racer runs it."""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import yaml

from deepracer_exp.runs.run_result import FINISHED, STOPPED_EARLY

Result = TypeVar("Result")


def command_line(*arguments: str) -> list[str]:
    """Return `deepracer-exp ARGUMENTS` of this Python's environment."""
    return [str(Path(sys.executable).with_name("deepracer-exp")), *arguments]


def train(overrides: Sequence[str], folder: Path, command: str = "train") -> Path:
    """Run `deepracer-exp train` (or `clone`) in `folder` and return the run's folder.

    Raises:
        SystemExit: the command did not end with exit code 0; the message is its own.
    """
    line = command_line(command, *overrides)
    before = set(folder.glob("runs/*/*/summary.json"))
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}\n{done.stderr}")
    (summary,) = set(folder.glob("runs/*/*/summary.json")) - before
    return summary.parent


def run_benchmark(name: str, *arguments: str) -> dict[str, Any]:
    """Run `python -m benchmarks.NAME` and return the JSON of its last line.

    Raises:
        SystemExit: it did not end with exit code 0; the message is its own.
    """
    line = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}\n{done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def spent(*arguments: str) -> tuple[float, resource.struct_rusage]:
    """Return the seconds from start to end of `deepracer-exp ARGUMENTS`, and what it used.

    Raises:
        SystemExit: the command did not end with exit code 0.
    """
    line = command_line(*arguments)
    began = time.perf_counter()
    child = os.posix_spawn(
        line[0], line, os.environ, file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    )
    _, status, usage = os.wait4(child, 0)
    if status != 0:
        raise SystemExit(f"{' '.join(line)}: exit code {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - began, usage


def trained(folder: Path, overrides: Sequence[str]) -> Path:
    """Return a finished run of these overrides in `folder`; train if there is none."""
    for summary in sorted(folder.glob("runs/*/*/summary.json")):
        run = summary.parent
        stored = yaml.safe_load((run / "overrides.yaml").read_text(encoding="utf-8"))
        if stored == list(overrides) and read_summary(run)["status"] in (FINISHED, STOPPED_EARLY):
            return run
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    run = train(overrides, folder)
    print(f"{folder.name}: {run.parent.name} trained in {time.monotonic() - began:.0f} s", flush=True)
    return run


def at_once(jobs: int, calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """Make the calls, `jobs` at once, and return their results in order; the first failure cancels the rest."""
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(call) for call in calls]
        try:
            return [one.result() for one in waiting]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def read_summary(run: Path) -> dict[str, Any]:
    """Return a run's summary.json."""
    summary: dict[str, Any] = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    return summary


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's metrics.jsonl."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
