"""What the processes of a command import, and when."""

import importlib.util
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing import forkserver
from pathlib import Path

import pytest

from deepracer_exp.collectors import car_worker
from deepracer_exp.collectors.forking import start_workers_early
from deepracer_exp.commands import train
from deepracer_exp.sweeps.queue import worker

from .training.conftest import workers_start_early  # noqa: F401 - a fixture


# The server ignores a name that is none, and each worker would import for seconds while the training waits.
def test_all_that_workers_are_to_be_forked_with_is_there(monkeypatch):
    preloaded: list[str] = []
    monkeypatch.setattr(multiprocessing, "set_start_method", lambda *_, **__: None)
    monkeypatch.setattr(multiprocessing, "set_forkserver_preload", preloaded.extend)
    monkeypatch.setattr(forkserver, "ensure_running", lambda: None)
    start_workers_early(True)
    assert car_worker.__name__ in preloaded
    start_workers_early(True, train._WORKER)
    assert worker.__name__ in preloaded
    assert [name for name in preloaded if importlib.util.find_spec(name) is None] == []


@pytest.mark.usefixtures("workers_start_early")
def test_a_worker_is_forked_from_a_process_that_has_imported_and_compiled_what_it_needs(tmp_path):
    code = f"""
import gc, json, pathlib, sys
names, frozen = list(sys.modules), gc.get_freeze_count()
pathlib.Path({str(tmp_path / "forked")!r}).write_text(json.dumps([names, frozen]))
"""
    forked = multiprocessing.Process(target=exec, args=(code,))
    forked.start()
    forked.join()
    names, frozen = json.loads((tmp_path / "forked").read_text())
    assert {car_worker.__name__, "deepracer_exp.collectors.fork_ready", "torchrl"} <= set(names)
    assert frozen > 0


def test_a_sweep_starts_its_workers_before_it_imports_pytorch_or_pandas(tmp_path):
    code = """
import sys
from multiprocessing import forkserver
from deepracer_exp.cli import main
from deepracer_exp.sweeps import run_sweep

def show():
    print({"torch", "pandas"} & sys.modules.keys(), flush=True)

def run(driver, interruption):
    show()
    return 130

forkserver.ensure_running = show
run_sweep.Driver.run = run
main(["sweep", "experiment=tiny", "algorithm.lr=1e-3,1e-4", "tracking=off"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 130, done.stderr
    assert done.stdout.splitlines() == ["set()", "set()"]


def state_of_libraries(modules: Sequence[str], compared: Sequence[str] = ()) -> tuple[dict, dict]:
    """Return functions and settings of libraries in a process that imports these modules first."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("state_of_libraries.py")), *modules],
        input="\n".join(compared),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    functions, process = json.loads(done.stdout.splitlines()[-1])
    return functions, process


@pytest.mark.slow
def test_nothing_of_other_libraries_differs_from_a_process_without_this_package():
    ours = [
        f"deepracer_exp.{name}"
        for name in ("training.run", "collectors.car_worker", "api", "sweeps.run_sweep", "cli")
    ]
    # What a user may have imported; threadpoolctl, because it sets a variable of the environment.
    theirs = ["torch._dynamo", "tensordict", "pandas", "threadpoolctl"]
    theirs += ["ray"] if importlib.util.find_spec("ray") else []
    functions, process = state_of_libraries([*ours, *theirs])
    assert {
        "torch._dynamo",
        "torch.optim.adam",
        "tensordict.base",
        "pandas",
        "numba.core.caching",
    } <= functions.keys()
    functions_without, process_without = state_of_libraries(theirs, list(functions))
    assert functions == functions_without
    assert process == process_without


@pytest.mark.usefixtures("workers_start_early")
def test_pytorch_compiles_and_numba_keeps_code_of_others_where_it_would_without_this_package(tmp_path):
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import deepracer_exp.training.run
import deepracer_exp.collectors.car_worker
import torch, users
assert torch.compile(lambda x: 2 * x + 1, backend="eager")(torch.ones(1)) == 3.0
assert users.doubled(2.0) == 4.0
"""
    (tmp_path / "users.py").write_text(
        "from numba import njit\n\n@njit(cache=True)\ndef doubled(x):\n    return 2 * x\n"
    )
    kept = Path(os.environ.get("NUMBA_CACHE_DIR") or tmp_path / "__pycache__")
    before = set(kept.rglob("users.doubled-*.nbi"))
    forked = multiprocessing.Process(target=exec, args=(code,))
    forked.start()
    forked.join()
    assert forked.exitcode == 0
    assert set(kept.rglob("users.doubled-*.nbi")) > before
