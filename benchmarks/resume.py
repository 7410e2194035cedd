"""Does a run that is killed again and again end as if nothing had happened?

    python -m benchmarks.resume [--kills 20] [--seed 0] [--json FILE] [OVERRIDE...]

A small run, once undisturbed; and once killed (SIGKILL, all its processes) at random moments and continued each time by
`deepracer-exp resume RUN`. What must be equal bit for bit at the end: the last checkpoint's networks, optimizer and
schedule, all rows of metrics.jsonl but their times, and the simulation trace; and MLflow must have each point of
metrics.jsonl once. The killed run's rows are compared with the undisturbed one's, its points with its own rows.

The moment of a kill is drawn uniformly from the start of the process on: over the time that it takes to begin plus
twice its share of the work left, so that the kills spread over the whole run and some fall into the beginning. The last
is drawn over all the work left. A kill before the run has a folder is followed by a new `deepracer-exp train`. If a run
ends before its moment, everything is restored to what it was before that process, and a moment within the time it took
is drawn.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from .command import command_line, read_metrics
from .report import benchmark_parser, machine, table, write_json
from .same import different_points, different_rows, different_tensors, different_traces

# 300 iterations of a tenth of a second: checkpoints are a second apart, so that killed processes get somewhere.
SMALL = (
    "experiment=tiny",
    "stopping=none",
    "collector=sync",
    "collector.processes=2",
    "budget.env_steps=307200",
)
_POLL_S = 0.05
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Pace:
    """How long an undisturbed run takes."""

    start_s: float
    """From the start of the process to the first row of metrics.jsonl."""
    work_s: float
    """From there to the end of the process."""
    iterations: int


def latest_kill_s(pace: Pace, iteration: int, left: int) -> float:
    """Return the end of the time over which the next kill is drawn, seconds since the start of its process.

    Args:
        pace: of the undisturbed run.
        iteration: from which the process continues.
        left: kills that are left to do, the next one included.
    """
    remaining_s = pace.work_s * (1 - iteration / pace.iterations)
    return pace.start_s + remaining_s * min(1.0, 2 / (left + 1))


def undisturbed(overrides: Sequence[str], folder: Path) -> tuple[Path, Pace]:
    """Train without a kill and return the run and its pace."""
    start_s, began = 0.0, time.monotonic()
    with _started(folder, "train", *overrides) as process:
        while process.poll() is None:
            if not start_s and any(file.stat().st_size for file in folder.glob("runs/*/*/metrics.jsonl")):
                start_s = time.monotonic() - began
            time.sleep(_POLL_S)
    _check_end(process, folder)
    (run,) = (path.parent for path in folder.glob("runs/*/*/summary.json"))
    return run, Pace(start_s, time.monotonic() - began - start_s, len(read_metrics(run)))


def killed(
    overrides: Sequence[str], folder: Path, kills: int, pace: Pace, rng: random.Random
) -> tuple[Path, list[dict[str, Any]]]:
    """Train, kill and continue; return the run and what is known of each kill."""
    done: list[dict[str, Any]] = []
    as_it_was = folder.with_name(f"{folder.name}-before")
    known_s: float | None = None
    while True:
        run, left = _run_in(folder), kills - len(done)
        before = _last_iteration(run)
        latest_s = latest_kill_s(pace, before, left) if known_s is None else known_s
        moment_s = rng.uniform(0.0, latest_s) if left else None
        # A run killed after its summary was written has ended; resuming it may be refused.
        accepted = (0, 2) if run is not None and _has_ended(run) else (0,)
        shutil.rmtree(as_it_was, ignore_errors=True)
        shutil.copytree(folder, as_it_was, symlinks=True)
        since, began = time.time(), time.monotonic()
        with _started(folder, *(["train", *overrides] if run is None else ["resume", str(run)])) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(moment_s)
            returned, known_s = process.returncode is not None, None
        took_s = time.monotonic() - began
        after = _run_in(folder)
        if returned:
            _check_end(process, folder, accepted)
        if not left:
            assert after is not None
            return after, done
        if returned or (after is not None and _has_ended(after) and left > 1):
            known_s = took_s
            shutil.rmtree(folder)
            as_it_was.rename(folder)
            print(f"ended before it was to be killed: back to iteration {before}", flush=True)
            continue
        kill = {
            "after_s": round(took_s, 2),
            "began_at": before,
            "rows": 0 if after is None else _rows(after),
            "checkpoint": _last_iteration(after),
            "hit": _hit(after, before, pace.iterations, since),
        }
        done.append(kill)
        print(f"kill {len(done)}: {kill}", flush=True)


def compare(whole: Path, resumed: Path) -> dict[str, str | None]:
    """Return for each thing that must be equal what differs; None for what does not."""
    lasts = [(run / "checkpoints" / "last").resolve() for run in (whole, resumed)]
    named = lasts[0].name != lasts[1].name
    return {
        "weights": f"{lasts[0].name} and {lasts[1].name}" if named else different_tensors(*lasts),
        "metrics": different_rows(read_metrics(whole), read_metrics(resumed)),
        "trace": different_traces(whole, resumed),
        "mlflow": different_in_mlflow(resumed),
    }


def different_in_mlflow(run: Path) -> str | None:
    """Return which of a run's metrics MLflow does not have exactly once."""
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=f"sqlite:///{run.parents[1].resolve() / 'mlflow.db'}")
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    found = client.search_runs(experiments, f"tags.run_dir = '{run.resolve()}'")
    if len(found) != 1:
        return f"{len(found)} runs of the folder {run.name}"
    run_id, keys = found[0].info.run_id, found[0].data.metrics
    history = {key: client.get_metric_history(run_id, key) for key in keys}
    points = {key: [(point.step, point.value) for point in of] for key, of in history.items()}
    return different_points(read_metrics(run), points)


