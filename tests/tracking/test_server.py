"""The tracker against a real server that is stopped, killed and started again."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mlflow import MlflowClient

from deepracer_exp.tracking.metrics import metric_name
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracker import MLflowTracker

pytestmark = pytest.mark.slow


def test_a_server_killed_and_restarted_mid_run_has_every_point_once(server, tmp_path, wait_until, identity):
    tracker = MLflowTracker(resolve_store(server.uri, tmp_path))
    tracker.start("run", "race", {"seed": 1}, {"track": "oval"}, identity)
    tracker.safe_until(100)
    for step in range(20):
        tracker.log({"completion": float(step)}, step)
    wait_until(lambda: tracker.waiting == 0)
    server.kill()
    for step in range(20, 40):
        tracker.log({"completion": float(step)}, step)
    assert tracker.waiting == 20
    (tmp_path / "summary.json").write_text("{}")
    tracker.log_artifact(tmp_path / "summary.json", "reports")
    server.start()
    assert tracker.finish("KILLED", deadline_s=60) == 0
    client = MlflowClient(tracking_uri=server.uri)
    points = client.get_metric_history(tracker.run_id, "train/completion")
    assert sorted((point.step, point.value) for point in points) == [(n, float(n)) for n in range(40)]
    assert client.get_run(tracker.run_id).info.status == "KILLED"
    assert [file.path for file in client.list_artifacts(tracker.run_id, "reports")] == [
        "reports/summary.json"
    ]


def test_a_hanging_server_blocks_nothing_and_gets_every_point_later(server, tmp_path, wait_until, identity):
    tracker = MLflowTracker(resolve_store(server.uri, tmp_path))
    tracker.start("run", "race", {}, {}, identity)
    tracker.safe_until(300)
    tracker.log({"kl": 0.0}, 0)
    wait_until(lambda: tracker.waiting == 0)
    server.signal(signal.SIGSTOP)
    try:
        for step in range(1, 201):
            tracker.log({"kl": float(step)}, step)
        assert tracker.waiting == 200
    finally:
        server.signal(signal.SIGCONT)
    assert tracker.finish("FINISHED", deadline_s=60) == 0
    points = MlflowClient(tracking_uri=server.uri).get_metric_history(tracker.run_id, "update/kl")
    assert sorted(point.step for point in points) == list(range(201))


@pytest.mark.timeout(600)
def test_recordings_and_servers_that_are_killed_by_turns_leave_every_point_once(server, tmp_path):
    script = Path(__file__).parents[1] / "faults" / "killed_recording.py"
    recording = subprocess.Popen(
        [sys.executable, script, str(tmp_path), server.uri, "5"], start_new_session=True
    )
    try:
        for _ in range(2):
            time.sleep(4)
            server.kill()
            time.sleep(1)
            server.start()
        assert recording.wait(400) == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(recording.pid, signal.SIGKILL)
    client = MlflowClient(tracking_uri=server.uri)
    (run,) = client.search_runs([client.get_experiment_by_name("race").experiment_id])
    assert run.info.status == "FINISHED"
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    for key in rows[0].keys() - {"env_steps"}:
        history = client.get_metric_history(run.info.run_id, metric_name(key))
        assert [(p.step, p.value) for p in history] == [(row["env_steps"], row[key]) for row in rows], key
