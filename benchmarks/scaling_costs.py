"""What single calls cost PostgreSQL and MLflow in processor time, which does not depend on what else a machine does."""

import itertools
import os
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import psutil
import sqlalchemy as sa
from mlflow import MlflowClient
from mlflow.entities import Metric

from deepracer_exp.sweeps.queue.claims import TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage, resolve_database
from deepracer_exp.tracking.metrics import now_ms


def costs(address: str, tracking: str, times: int, folder: Path) -> dict[str, dict[str, float]]:
    """Return the processor time in ms that PostgreSQL and MLflow, with its database, take for a call of each kind."""
    study, storage = f"costs-{uuid.uuid4().hex[:8]}", open_storage(address, folder)
    claims = TrialClaims(storage.engine, study)
    held = [claims.claim(f"bench:{n}:a", 100, 3600.0) for n in range(100)]
    one, progress = held[0], {"iteration": 1, "params": {"algorithm.lr": 1e-3}}
    assert one is not None
    options = resolve_database(address, folder).engine_options()
    own = TrialClaims(
        sa.create_engine(address, connect_args=options["connect_args"], poolclass=sa.NullPool), study
    )
    client = MlflowClient(tracking_uri=tracking)
    experiment = client.create_experiment(study)
    run, steps = client.create_run(experiment).info.run_id, itertools.count()

    def log(rows: int) -> None:
        moments = [(next(steps), now_ms()) for _ in range(rows)]
        client.log_batch(run, [Metric(f"m{k}", 1.0, at, step) for step, at in moments for k in range(20)])

    file = folder / "picture.png"
    file.write_bytes(os.urandom(60_000))
    calls: dict[str, Callable[[], object]] = {
        "renewal of a lease, connection of its own": lambda: own.renew(one, 3600.0, progress),
        "renewal of a lease, pooled connection": lambda: claims.renew(one, 3600.0, progress),
        "renewal of 100 leases in one statement": lambda: claims.renew_all(
            {claim.held: progress for claim in held if claim is not None}, 3600.0
        ),
        "batch of a row of 20 metrics": lambda: log(1),
        "batch of five rows": lambda: log(5),
        "file of 60 kB": lambda: client.log_artifact(run, str(file)),
        "search of a run": lambda: client.search_runs([experiment], "attributes.start_time = 1"),
    }
    servers = [
        server(host_and_port(address, 5432)[1], "postgres"),
        server(host_and_port(tracking, 80)[1], "mlflow server"),
    ]
    found = {}
    for name, call in calls.items():
        call()
        before = list(map(cpu_s, servers))
        for _ in range(times):
            call()
        # A backend of PostgreSQL that has ended counts once its parent has noticed.
        time.sleep(1.0)
        used = [1000 * (cpu_s(each) - was) / times for each, was in zip(servers, before, strict=True)]
        found[name] = {"postgresql_ms": used[0], "mlflow_ms": used[1]}
    return found


def host_and_port(url: str, port: int) -> tuple[str, int]:
    """Return where a server listens."""
    found = sa.make_url(url)
    return found.host or "127.0.0.1", found.port or port


def server(port: int, program: str) -> psutil.Process:
    """Return the process of this machine that has started those which listen on a port."""
    listening = next(
        one.pid
        for one in psutil.net_connections("tcp")
        if one.status == psutil.CONN_LISTEN and one.laddr.port == port and one.pid
    )
    first = psutil.Process(listening)
    for parent in first.parents():
        if program in " ".join(parent.cmdline()):
            first = parent
    return first


def cpu_s(process: psutil.Process) -> float:
    """Return the processor time of a process and of all that it has started, those that have ended among them."""
    total = 0.0
    for one in (process, *process.children(recursive=True)):
        try:
            times = one.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total