@contextlib.contextmanager
def _started(folder: Path, *arguments: str) -> "Iterator[subprocess.Popen[bytes]]":
    """Start a command; at the end kill it and all that it has started."""
    with (folder / "output.txt").open("ab") as output:
        process = subprocess.Popen(
            command_line(*arguments),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        _wait_for_end(process.pid)


def _check_end(process: "subprocess.Popen[bytes]", folder: Path, accepted: Sequence[int] = (0,)) -> None:
    if process.returncode not in accepted:
        output = (folder / "output.txt").read_text(encoding="utf-8")
        raise SystemExit(f"{process.args!r}: exit code {process.returncode}\n{output[-3000:]}")


def _has_ended(run: Path) -> bool:
    summary = run / "summary.json"
    return summary.exists() and json.loads(summary.read_text(encoding="utf-8"))["status"] == "finished"


def _wait_for_end(group: int) -> None:
    """Wait until no process of a killed group lives."""
    give_up_at = time.monotonic() + _PATIENCE_S
    while _lives(group):
        if time.monotonic() > give_up_at:
            raise SystemExit(f"process group {group} lives on after SIGKILL")
        time.sleep(_POLL_S)


def _lives(group: int) -> bool:
    for process in psutil.process_iter():
        try:
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                return True
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    return False


def _run_in(folder: Path) -> Path | None:
    """Return the run that can be continued."""
    runs = [path.parent for path in folder.glob("runs/*/*/config.yaml")]
    if len(runs) > 1:
        raise SystemExit(f"{folder}: {len(runs)} runs: a resumed run has got a new folder")
    return runs[0] if runs else None


def _last_iteration(run: Path | None) -> int:
    last = None if run is None else run / "checkpoints" / "last"
    return int(last.resolve().name) if last is not None and last.exists() else 0


def _rows(run: Path) -> int:
    file = run / "metrics.jsonl"
    return file.read_bytes().count(b"\n") if file.exists() else 0


def _hit(run: Path | None, before: int, iterations: int, since: float) -> str:
    """Return what a process was doing when it was killed.

    Args:
        run: its folder.
        before: the iteration it resumed from.
        iterations: of the whole run.
        since: when it was started, seconds since the epoch.
    """
    if run is None:
        return "no folder yet"
    metrics = run / "metrics.jsonl"
    # The rows may still be those of the process before.
    if not metrics.exists() or metrics.stat().st_mtime < since or _rows(run) <= before:
        return "beginning"
    if any(path.is_dir() and not path.is_symlink() for path in run.glob("checkpoints/.*")):
        return "writing a checkpoint"
    return "ending" if _rows(run) >= iterations else "training"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = benchmark_parser("resume", __doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments, not of the run")
    options = parser.parse_args(arguments)
    # What it starts is in sessions of its own, and must not outlive it.
    signal.signal(signal.SIGTERM, lambda signum, _: sys.exit(128 + signum))
    overrides = [*SMALL, *options.overrides]
    with tempfile.TemporaryDirectory() as temporary:
        folders = [Path(temporary) / name for name in ("whole", "killed")]
        for folder in folders:
            folder.mkdir()
        whole, pace = undisturbed(overrides, folders[0])
        print(f"undisturbed: {pace} on {machine()['cores']} cores", flush=True)
        resumed, kills = killed(overrides, folders[1], options.kills, pace, random.Random(options.seed))
        different = compare(whole, resumed)
    hits = Counter(kill["hit"] for kill in kills)
    print(f"\n{table(('killed while', 'times'), [(what, str(count)) for what, count in hits.items()])}\n")
    for what, difference in different.items():
        print(f"{what}: {difference or 'equal'}")
    result = {
        "kills": len(kills),
        "equal": not any(different.values()),
        "different": different,
        "iterations": pace.iterations,
        "hits": dict(hits),
        "moments": kills,
        "seed": options.seed,
        "overrides": overrides,
    }
    write_json(options.json, result)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
