"""The process that a worker lives in; light, so that whoever starts workers does not import what they need."""

import logging
import os
import socket
import sys
from typing import TYPE_CHECKING

import psutil

from deepracer_exp.addresses import take_over
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.lifeline import end_with_owner
from deepracer_exp.training.signals import Interruption

if TYPE_CHECKING:
    from .plan import Plan

PRELOADED = "sweeps.worker"
"""What a fork server imports once for all workers."""

_log = logging.getLogger("deepracer_exp")


def owner_name(pid: int, token: str) -> str:
    """Return the name of a worker that no other one has or will have.

    Args:
        pid: of its process.
        token: of a few random characters, since numbers of processes come again.
    """
    return f"{socket.gethostname()}:{pid}:{token}"


def is_gone(owner: str) -> bool:
    """Return whether a worker was of this machine and its process is no more.

    Where two machines have one name, a worker that lives may be taken for one that is gone. It loses its trial to
    another one then, and learns of it, as if it had been too slow.
    """
    host, pid, _ = owner.rsplit(":", 2)
    return host == socket.gethostname() and not psutil.pid_exists(int(pid))


def main(plan: "Plan", token: str, log: str) -> None:
    """Be a worker process: what a driver starts.

    Exits with 0 when the study has all its trials, 130 or 143 when told to end, 3 if the database stays away.

    Args:
        plan: of the sweep.
        token: of the worker's name.
        log: file that takes what is said.
    """
    take_over(plan.addresses)
    # A session of its own: Ctrl-C in the terminal is for the driver, which tells its workers.
    os.setsid()
    with open(log, "a", buffering=1, encoding="utf-8") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    logging.basicConfig(format="%(asctime)s %(process)d %(message)s", level=logging.WARNING)
    end_with_owner()
    with Interruption() as interruption:
        import optuna
        import torch

        from .storage import open_storage
        from .worker import Worker

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        torch.set_num_threads(1)
        try:
            storage = open_storage(plan.config.storage, plan.runs_dir, plan.config.patience_s)
            Worker(plan, storage, owner_name(os.getpid(), token)).work(interruption)
        except (BadInput, RunFailed) as error:
            _log.error("%s", error)
            sys.exit(error.exit_code)
        except KeyboardInterrupt:  # told twice
            sys.exit(interruption.exit_code or 130)
    sys.exit(interruption.exit_code or 0)
