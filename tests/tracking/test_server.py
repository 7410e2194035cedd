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

from deepracer_exp.tracking.store import resolve_store

from .conftest import TrackerHere, begin, points, runs_of, write_rows

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("away", ["killed", "hanging"])
def test_a_server_that_is_away_blocks_nothing_and_gets_everything_once(server, tmp_path, wait_until, away):
    tracker = TrackerHere(resolve_store(server.uri, tmp_path))
    begin(tracker, tmp_path, params={"seed": "1"}, tags={"track": "oval"})
    write_rows(tmp_path, [{"completion": float(number)} for number in range(20)])
    client = MlflowClient(tracking_uri=server.uri)
    wait_until(lambda: tracker.run_id and len(points(client, tracker.run_id)) == 20)
    server.kill() if away == "killed" else server.signal(signal.SIGSTOP)
    try:
        write_rows(tmp_path, [{"completion": float(number)} for number in range(20, 220)])
        (tmp_path / "summary.json").write_text('{"status": "interrupted", "reason": "by Ctrl-C"}')
        wait_until(lambda: tracker.outage is not None)
    finally:
        server.start() if away == "killed" else server.signal(signal.SIGCONT)
    tracker.finish("KILLED", deadline_s=60)
    assert tracker.failure is None
    assert points(client, tracker.run_id) == [(100 * number + 100, float(number)) for number in range(220)]
    assert client.get_run(tracker.run_id).info.status == "KILLED"
    assert "summary.json" in [file.path for file in client.list_artifacts(tracker.run_id)]


def test_recordings_and_servers_that_are_killed_by_turns_leave_every_point_once(server, tmp_path):
    command = [sys.executable, "-m", "tests.faults.killed_recording", str(tmp_path), server.uri, "5"]
    recording = subprocess.Popen(command, cwd=Path(__file__).parents[2], start_new_session=True)
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
    (run,) = runs_of(client)
    assert run.info.status == "FINISHED"
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    for key in rows[0].keys() - {"env_steps"}:
        assert points(client, run.info.run_id, key) == [(row["env_steps"], row[key]) for row in rows], key
