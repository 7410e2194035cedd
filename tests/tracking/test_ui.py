import json
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import psutil
import pytest
from mlflow import MlflowClient

from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.tracking import ui
from deepracer_exp.tracking.metadata import VIEW, run_params, run_tags
from deepracer_exp.tracking.mlflow_metrics import METRICS
from deepracer_exp.tracking.registry import look_up
from deepracer_exp.tracking.store import existing_store
from deepracer_exp.tracking.ui import running_ui, runs_page, serve_ui
from tests.waiting import PATIENCE_S

from .conftest import TrackerHere, begin

NAMES = {"track": "reinvent_base", "reward": "progress_per_step", "network": "mlp_small"}


def record(store, runs_dir: Path, seed: int) -> str:
    tracker, folder = TrackerHere(store), runs_dir / str(seed)
    folder.mkdir()
    params = run_params({}, NAMES, {"seed": seed, "algorithm": {"lr": 3e-4}, "reward": {"constants": {}}}, [])
    tags = run_tags(NAMES, "0123abc", "feed" * 16, runs_dir / "race" / str(seed))
    begin(tracker, folder, f"progress_per_step s{seed}", params=params, tags=tags)
    row = {**{key: float(seed) for key in reversed(METRICS)}, "env_steps": 8192}
    (folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    (folder / "provenance.json").write_text('{"seed": 1}')
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert tracker.run_id is not None
    return tracker.run_id


def test_a_port_in_use_is_bad_input_that_names_a_free_one(store, free_port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        with pytest.raises(BadInput, match=rf"port={free_port}: already in use .*\d+ is free"):
            running_ui(store, free_port).__enter__()


def test_a_look_at_no_runs_says_to_train_first_and_creates_nothing(tmp_path):
    with pytest.raises(BadInput, match="run `deepracer-exp train` first"):
        existing_store(None, tmp_path / "runs")
    with pytest.raises(BadInput, match=r"nothing\.db: no such file"):
        existing_store(f"sqlite:///{tmp_path}/typo/nothing.db", tmp_path / "runs")
    with pytest.raises(BadInput, match=r"nothing\.db: no such file"):
        look_up("season@champion", f"sqlite:///{tmp_path}/typo/nothing.db", tmp_path / "runs")
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_does_not_answer_has_no_page_to_open(tmp_path, free_port):
    with pytest.raises(BadInput, match=rf"ui of http://127.0.0.1:{free_port}: "):
        serve_ui(tmp_path, f"http://me:s3cr3t@127.0.0.1:{free_port}", 5000, print)


def test_a_server_that_is_given_up_is_not_said_to_have_ended(store, tmp_path, free_port, monkeypatch):
    monkeypatch.setattr(ui, "_START_S", 0.2)
    with pytest.raises(RunFailed, match=r"did not answer at http.* within .* s of CPU and .*load average"):
        running_ui(store, free_port).__enter__()


@pytest.mark.slow
def test_the_ui_shows_runs_by_name_and_opens_their_files(store, tmp_path, free_port):
    run_ids = [record(store, tmp_path, seed) for seed in (1, 2)]
    with running_ui(existing_store(None, tmp_path), free_port) as (url, _):
        client = MlflowClient(tracking_uri=url)
        experiment = client.get_experiment_by_name("race")
        page = f"{url}/#/experiments/{experiment.experiment_id}/runs?workflowType=machine_learning"
        assert runs_page(url, None, tmp_path) == f"{page}&viewStateShareKey={VIEW}"
        runs = {run.info.run_id: run for run in client.search_runs([experiment.experiment_id])}
        assert runs.keys() == set(run_ids)
        for seed, run_id in enumerate(run_ids, start=1):
            data = runs[run_id].data
            assert data.metrics == dict.fromkeys((name for name, _ in METRICS.values()), float(seed))
            assert data.params.items() >= {**NAMES, "seed": str(seed), "algorithm.lr": "0.0003"}.items()
            assert data.tags.items() >= {**NAMES, "git_commit": "0123abc"}.items()
            file = f"{url}/get-artifact?run_id={run_id}&path=provenance.json"
            assert urllib.request.urlopen(file).read() == b'{"seed": 1}'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signum", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143), (signal.SIGKILL, -9)]
)
def test_the_ui_ends_with_its_command_and_leaves_no_process(store, tmp_path, free_port, signum, code):
    script = (
        "from pathlib import Path; from deepracer_exp.tracking.ui import serve_ui\n"
        f"serve_ui(Path({str(tmp_path)!r}), None, {free_port}, lambda url: print(url, flush=True))"
    )
    command = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert command.stdout is not None
    assert command.stdout.readline().startswith(f"http://127.0.0.1:{free_port}/")
    below = psutil.Process(command.pid).children(recursive=True)
    assert below
    command.send_signal(signum)
    assert command.wait(PATIENCE_S) == code
    _, left = psutil.wait_procs(below, PATIENCE_S)
    assert not left
