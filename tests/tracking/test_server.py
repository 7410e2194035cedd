"""The tracker against a real server that is stopped, killed and started again."""

import signal

import pytest
from mlflow import MlflowClient

from deepracer_exp.tracking.recorder import MLflowTracker
from deepracer_exp.tracking.store import resolve_store

pytestmark = pytest.mark.slow


def test_a_server_killed_and_restarted_mid_run_has_every_point_once(server, tmp_path, wait_until):
    tracker = MLflowTracker(resolve_store(server.uri, tmp_path))
    tracker.start("run", "race", {"seed": 1}, {"track": "oval"})
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
    points = client.get_metric_history(tracker.run_id, "completion")
    assert sorted((point.step, point.value) for point in points) == [(n, float(n)) for n in range(40)]
    assert client.get_run(tracker.run_id).info.status == "KILLED"
    assert [file.path for file in client.list_artifacts(tracker.run_id, "reports")] == [
        "reports/summary.json"
    ]


def test_a_server_down_at_the_start_gets_one_whole_run_when_it_comes(server, tmp_path):
    server.kill()
    tracker = MLflowTracker(resolve_store(server.uri, tmp_path))
    tracker.start("run", "race", {"seed": 1}, {})
    tracker.log({"kl": 1.0}, 1)
    server.start()
    assert tracker.finish("FINISHED", deadline_s=60) == 0
    client = MlflowClient(tracking_uri=server.uri)
    experiment = client.get_experiment_by_name("race")
    (run,) = client.search_runs([experiment.experiment_id])
    assert (run.data.params, run.data.metrics) == ({"seed": "1"}, {"kl": 1.0})


def test_a_server_that_hangs_blocks_nobody_and_gets_every_point_later(server, tmp_path, wait_until):
    tracker = MLflowTracker(resolve_store(server.uri, tmp_path))
    tracker.start("run", "race", {}, {})
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
    points = MlflowClient(tracking_uri=server.uri).get_metric_history(tracker.run_id, "kl")
    assert sorted(point.step for point in points) == list(range(201))
