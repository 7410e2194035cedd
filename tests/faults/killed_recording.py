"""A recording that is killed with SIGKILL again and again and resumes each time: RUN_DIR URI KILLS.

It stands for a training whose repeated iterations differ (`budget.minutes`). It forks, so that MLflow is imported
once.
"""

import json
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from deepracer_exp.runs.run_files import read_metrics
from deepracer_exp.tracking import projection, projector
from deepracer_exp.tracking.mlflow_metrics import now_ms
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import ProjectedTracker
from deepracer_exp.tracking.tracking_file import TrackedRun, read_tracked_run
from tests.tracking.conftest import ProjectorHere

ITERATIONS = 160
CHECKPOINT_EVERY = 12
KEYS = ("completion", "kl", "env_steps_per_s")


def atomic_write(path: Path, text: str) -> None:
    aside = path.with_name(f".{path.name}")
    aside.write_text(text)
    aside.replace(path)


def save(checkpoints: Path, iteration: int) -> None:
    (checkpoints / f"{iteration:06d}").mkdir(parents=True, exist_ok=True)
    aside = checkpoints / ".last"
    aside.unlink(missing_ok=True)
    aside.symlink_to(f"{iteration:06d}")
    aside.replace(checkpoints / "last")


class Counted(projection.MLflowProjection):
    """Counts in this class what all of them have written."""

    points = 0

    def update(self) -> str | None:
        try:
            return super().update()
        finally:
            Counted.points = self.written


def record(run_dir: Path, uri: str) -> None:
    metrics, checkpoints, identity = (
        run_dir / name for name in ("metrics.jsonl", "checkpoints", "tracking.json")
    )
    projector.UPDATE_S = 0.02
    projection.MLflowProjection = Counted
    tracker = ProjectedTracker(resolve_store(uri, run_dir), ProjectorHere())
    kept = int((checkpoints / "last").resolve().name) if (checkpoints / "last").exists() else 0
    rows = read_metrics(metrics)[:kept] if metrics.exists() else []
    if identity.exists():
        tracker.open(run_dir, read_tracked_run(run_dir))
    else:
        (run_dir / "config.yaml").write_text("checkpoints: {every: 1}\n")
        described = {"params": {"seed": "1"}, "tags": {"run_dir": str(run_dir)}}
        tracker.open(run_dir, TrackedRun("killed", "race", now_ms(), **described))
    atomic_write(metrics, "".join(json.dumps(row) + "\n" for row in rows))
    for iteration in range(kept + 1, ITERATIONS + 1):
        row = {"iteration": iteration, "env_steps": 100 * iteration, "wall_clock_s": time.monotonic()}
        row |= {key: random.random() for key in KEYS}
        with metrics.open("a") as file:
            file.write(json.dumps(row) + "\n")
        if iteration % CHECKPOINT_EVERY == 0:
            tracker.set_tag("half", str(2 * iteration // ITERATIONS))
            save(checkpoints, iteration)
            # So that kills come while the tracker is recording, not later.
            while Counted.points < (2 + len(KEYS)) * (iteration - kept):
                time.sleep(0.001)
        time.sleep(0.01)
    tracker.finish("FINISHED", 200)
    assert tracker.failure is None


def fork(do: Callable[[], None]) -> int:
    child = os.fork()
    if child == 0:
        try:
            do()
            os._exit(0)
        finally:
            traceback.print_exc()
            os._exit(1)
    return child


def lines(path: Path) -> int:
    return path.read_text().count("\n") if path.exists() else 0


def main(run_dir: Path, uri: str, kills: int) -> None:
    metrics = run_dir / "metrics.jsonl"
    os.waitpid(fork(lambda: MLflowRun(resolve_store(uri, run_dir))), 0)  # makes the tables
    for number in range(kills + 1):
        before = lines(metrics)
        child = fork(lambda: record(run_dir, uri))
        if number < kills:
            # While it starts or replays its metrics, or after some iterations.
            wanted = min(before + random.choice((0, 10, 20)), ITERATIONS - 20)
            while lines(metrics) < wanted:
                time.sleep(0.001)
            time.sleep(random.uniform(0, 0.5))
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        print("ended" if status == 0 else "killed", lines(metrics), flush=True)
    assert status == 0


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
