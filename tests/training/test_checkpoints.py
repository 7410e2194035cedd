import ast
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import Checkpoint

import deepracer_exp
from deepracer_exp.agents.actor_critic import build_actor_critic
from deepracer_exp.agents.ppo import PPO
from deepracer_exp.agents.schedules import Schedule
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.errors import RunFailed
from deepracer_exp.training.checkpoints import CheckpointStore


def make_agent(seed: int) -> PPO:
    experiment, _ = compose_experiment(["experiment=tiny"])
    generator = torch.Generator().manual_seed(seed)
    networks = build_actor_critic(experiment.network, 7, 5, generator)
    with torch.no_grad():
        for parameter in networks.parameters():  # the same in every process, whatever its threads
            parameter.fill_(seed)
    return PPO(networks, experiment.algorithm, Schedule(experiment.lr_schedule), seed)


def weights(agent: PPO) -> dict[str, torch.Tensor]:
    return agent.state_dict()["networks"]


def load(path: Path) -> PPO:
    agent = make_agent(99)
    Checkpoint(agent=agent).load(path)
    return agent


def same(one: PPO, other: PPO) -> bool:
    return all(torch.equal(value, weights(other)[name]) for name, value in weights(one).items())


@pytest.fixture
def store(tmp_path):
    return CheckpointStore(tmp_path)


def test_a_checkpoint_loads_back_into_a_fresh_agent(store):
    agent = make_agent(1)
    assert store.save(agent, {"iteration": 3, "env_steps": 12}, (50.0, -20.0))
    for name in ("best", "last"):
        loaded = load(store.folder / name)
        assert same(agent, loaded)
        assert torch.equal(agent.state_dict()["generator"], loaded.state_dict()["generator"])
    manifest = json.loads((store.folder / "best" / "manifest.json").read_text())
    assert manifest["metadata"] == {"iteration": 3, "env_steps": 12}


def test_best_stays_with_the_highest_rank_and_last_goes_on(store):
    agents = [make_agent(seed) for seed in range(4)]
    ranks = [(50.0, -20.0), (50.0, -19.0), (49.0, -1.0), None]
    better = [
        store.save(a, {"iteration": i}, rank) for i, (a, rank) in enumerate(zip(agents, ranks, strict=True))
    ]
    assert better == [True, True, False, False]
    assert same(load(store.folder / "best"), agents[1])
    assert same(load(store.folder / "last"), agents[3])


def test_only_best_and_last_are_kept(store):
    for iteration in range(5):
        store.save(make_agent(iteration), {"iteration": iteration}, (1.0, 0.0) if iteration == 2 else None)
    assert sorted(path.name for path in store.folder.iterdir()) == ["000002", "000004", "best", "last"]


def test_the_same_weights_may_become_last_first_and_best_later(store):
    agent = make_agent(0)
    store.save(agent, {"iteration": 10}, None)
    store.save(agent, {"iteration": 10}, (1.0, 0.0))
    assert same(load(store.folder / "best"), agent)
    assert sorted(path.name for path in store.folder.iterdir()) == ["000010", "best", "last"]


def test_a_checkpoint_is_tensors_and_json(store):
    store.save(make_agent(0), {"iteration": 0}, None)
    files = [path for path in (store.folder / "000000").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".tdz"}
    (archive,) = (path for path in files if path.suffix == ".tdz")
    with zipfile.ZipFile(archive) as members:
        assert {Path(name).suffix for name in members.namelist()} == {".json", ".memmap"}


# In RUN_DIR/0, RUN_DIR/1, ...: saves agent 0, then agents 1 and 2, and dies at the n-th call that changes what a name
# leads to; ends after the first run that does not die. Forked, because torch takes seconds to import.
_DIES = """
import os, pathlib, sys, torch
torch.set_num_threads(1)
sys.path.insert(0, sys.argv[1])
from test_checkpoints import CheckpointStore, make_agent

def dying(function, left):
    def call(*args, **kwargs):
        if left[0] == 0:
            os._exit(9)
        left[0] -= 1
        return function(*args, **kwargs)
    return call

def save_all(run_dir, calls):
    store = CheckpointStore(run_dir)
    store.save(make_agent(0), {"iteration": 0}, (0.0, 0.0))
    left = [calls]
    for name in ("replace", "rename", "symlink", "unlink", "rmdir", "mkdir"):
        setattr(os, name, dying(getattr(os, name), left))
    store.save(make_agent(1), {"iteration": 1}, (1.0, 0.0))
    store.save(make_agent(2), {"iteration": 2}, None)

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
    subprocess.run([sys.executable, "-c", _DIES, here, str(tmp_path)], check=True, timeout=250)
    agents = [make_agent(seed) for seed in range(3)]
    runs = sorted(tmp_path.iterdir(), key=lambda path: int(path.name))
    assert len(runs) > 10
    for run_dir in runs:
        best, last = (load(run_dir / "checkpoints" / name) for name in ("best", "last"))
        assert any(same(best, agent) for agent in agents[:2])
        assert any(same(last, agent) for agent in agents)
    assert same(best, agents[1])
    assert same(last, agents[2])


def _calls(tree: ast.AST) -> set[str]:
    return {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}


def _imports(tree: ast.AST) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


@pytest.mark.parametrize(
    "path",
    sorted(Path(deepracer_exp.__file__).parent.rglob("*.py")),
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_nothing_in_the_package_unpickles_and_only_rewards_are_executed(path):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    assert not _imports(tree) & {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    assert "weights_only=False" not in text
    assert "allow_pickle=True" not in text
    calls = _calls(tree)
    assert not calls & {"torch.load", "pickle.load", "pickle.loads", "yaml.load", "os.system"}
    assert "shell=True" not in text
    if path.name != "reward.py":
        assert not calls & {"eval", "exec"}


def test_a_save_on_a_full_disk_raises_and_leaves_nothing(tmp_path):
    """Memory-mapped files, the library's default, end the process by SIGBUS instead of raising anything."""
    if os.getuid() != 0 or sys.platform != "linux":
        pytest.skip("a small file system can be mounted by root on Linux only")
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(tmp_path)], check=False)
    if done.returncode:
        pytest.skip("mount is not allowed here")
    try:
        store = CheckpointStore(tmp_path)
        with pytest.raises((OSError, RunFailed), match="No space left on device"):
            store.save(make_agent(0), {"iteration": 0}, None)
        assert not list(store.folder.glob("[0-9b-l]*"))
    finally:
        subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)
