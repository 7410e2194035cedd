import ast
import contextlib
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.checkpoint import Checkpoint

import deepracer_exp
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.runs.checkpoint_files import find_checkpoint, pin, pin_for_clone, pinned, verify
from deepracer_exp.runs.checkpoints import CheckpointStore, read_training

from .agents import make_agent

TRAINING = {"iteration": 0}


def weights(agent: PPO) -> dict[str, torch.Tensor]:
    return agent.state_dict()["networks"]


def load(path: Path) -> PPO:
    agent = make_agent(99)
    Checkpoint(agent=agent).load(path)
    return agent


def same(one: PPO, other: PPO) -> bool:
    return all(torch.equal(value, weights(other)[name]) for name, value in weights(one).items())


def names(store: CheckpointStore) -> list[str]:
    return sorted(path.name for path in store.folder.iterdir())


@pytest.fixture
def store(tmp_path):
    return CheckpointStore(tmp_path, keep=1)


def test_what_the_training_needs_besides_comes_back_as_it_was(store):
    cars = {"random": torch.arange(5, dtype=torch.uint8), "poses": np.array([1.0, np.nan])}
    plain = {"iteration": 3, "best": None, "share": 1 / 3, "last": [True, False]}
    training = {**plain, "cars": {"worker-0": cars}}
    store.save(make_agent(1), {"iteration": 3}, training)
    found = read_training(store.folder / "last")
    again = found.pop("cars")["worker-0"]
    assert found == plain
    assert torch.equal(again["random"], cars["random"])
    assert np.array_equal(again["poses"], cars["poses"], equal_nan=True)


def test_best_is_what_was_said_to_be_and_last_what_a_training_can_continue_from(store):
    agents = [make_agent(seed) for seed in range(4)]
    store.save(agents[0], {"iteration": 0}, TRAINING, best=True)
    store.save(agents[1], {"iteration": 1}, None, best=True)
    store.save(agents[2], {"iteration": 2}, TRAINING)
    store.save(agents[3], {"iteration": 3}, None)
    assert same(load(store.folder / "best"), agents[1])
    assert same(load(store.folder / "last"), agents[2])
    with pytest.raises(BadInput, match="a training cannot resume from it"):
        read_training(store.folder / "best")


@pytest.mark.parametrize(
    ("keep", "every", "kept"), [(1, None, [2, 5]), (2, None, [2, 4, 5]), (1, 2, [2, 4, 5]), (9, 3, [2, 3, 5])]
)
def test_the_best_the_last_and_the_newest_that_were_evaluated_are_kept(tmp_path, keep, every, kept):
    store = CheckpointStore(tmp_path, keep, every)
    for iteration in range(6):
        store.save(make_agent(iteration), {"iteration": iteration}, TRAINING, best=iteration == 2)
    assert names(store) == [*(f"{number:06d}" for number in kept), "best", "last"]


def test_the_fastest_reliable_checkpoint_is_kept_and_has_a_name(store):
    for iteration in range(1, 6):
        said = {"best": iteration == 3, "fastest": iteration in (1, 2)}
        store.save(make_agent(iteration), {"iteration": iteration}, TRAINING, **said)
    assert names(store) == ["000002", "000003", "000005", "best", "fastest", "last"]
    assert find_checkpoint(store.folder, "fastest").resolve().name == "000002"
    store.rewind(5, 3, 2)
    assert names(store) == ["000002", "000003", "000005", "best", "fastest", "last"]
    store.rewind(5, 3)
    assert not (store.folder / "fastest").is_symlink()


def test_a_pinned_checkpoint_is_kept(store):
    store.save(make_agent(0), {"iteration": 0}, TRAINING)
    pin(store.folder, "000000", "champion")
    for iteration in (1, 2):
        store.save(make_agent(iteration), {"iteration": iteration}, TRAINING)
    assert names(store) == ["000000", "000002", "last", "pinned.json"]
    pin(store.folder, "000002", "runner-up")
    store.rewind(0, None)
    assert names(store) == ["000000", "000002", "last", "pinned.json"]
    assert (store.folder / "last").readlink().name == "000000"


def test_a_pin_for_a_clone_ends_with_the_clones_folder(store, tmp_path):
    store.save(make_agent(0), {"iteration": 0}, TRAINING)
    clone = tmp_path / "clone"
    clone.mkdir()
    pin_for_clone(store.folder, "000000", clone)
    assert pinned(store.folder) == {"000000": [f"cloned into {clone}"]}
    clone.rmdir()
    assert pinned(store.folder) == {}


def test_a_store_that_does_not_know_what_must_stay_removes_nothing(store, tmp_path):
    store.save(make_agent(0), {"iteration": 0}, TRAINING)
    (store.folder / "pinned.json").write_text("{")
    with pytest.raises(BadInput, match=r"nothing in .* is removed"):
        CheckpointStore(tmp_path, keep=1)
    with pytest.raises(BadInput, match=r"nothing in .* is removed"):
        store.save(make_agent(1), {"iteration": 1}, TRAINING)
    assert (store.folder / "000000").is_dir()


