"""What happens on a node of a Ray cluster: one place for one worker."""

import multiprocessing
import os
from multiprocessing.process import BaseProcess
from pathlib import Path

from deepracer_exp.errors import BadInput

from . import process
from .plan import Plan


class Place:
    """Takes cores of a node, and has a worker's process there; a Ray actor of two threads."""

    def __init__(self) -> None:
        self._process: BaseProcess | None = None

    def begin(self, plan: Plan, token: str, mark: Path, folder: str) -> str:
        """Start the process and return the worker's name.

        Args:
            plan: of the sweep; its folder is an absolute path.
            token: of the name.
            mark: a file that whoever started the sweep has made in its folder.
            folder: the working folder of the sweep, of which relative paths of the trials are.

        Raises:
            BadInput: this node does not see the folder.
        """
        import ray

        if not mark.exists():
            raise BadInput(
                f"runs_dir={plan.runs_dir}: node {ray.util.get_node_ip_address()} does not see that folder; "
                "sweep/executor=ray needs one that all nodes share, at the same path"
            )
        if Path(folder).is_dir():
            os.chdir(folder)
        # For a trial with collector=ray.
        os.environ["RAY_ADDRESS"] = ray.get_runtime_context().gcs_address
        log = plan.folder / f"workers-{os.uname().nodename}.log"
        # Its parent is this process, which it does not outlive.
        started = multiprocessing.get_context("spawn").Process(
            target=process.main, args=(plan, token, str(log))
        )
        started.start()
        assert started.pid is not None
        self._process = started
        return process.owner_name(started.pid, token)

    def ended(self) -> int:
        """Wait for the process and return its exit code."""
        assert self._process is not None
        self._process.join()
        assert self._process.exitcode is not None
        return self._process.exitcode

    def terminate(self) -> None:
        """Tell the process to end."""
        assert self._process is not None
        self._process.terminate()

    def kill(self) -> None:
        """End the process."""
        assert self._process is not None
        self._process.kill()
