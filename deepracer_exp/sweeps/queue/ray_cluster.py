"""The Ray cluster on which the workers of a sweep are placed."""

import importlib.util
import os
import socket
from typing import Any

from deepracer_exp.errors import BadInput

_ANSWER_S = 5.0


def connect(address: str, asked_by: str) -> None:
    """Join a running cluster, by HOST:PORT of its head or `auto`; none is ever started, so that none is left behind.

    Raises:
        BadInput: Ray is not installed, or no cluster answers.
    """
    if importlib.util.find_spec("ray") is None:
        raise BadInput(asked_by, "needs Ray; install it with: pip install 'deepracer-exp[ray]'")
    import ray

    if ray.is_initialized():
        return
    reachable = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    try:
        if reachable != "auto":
            _try_connection(reachable)
        ray.init(reachable, log_to_driver=False, logging_level="error")
    except (OSError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).split(". ")[0].rstrip(".")
        raise BadInput(
            f"{asked_by}: no Ray cluster at {reachable}: {reason}; start one with: ray start --head "
            "--disable-usage-stats"
        ) from None


def leave() -> None:
    """Leave the cluster; everything that this process has started there ends."""
    import ray

    ray.shutdown()


def node_addresses() -> list[str]:
    """Return the addresses of the nodes, each once."""
    return sorted({node["NodeManagerAddress"] for node in _nodes()})


def room(needs: dict[str, float]) -> int:
    """Return the number of workers that fit on the idle cluster if each needs these resources, `CPU` and `GPU`."""
    wanted = {name: amount for name, amount in needs.items() if amount > 0}
    return sum(
        int(min(node["Resources"].get(name, 0.0) / amount for name, amount in wanted.items()))
        for node in _nodes()
    )


def _nodes() -> list[dict[str, Any]]:
    import ray

    return [node for node in ray.nodes() if node["Alive"]]


def _try_connection(address: str) -> None:
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        raise ValueError("accepted: HOST:PORT")
    socket.create_connection((host, int(port)), _ANSWER_S).close()
