"""Commands import TorchRL without PyTorch's compiler and Ray; nothing else changes by it."""

import json
import subprocess
import sys

import pytest

from tests.conftest import IN_PROCESS

UNUSED = ("torch._dynamo", "torch._inductor", "sympy", "ray")
MEASURED_BY_CLOCK = ("wall_clock_s", "collect_s", "update_s", "env_steps_per_s")
SCRIPT = f"""
import gc, json, sys
from deepracer_exp.cli import main
from deepracer_exp.lean_imports import import_lean

usual = gc.get_threshold()
import_lean()
rarely = gc.get_threshold()
try:
    main(["train", *{list(IN_PROCESS)!r}])
except SystemExit as ended:
    code = ended.code
unused = [name for name in {UNUSED!r} if name in sys.modules]
again = gc.get_threshold()

import ray, torch

with torch._subclasses.fake_tensor.FakeTensorMode():
    shape = torch.nn.Conv2d(3, 8, 3)(torch.zeros(1, 3, 9, 9)).shape
assert shape == (1, 8, 7, 7)
assert torch.compile(lambda x: 2 * x + 1, backend="eager")(torch.ones(1)) == 3.0
assert torch.compiler.disable(lambda x: x)(5) == 5
weight = torch.ones(1, requires_grad=True)
optimizer = torch.optim.Adam([weight])
weight.sum().backward()
optimizer.step()
optimizer.zero_grad()
print(json.dumps([code, unused, again == usual, rarely > usual, torch._dynamo.__file__, ray.__version__]))
"""


def test_a_command_imports_no_compiler_and_no_ray_and_trains_the_same_bits(trained, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    code, unused, collects_as_usual, collected_rarely, compiler, ray = json.loads(
        done.stdout.splitlines()[-1]
    )
    assert (code, unused) == (0, [])
    assert collected_rarely
    assert collects_as_usual
    # Whoever asks for them later gets the real ones.
    assert compiler.endswith("__init__.py")
    assert ray

    (file,) = tmp_path.glob("runs/*/*/metrics.jsonl")
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert [_of_bits(row) for row in rows] == [_of_bits(row) for row in trained().metrics]


def _of_bits(row: dict) -> dict:
    return {key: value for key, value in row.items() if key not in MEASURED_BY_CLOCK}


@pytest.fixture(scope="module")
def prepared() -> tuple[list[str], bool, bool, int]:
    """What a process has loaded that began with the checkpoints of TorchRL and then prepared to be forked."""
    code = f"""
import gc, json, sys
from deepracer_exp.lean_imports import import_lean
import_lean()
import torchrl.checkpoint
unused = [name for name in {UNUSED!r} if name in sys.modules]
collects = "torchrl.collectors" in sys.modules
import deepracer_exp.collectors.fork_ready
from deepracer_exp.tracks import segments
print(json.dumps([unused, collects, bool(segments._candidates.signatures), gc.get_freeze_count()]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_any_part_of_torchrl_may_be_imported_first(prepared):
    unused, collects, *_ = prepared
    assert (unused, collects) == ([], True)


def test_the_fork_server_has_loaded_the_compiled_functions_of_its_workers(prepared):
    *_, has_compiled, frozen = prepared
    assert has_compiled
    assert frozen > 0


def test_a_sweep_starts_its_workers_before_it_imports_pytorch_or_pandas(tmp_path):
    code = """
import sys
from deepracer_exp.cli import main
from deepracer_exp.sweeps import sweep

def run(driver, interruption):
    print({"torch", "pandas"} & sys.modules.keys())
    return 130

sweep.Driver.run = run
main(["sweep", "experiment=tiny", "algorithm.lr=1e-3,1e-4", "tracking=off"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 130, done.stderr
    assert done.stdout.splitlines()[0] == "set()"