def test_the_same_weights_may_become_last_first_and_best_later(store):
    agent = make_agent(0)
    store.save(agent, {"iteration": 10}, TRAINING)
    store.save(agent, {"iteration": 10}, best=True)
    assert same(load(store.folder / "best"), agent)
    assert names(store) == ["000010", "best", "last"]


def test_going_back_forgets_what_came_later(tmp_path):
    store = CheckpointStore(tmp_path, keep=9)
    for iteration in range(1, 6):
        store.save(make_agent(iteration), {"iteration": iteration}, TRAINING, best=iteration in (2, 5))
    (store.folder / ".000006").mkdir()
    CheckpointStore(tmp_path, keep=9).rewind(3, 2)
    assert names(store) == ["000001", "000002", "000003", "best", "last"]
    assert [str((store.folder / label).readlink()) for label in ("best", "last")] == ["000002", "000003"]


def test_a_checkpoint_is_tensors_and_json(store):
    store.save(make_agent(0), {"iteration": 0}, TRAINING)
    files = [path for path in (store.folder / "000000").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".tdz"}
    for archive in (path for path in files if path.suffix == ".tdz"):
        with zipfile.ZipFile(archive) as members:
            assert {Path(name).suffix for name in members.namelist()} <= {".json", ".memmap"}


# In RUN_DIR/0, RUN_DIR/1, ...: saves agent 0, then agents 1 and 2, and dies at the n-th call that changes what a name
# leads to; ends after the first run that does not die. Forked, because torch takes seconds to import.
_DIES = """
import os, pathlib, sys, torch
torch.set_num_threads(1)
sys.path.insert(0, sys.argv[1])
from agents import make_agent
from deepracer_exp.runs.checkpoints import CheckpointStore

TRAINING = {"iteration": 0}

def dying(function, left):
    def call(*args, **kwargs):
        if left[0] == 0:
            os._exit(9)
        left[0] -= 1
        return function(*args, **kwargs)
    return call

def save_all(run_dir, calls):
    store = CheckpointStore(run_dir, keep=1)
    store.save(make_agent(0), {"iteration": 0}, TRAINING, best=True)
    left = [calls]
    for name in ("replace", "rename", "symlink", "unlink", "rmdir", "mkdir"):
        setattr(os, name, dying(getattr(os, name), left))
    store.save(make_agent(1), {"iteration": 1}, TRAINING, best=True)
    store.save(make_agent(2), {"iteration": 2}, TRAINING)

code, calls = 9, 0
while code == 9:
    run_dir = pathlib.Path(sys.argv[2], str(calls))
    run_dir.mkdir()
    pid = os.fork()
    if pid == 0:
        save_all(run_dir, calls)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    calls += 1
sys.exit(code)
"""


@pytest.mark.slow
def test_wherever_a_save_is_cut_off_best_and_last_are_whole(tmp_path):
    here = str(Path(__file__).parent)
    subprocess.run([sys.executable, "-c", _DIES, here, str(tmp_path)], check=True)
    agents = [make_agent(seed) for seed in range(3)]
    runs = sorted(tmp_path.iterdir(), key=lambda path: int(path.name))
    assert len(runs) > 10
    for run_dir in runs:
        best, last = (load(run_dir / "checkpoints" / name) for name in ("best", "last"))
        assert any(same(best, agent) for agent in agents[:2])
        assert any(same(last, agent) for agent in agents)
    assert same(best, agents[1])
    assert same(last, agents[2])


UNPICKLERS = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
DANGEROUS = {"torch.load", "pickle.load", "pickle.loads", "yaml.load", "os.system"}


def test_nothing_in_the_package_unpickles_and_only_rewards_are_executed():
    paths = sorted(Path(deepracer_exp.__file__).parent.rglob("*.py"))
    assert len(paths) > 300
    words = "|".join([*UNPICKLERS, *map(re.escape, DANGEROUS), "eval", "exec"])
    for path in paths:
        text = path.read_text(encoding="utf-8")
        for argument in ("weights_only=False", "allow_pickle=True", "shell=True"):
            assert argument not in text, path
        if not re.search(rf"\b({words})\b", text):  # parsing them all takes a second
            continue
        nodes = list(ast.walk(ast.parse(text)))
        calls = {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
        imports = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        imports |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
        assert not imports & UNPICKLERS, path
        assert not calls & DANGEROUS, path
        if path.name != "time_limit.py":  # `run_module`, for reward functions
            assert not calls & {"eval", "exec"}, path


def test_a_save_on_a_full_disk_raises_and_leaves_the_previous_checkpoint_whole(mounted):
    """Memory-mapped files, the library's default, end the process by SIGBUS instead of raising anything."""
    run_dir = mounted("size=200k")
    store = CheckpointStore(run_dir, keep=1)
    store.save(make_agent(0), {"iteration": 0}, TRAINING, best=True)
    with contextlib.suppress(OSError):
        (run_dir / "ballast").write_bytes(bytes(1 << 20))
    with pytest.raises(RunFailed, match="No space left on device"):
        store.save(make_agent(1), {"iteration": 1}, TRAINING, best=True)
    for label in ("best", "last"):
        verify(store.folder / label)
        assert same(load(store.folder / label), make_agent(0))
    assert not list(store.folder.glob(".*"))
