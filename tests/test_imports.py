"""What the processes of a command import, and when."""

import json
import subprocess
import sys


def test_the_fork_server_has_loaded_the_compiled_functions_of_its_workers():
    code = """
import gc, json
import deepracer_exp.collectors.worker
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
