"""Recordings that are killed and resumed: MLflow has what metrics.jsonl has, once."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient

from deepracer_exp.tracking.mlflow_metrics import metric_name


@pytest.mark.faults
def test_a_recording_killed_again_and_again_leaves_every_point_once(tmp_path):
    kills = 5
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    command = [sys.executable, "-m", "tests.faults.killed_recording", str(tmp_path), uri, str(kills)]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("killed") == kills
    client = MlflowClient(tracking_uri=uri)
    (run,) = client.search_runs([client.get_experiment_by_name("race").experiment_id])
    assert run.info.run_id == json.loads((tmp_path / "mlflow.json").read_text())["run_id"]
    assert run.info.status == "FINISHED"
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(1, 161))
    for key in rows[0].keys() - {"env_steps"}:
        history = client.get_metric_history(run.info.run_id, metric_name(key))
        assert [(p.step, p.value) for p in history] == [(row["env_steps"], row[key]) for row in rows], key


_CREATES = """
import pathlib, sys, time
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import resolve_store

replace = pathlib.Path.replace

def wait_to_be_killed(path, target):
    if target.name == "mlflow.db" and "killed" in sys.argv:
        print("made", flush=True)
        time.sleep(600)
    return replace(path, target)

pathlib.Path.replace = wait_to_be_killed
MLflowRun(resolve_store(None, pathlib.Path(sys.argv[1])))
"""


@pytest.mark.faults
def test_a_store_whose_creation_was_killed_is_created_again(tmp_path):
    command = [sys.executable, "-c", _CREATES, str(tmp_path)]
    killed = subprocess.Popen([*command, "killed"], stdout=subprocess.PIPE, text=True)
    assert killed.stdout is not None
    assert killed.stdout.readline() == "made\n"
    killed.kill()
    killed.wait()
    assert list(tmp_path.glob(".mlflow.db.new*"))
    assert not (tmp_path / "mlflow.db").exists()
    subprocess.run(command, check=True, capture_output=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mlflow.db", "mlflow.db.lock"]
