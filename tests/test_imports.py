"""What the processes of a command import, and when."""

import importlib.util
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def test_the_fork_server_has_loaded_the_compiled_functions_of_its_workers():
    code = """
import gc, json
import deepracer_exp.collectors.car_worker
import deepracer_exp.collectors.fork_ready
from deepracer_exp.tracks import segments
print(json.dumps([bool(segments._candidates.signatures), gc.get_freeze_count()]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    has_compiled, frozen = json.loads(done.stdout.splitlines()[-1])
    assert has_compiled
    assert frozen > 0


def test_a_sweep_starts_its_workers_before_it_imports_pytorch_or_pandas(tmp_path):
    code = """
import sys
from deepracer_exp.cli import main
from deepracer_exp.sweeps import run_sweep

def run(driver, interruption):
    print({"torch", "pandas"} & sys.modules.keys())
    return 130

run_sweep.Driver.run = run
main(["sweep", "experiment=tiny", "algorithm.lr=1e-3,1e-4", "tracking=off"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 130, done.stderr
    assert done.stdout.splitlines()[0] == "set()"


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


def test_pytorch_compiles_and_numba_keeps_code_of_others_where_it_would_without_this_package(tmp_path):
    code = """
import deepracer_exp.training.run
import deepracer_exp.collectors.car_worker
import torch, users
assert torch.compile(lambda x: 2 * x + 1, backend="eager")(torch.ones(1)) == 3.0
assert users.doubled(2.0) == 4.0
"""
    (tmp_path / "users.py").write_text(
        "from numba import njit\n\n@njit(cache=True)\ndef doubled(x):\n    return 2 * x\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    assert list((tmp_path / "__pycache__").glob("users.doubled-*.nbi"))
