"""kill -9 of a training and all its workers, and what `deepracer-exp resume` makes of it."""

import json
import multiprocessing
import random
import signal
import time

import pytest
from mlflow import MlflowClient

from benchmarks.same import different_rows, different_tensors, different_traces
from deepracer_exp.runs.run_files import read_metrics
from deepracer_exp.tracking.mlflow_metrics import MACHINE, metric_name
from deepracer_exp.training.metrics import TIMES
from tests.conftest import IN_PROCESS

from .forked import run_command

ITERATIONS = 14
RUN = (
    *("train", "experiment=tiny", "collector.processes=2", "stopping=none", "checkpoints.every=4"),
    *("episode.max_steps=60", "budget.env_steps=null", f"budget.iterations={ITERATIONS}"),
)


def folder_of(where, runs_dir):
    (file,) = (where / runs_dir).glob("tiny/*/config.yaml")
    return file.parent


def points_of(where, runs_dir, folder) -> dict[str, list[tuple[int, float]]]:
    run_id = json.loads((folder / "mlflow.json").read_text())["run_id"]
    client = MlflowClient(tracking_uri=f"sqlite:///{where / runs_dir / 'mlflow.db'}")
    keys = client.get_run(run_id).data.metrics
    assert client.get_run(run_id).info.status == "FINISHED"
    found = {key: [(p.step, p.value) for p in client.get_metric_history(run_id, key)] for key in keys}
    times = [metric_name(column) for column in TIMES]
    return {key: points for key, points in found.items() if key not in times and not key.startswith(MACHINE)}


def killed_after(start, arguments, ready) -> None:
    training = start(*arguments)
    training.wait_for(ready, "a moment to kill at")
    training.signal_group(signal.SIGKILL)
    training.popen.wait()
    training.destroy()


def assert_same(one, other, iterations):
    rows = [read_metrics(folder / "metrics.jsonl") for folder in (one, other)]
    assert len(rows[0]) == iterations
    assert different_rows(*rows) is None
    assert different_tensors(*(folder / "checkpoints" / "last" for folder in (one, other))) is None
    assert different_traces(one, other) is None


def assert_as_if_nothing_had_happened(tmp_path, start):
    whole = start(*RUN, "runs_dir=whole").end()
    assert whole.code == 0, whole.stderr
    one, other = folder_of(tmp_path, "whole"), folder_of(tmp_path, "cut")
    assert_same(one, other, ITERATIONS)
    points = points_of(tmp_path, "cut", other)
    assert points == points_of(tmp_path, "whole", one)
    assert len(points["update/entropy"]) == len(set(points["update/entropy"])) == ITERATIONS


@pytest.mark.usefixtures("workers_start_early")
def test_a_training_killed_in_the_middle_of_an_iteration_is_resumed_bit_for_bit(call, tmp_path):
    """The reward function kills the process once, at the same step on every machine."""
    (tmp_path / "deadly.py").write_text(
        "import os, pathlib\n\n\n"
        "def reward_function(params):\n"
        "    if params['steps'] == 5 and pathlib.Path('deadly').exists():\n"
        "        if any(file.read_text().count('\\n') == 3 for file in pathlib.Path().glob('cut/*/*/metrics.jsonl')):\n"
        "            os.kill(os.getpid(), 9)\n"
        "    return params['speed']\n"
    )
    run = (
        *("train", *IN_PROCESS, "stopping=none", "checkpoints.every=2", "episode.max_steps=60"),
        *("algorithm.frames_per_iteration=256", "budget.env_steps=null", "budget.iterations=6"),
        "reward.file=deadly.py",
    )
    (tmp_path / "deadly").touch()
    killed = multiprocessing.Process(target=run_command, args=(tmp_path, *run, "runs_dir=cut"))
    killed.start()
    killed.join()
    assert killed.exitcode == -signal.SIGKILL, (tmp_path / "said.txt").read_text()
    (tmp_path / "deadly").unlink()
    assert recorded(tmp_path) == 3
    cut = folder_of(tmp_path, "cut")
    assert not (cut / "summary.json").exists()
    for arguments in (("resume", str(cut)), (*run, "runs_dir=whole")):
        ended = call(*arguments)
        assert ended.code == 0, ended.stderr
    assert_same(folder_of(tmp_path, "whole"), cut, iterations=6)


def recorded(tmp_path) -> int:
    return sum(file.read_bytes().count(b"\n") for file in (tmp_path / "cut").glob("tiny/*/metrics.jsonl"))


@pytest.mark.faults
def test_a_killed_run_that_is_resumed_is_the_run_that_was_not_killed(start, tmp_path):
    killed_after(start, (*RUN, "runs_dir=cut"), lambda: recorded(tmp_path) >= 6)
    folder = folder_of(tmp_path, "cut")
    assert not (folder / "summary.json").exists()
    ended = start("resume", str(folder)).end()
    assert ended.code == 0, ended.stderr
    assert_as_if_nothing_had_happened(tmp_path, start)


@pytest.mark.faults
def test_killed_at_random_moments_it_still_is(start, tmp_path):
    moments = random.Random(7)
    arguments = (*RUN, "runs_dir=cut")
    for _ in range(6):
        until = time.monotonic() + moments.uniform(1.0, 12.0)
        training = start(*arguments)
        while training.popen.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        if training.popen.poll() is not None:
            break
        training.signal_group(signal.SIGKILL)
        training.popen.wait()
        training.destroy()
        if list((tmp_path / "cut").glob("tiny/*/config.yaml")):
            arguments = ("resume", str(folder_of(tmp_path, "cut")))
    else:
        ended = start(*arguments).end()
        assert ended.code == 0, ended.stderr
    assert_as_if_nothing_had_happened(tmp_path, start)
