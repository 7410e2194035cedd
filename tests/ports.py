"""Ports for servers that a test stops and starts again."""

import random
import socket
from pathlib import Path

_OWN = Path("/proc/sys/net/ipv4/ip_local_port_range")


def find_port() -> int:
    """Return a port of 127.0.0.1 on which nothing listens.

    It lies below those that the system gives to whoever asks for any: of these another test's server or connection may
    get it while the server that belongs there is stopped.
    """
    end = int(_OWN.read_text().split()[0]) if _OWN.exists() else 49_152
    ports = range(20_000, end)
    for port in random.sample(ports, len(ports)):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return port
    raise AssertionError("no port is free")
