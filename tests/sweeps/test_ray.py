"""Sweeps on a local Ray cluster of two nodes; of its processes none listens beyond this machine."""

import importlib.util
import shutil
import signal
import tempfile
from pathlib import Path

import psutil
import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.sweeps.queue.ray_launcher import refuse_files
from deepracer_exp.tracking.store import Store

from ..faults.test_killed_sweeps import SWEEP, assert_every_trial_is_accounted_for_once, claims  # noqa: TID252

"""Longer than that of other tests: three processes import PyTorch one after the other."""
_MEMORY = 80 * 2**20
"""Bytes of shared memory a node has for objects."""


class TwoNodes:
    """A head and a node that can be killed; each has room for one worker and a half."""

    def __init__(self, folder):
        from ray.cluster_utils import Cluster

        self._options = {"num_cpus": 2, "object_store_memory": _MEMORY, "node_ip_address": "127.0.0.1"}
        self._cluster = Cluster(
            initialize_head=True,
            head_node_args={
                **self._options,
                "include_dashboard": False,
                "temp_dir": str(folder),
                # A lost node is noticed after seconds, and not after half a minute.
                "_system_config": {"health_check_period_ms": 1000, "health_check_failure_threshold": 3},
            },
        )
        self.address = self._cluster.address
        self.second()

    def second(self):
        """Return the second node, started again if it was killed."""
        if not self._cluster.worker_nodes:
            self._cluster.add_node(**self._options)
        (node,) = self._cluster.worker_nodes
        return node

    def of_the_second(self):
        """Return the processes of the second node, and those that workers have started there."""
        (info,) = self.second().all_processes["raylet"]
        raylet = psutil.Process(info.process.pid)
        return [raylet, *raylet.children(recursive=True)]

    def kill_the_second(self):
        """Kill the second node, as if its plug were pulled."""
        for process in self.of_the_second():
            process.kill()
        self._cluster.remove_node(self.second(), allow_graceful=False)

    def actors(self):
        """Return the processes of actors of any node."""
        return [
            one
            for one in psutil.process_iter(["cmdline"])
            if "ray::WorkerActor" in " ".join(one.info["cmdline"] or ())
        ]

    def shutdown(self):
        self._cluster.shutdown()


@pytest.fixture(scope="module")
def two_nodes():
    pytest.importorskip("ray")
    # Not below pytest's folder: the name of a socket may have a hundred characters.
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))
    (folder / "ray").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        # Where the cluster notes its address, in a folder that Ray expects to be there.
        patch.setenv("RAY_TMPDIR", str(folder))
        # The only way to let Ray on Linux stay with 127.0.0.1.
        patch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        nodes = TwoNodes(folder)
        patch.setenv("RAY_ADDRESS", nodes.address)
        yield nodes
        nodes.shutdown()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_a_sweep_continues_when_a_node_is_gone(two_nodes, start, tmp_path):
    running = start(*SWEEP, "sweep.workers=2", "sweep/executor=ray")

    def held_by_the_second():
        if not known(tmp_path):
            return None
        pids = {process.pid for process in two_nodes.of_the_second()}
        held = [claim for claim in claims(tmp_path) if not claim.has_ended and claim.progress]
        return next((claim for claim in held if int(claim.owner.split(":")[-2]) in pids), None)

    lost = running.wait_for(held_by_the_second, "trial on the second node")
    two_nodes.kill_the_second()
    ended = running.end()
    assert ended.code == 0, ended.stderr
    assert_every_trial_is_accounted_for_once(tmp_path)
    assert next(claim for claim in claims(tmp_path) if claim.trial.number == lost.trial.number).attempt > 1
    assert not two_nodes.actors()


@pytest.mark.slow
def test_ctrl_c_ends_the_workers_of_all_nodes_and_the_sweep_can_resume(two_nodes, start, tmp_path):
    two_nodes.second()
    running = start(*SWEEP, "sweep.workers=2", "sweep/executor=ray")
    running.wait_for(lambda: known(tmp_path) and any(claim.progress for claim in claims(tmp_path)), "trial")
    running.popen.send_signal(signal.SIGINT)
    assert running.end().code == 130
    assert not two_nodes.actors()
    assert all(claim.expired or claim.has_ended for claim in claims(tmp_path))
    assert start("sweep", "study=s", "sweep.workers=2").end().code == 0
    assert_every_trial_is_accounted_for_once(tmp_path)


def known(cwd):
    return (cwd / "runs" / "sweeps.db").exists()


def test_without_ray_the_extra_is_named(call, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "ray" else found(name, *more)
    )
    call(*SWEEP, "sweep/executor=ray").assert_bad_input(
        "sweep/executor=ray", "pip install 'deepracer-exp[ray]'"
    )


@pytest.mark.processes
def test_a_cluster_that_does_not_answer_is_refused_before_anything_is_made(call, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    ended = call(*SWEEP, "sweep/executor=ray", "sweep.executor.address=127.0.0.1:1")
    ended.assert_bad_input("no Ray cluster at 127.0.0.1:1", "ray start --head")
    assert not (ended.cwd / "runs" / "sweeps.db").exists()


@pytest.mark.slow
def test_a_cluster_without_room_is_refused(two_nodes, run_at, tmp_path):
    more = "sweep.executor.cpus_per_worker=64"
    ended = run_at(tmp_path, *SWEEP, "sweep/executor=ray", more)
    ended.assert_bad_input("no node of the Ray cluster has that many", more)


SERVER, MACHINES = "postgresql+psycopg://me@host/name", ["10.0.0.1", "10.0.0.2"]


@pytest.mark.parametrize(
    ("storage", "store", "word"),
    [
        (None, None, "sweep.storage=null: a file"),
        ("sqlite:////tmp/x.db", None, "postgresql+psycopg://"),
        (SERVER, Store("sqlite:////tmp/m.db", None), "tracking.uri"),
    ],
)
def test_files_are_no_databases_for_several_machines(tmp_path, storage, store, word):
    with pytest.raises(BadInput, match="2 machines") as error:
        refuse_files(storage, tmp_path, store, MACHINES)
    assert word in str(error.value)
    refuse_files(storage, tmp_path, store, MACHINES[:1])
    for tracked in (Store("http://host:5000", None), None):
        refuse_files(SERVER, tmp_path, tracked, MACHINES)
