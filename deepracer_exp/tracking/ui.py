"""Serve MLflow's web UI for the project's runs, on this machine only."""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO

from deepracer_exp.addresses import redact
from deepracer_exp.errors import BadInput, RunFailed
from deepracer_exp.lifeline import running
from deepracer_exp.patience import use_of, wait_patiently

from .calls import pages
from .metadata import VIEW, WORKFLOW
from .store import Store, existing_store, open_client

_HOST = "127.0.0.1"
_START_S = 90.0
_ANSWER_S = 10.0
# A proxy set in the environment cannot reach this machine's loopback.
_DIRECTLY = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def serve_ui(runs_dir: Path, uri: str | None, port: int, announce: Callable[[str], None]) -> None:
    """Serve the UI until Ctrl-C, SIGTERM or SIGHUP; call `announce` with its address once it answers.

    If the store is a server, which has its own UI, only its address is announced.

    Raises:
        BadInput: no run is recorded yet, or the port is in use.
        RunFailed: the server did not start, or ended by itself.
    """
    store = existing_store(uri, runs_dir)
    if store.is_server:
        announce(runs_page(store.shown, uri, runs_dir))
        return
    for signum in (signal.SIGTERM, signal.SIGHUP):  # which end Python without cleaning up
        signal.signal(signum, lambda signum, _: sys.exit(128 + signum))
    with running_ui(store, port) as (url, server):
        try:
            announce(runs_page(url, uri, runs_dir))
            code = server.wait()
        except KeyboardInterrupt:
            return
    raise RunFailed(f"MLflow's server at {url} ended by itself (exit code {code})")


@contextmanager
def running_ui(store: Store, port: int) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run MLflow's server on `port` of 127.0.0.1 and yield its address and process once it answers."""
    if not _is_free(port):
        free = next((other for other in range(port + 1, 65536) if _is_free(other)), None)
        raise BadInput(f"port={port}: already in use on {_HOST}" + (f"; {free} is free" if free else ""))
    with store.creation_lock():
        pass  # wait for a first training that is creating the tables
    # Artifacts are read from where the experiment stores them; nothing is uploaded through the UI.
    options = f"--host {_HOST} --port {port} --workers 1 --no-serve-artifacts"
    command = [sys.executable, "-m", "mlflow", "server", *options.split()]
    if store.artifact_location:
        command += ["--default-artifact-root", store.artifact_location]
    environment = {
        # It is the server: a page of another person's store gets no password of the user's own.
        **{name: value for name, value in os.environ.items() if not name.startswith("MLFLOW_TRACKING_")},
        "PYTHONSAFEPATH": "1",
        "MLFLOW_BACKEND_STORE_URI": store.uri,  # not on the command line, where `ps` shows the password
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # six more processes, for judging chats
    }
    url = f"http://{_HOST}:{port}"
    # Its state is in a database, which loses nothing when the server is killed. uvicorn imports from the working folder
    # first, whatever PYTHONSAFEPATH says.
    options_of = {"env": environment, "cwd": "/", "stdin": subprocess.DEVNULL}
    with (
        tempfile.TemporaryFile() as output,
        running(command, stdout=output, stderr=output, **options_of) as server,
    ):
        _wait_until_it_answers(url, server, output)
        yield url, server


def runs_page(url: str, uri: str | None, runs_dir: Path) -> str:
    """Return the address, in the UI at `url`, of the runs table with the newest run, with its racing columns."""
    with open_client(f"ui of {url}", uri, runs_dir) as client:
        experiments = {listed.experiment_id: listed for listed in pages(client.search_experiments)}
        newest = client.search_runs(list(experiments), max_results=1, order_by=["attributes.start_time DESC"])
    if not newest:
        return f"{url}/#/experiments?{WORKFLOW}"
    experiment = experiments[newest[0].info.experiment_id]
    page = f"{url}/#/experiments/{experiment.experiment_id}/runs?{WORKFLOW}"
    return f"{page}&viewStateShareKey={VIEW}" if f"mlflow.sharedViewState.{VIEW}" in experiment.tags else page


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        # Like the server: a port whose last connections are in TIME_WAIT counts as free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HOST, port))
        except OSError:
            return False
    return True


def _wait_until_it_answers(url: str, server: subprocess.Popen[bytes], output: IO[bytes]) -> None:
    def has_settled(seconds: float) -> bool:
        if server.poll() is not None:
            return True
        try:
            with _DIRECTLY.open(f"{url}/health", timeout=_ANSWER_S):
                return True
        except OSError:
            time.sleep(min(seconds, 0.2))
            return False

    silence = wait_patiently(has_settled, _START_S, partial(use_of, server.pid))
    if server.poll() is not None:
        output.seek(0)
        lines = output.read().decode(errors="replace").strip().splitlines() or ["no output"]
        raise RunFailed(f"MLflow's server did not start at {url}: {redact(lines[-1])}")
    if silence is not None:
        raise RunFailed(f"MLflow's server did not answer at {url} within {silence}, and was ended")
