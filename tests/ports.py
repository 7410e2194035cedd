"""Ports for servers that a test stops and starts again."""

import os
import random
import socket
from pathlib import Path

_OWN = Path("/proc/sys/net/ipv4/ip_local_port_range")
_given: set[int] = set()


def find_port() -> int:
    """Return a port of 127.0.0.1 on which nothing listens, and never the same again.

    It lies beside those that the system gives to any process that asks for a port, if that leaves some: of these
    another test's server or connection may get it while the server that belongs there is stopped. Each process of the
    tests has its own.
    """
    low, high = map(int, _OWN.read_text().split()) if _OWN.exists() else (49_152, 65_535)
    beside = [port for port in range(20_000, 65_536) if not low <= port <= high]
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    mine = (beside if len(beside) > 1000 else [*range(20_000, 65_536)])[worker::workers]
    for port in random.sample(mine, len(mine)):
        with socket.socket() as probe:
            if port not in _given and probe.connect_ex(("127.0.0.1", port)):
                _given.add(port)
                return port
    raise AssertionError("no port is free")
