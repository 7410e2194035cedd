"""What a sweep demands of its database and of MLflow, and how many workers these two servers bear here.

    python -m benchmarks.scaling --storage postgresql+psycopg://racer@127.0.0.1/study --tracking http://127.0.0.1:5000

Both servers are the reader's own, and run on this machine (docs/scaling.md starts them). First a real sweep talks to
them through a relay that counts what passes. Then, for each load, simulated workers (scaling_load.py) make trials of
100 iterations, one a second, while calls are timed and the time of the processors is counted.
"""

import argparse
import os
import re
import socket
import statistics
import subprocess
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import optuna
import psutil
import sqlalchemy as sa
from optuna.storages import RDBStorage

from deepracer_exp.config.compose import compose_evaluation
from deepracer_exp.config.sweep import compose_sweep
from deepracer_exp.sweeps.queue.claims import Claim, TrialClaims
from deepracer_exp.sweeps.queue.driver import Driver
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.queue.study import open_study
from deepracer_exp.sweeps.queue.worker_config import WorkerConfig
from deepracer_exp.sweeps.search.space import SearchSpace
from deepracer_exp.sweeps.sweep import begin_study_run, progress_of
from deepracer_exp.tracking import mlflow_run as _imported_before_the_fork  # noqa: F401
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.store_thread import UPDATE_S

from .command import command_line
from .report import benchmark_parser, number, percent, table, write_json
from .scaling_costs import costs, cpu_s, host_and_port, server
from .scaling_load import Measured, SimulatedLauncher, Template

_REQUEST = re.compile(rb"(GET|POST|PUT|PATCH) (/\S*) HTTP/1\.1\r\n")
_SPACE = "algorithm.lr=tag(log,interval(1e-4,1e-3))"
_LATE_S = 2 * UPDATE_S
"""A row that is not in MLflow this long after its checkpoint is late."""
_EVERY = 10
"""Iterations between two evaluations of the default experiment."""
_WORKERS_A_PROCESS = 25
_CALLS = (
    *("transaction", "renewal of all leases", "live table"),
    *("log_batch", "other request", "row until it is in MLflow", "end of a run"),
)
"""Kinds of calls whose latencies are shown."""


class Relay:
    """Passes connections on to a server, and counts them, the HTTP requests and the bytes either way."""

    def __init__(self, host: str, port: int):
        self._to = (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._lock = threading.Lock()
        self.counts = dict.fromkeys(("connections", "requests", "batches", "bytes_up", "bytes_down"), 0)
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            ours, _ = self._listener.accept()
            theirs = socket.create_connection(self._to)
            for one in (ours, theirs):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._count("connections", 1)
            for way in ((ours, theirs, "bytes_up"), (theirs, ours, "bytes_down")):
                threading.Thread(target=self._pass, args=way, daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket, name: str) -> None:
        try:
            while data := source.recv(1 << 16):
                target.sendall(data)
                self._count(name, len(data))
                if name == "bytes_up":
                    requests = _REQUEST.findall(data)
                    self._count("requests", len(requests))
                    self._count("batches", sum(b"log-batch" in address for _, address in requests))
            target.shutdown(socket.SHUT_WR)
        except OSError:
            source.close()
            target.close()

    def _count(self, name: str, amount: int) -> None:
        with self._lock:
            self.counts[name] += amount


def commits(storage: RDBStorage) -> int:
    """Return how many transactions have ended in the database, whose statistics are up to a second late."""
    time.sleep(1.2)
    seen = sa.text(
        "SELECT xact_commit + xact_rollback FROM pg_stat_database WHERE datname = current_database()"
    )
    with storage.engine.connect() as connection:
        return int(connection.execute(seen).scalar_one())


def wal_bytes(storage: RDBStorage) -> int:
    """Return the bytes that the server has written into its log."""
    with storage.engine.connect() as connection:
        return int(connection.execute(sa.text("SELECT pg_current_wal_lsn() - '0/0'::pg_lsn")).scalar_one())


def through(relay: Relay, url: str) -> str:
    """Return the address of a server with the relay in its place."""
    return re.sub(r"//([^/@]*@)?[^/:]+(:\d+)?", rf"//\g<1>127.0.0.1:{relay.port}", url, count=1)


def real_sweep(args: argparse.Namespace, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a run, and what a sweep of the default experiment demands."""
    iterations = args.iterations
    database, tracking = Relay(*host_and_port(args.storage, 5432)), Relay(*host_and_port(args.tracking, 80))
    storage = open_storage(args.storage, folder)
    before, written = commits(storage), wal_bytes(storage)
    name = f"scaling-{uuid.uuid4().hex[:8]}"
    line = command_line(
        *("sweep", f"study={name}", f"sweep.trials={args.trials}", _SPACE, "budget.env_steps=null"),
        *("sweep.workers=2", "sweep.rerank=0", "stopping=none", "sweep.pruners=[]"),
        *(f"budget.iterations={iterations}", f"sweep.storage={through(database, args.storage)}"),
        f"tracking.uri={through(tracking, args.tracking)}",
    )
    began = time.monotonic()
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    took_s = time.monotonic() - began
    if done.returncode:
        raise SystemExit(done.stderr)
    runs = [path.parent for path in folder.glob(f"runs/{name}/*/summary.json")]
    claims = TrialClaims(storage.engine, name).all()
    held_s = sum(run.took_s or 0.0 for claim in claims for run in claim.trial.runs)
    return runs[0], {
        "iterations": iterations,
        "seconds": took_s,
        "trial_s": held_s / args.trials,
        "database": {**database.counts, "transactions": commits(storage) - before},
        "wal_bytes": wal_bytes(storage) - written,
        "mlflow": tracking.counts,
        "disk": {part: sum(size(run / part) for run in runs) for part in ("trace", "checkpoints", ".")},
    }


def size(path: Path) -> int:
    """Return the bytes of the files below a folder."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def load(args: argparse.Namespace, folder: Path, template: Template, workers: int) -> dict[str, Any]:
    """Return what `workers` simulated workers measure while they make trials."""
    name = f"load-{workers}-{uuid.uuid4().hex[:8]}"
    overrides = [_SPACE, f"sweep.workers={workers}", "sweep.trials=100000", "sweep.sampler=random"]
    overrides += [f"sweep.storage={args.storage}", f"tracking.uri={args.tracking}", f"runs_dir={folder}"]
    request = compose_sweep([*overrides, f"study={name}"])
    space = SearchSpace.from_request(request)
    # Before any thread begins: its processes are forked from this one.
    launcher = SimulatedLauncher(workers, -(-workers // _WORKERS_A_PROCESS), template)
    storage, store = open_storage(args.storage, folder), resolve_store(args.tracking, folder)
    study = open_study(request, overrides, space, None, storage, folder)
    study_run, study_run_id = begin_study_run(request, space, store, storage, folder)
    assert study_run is not None
    config = WorkerConfig(
        study=name,
        runs_dir=folder,
        config=request.entry.sweep,
        protocol=compose_evaluation(["evaluation=sweep"])[0].evaluation,
        space=space,
        parent=None,
        store=store,
        study_run_id=study_run_id,
        evaluations=template.iterations // template.every,
        cores=1,
    )
    mine, expired = Measured(), set[tuple[int, int]]()

    def look(claims: Sequence[Claim], _: str) -> None:
        expired.update((one.trial.number, one.attempt) for one in claims if one.expired)

    driver = Driver(
        config,
        storage,
        cast("Any", launcher),
        look,
        lambda claims: study_run.update(progress_of(claims, config.config, study)),
    )
    time_driver(driver, mine)
    interruption = SimpleNamespace(signum=None, exit_code=143)
    driving = threading.Thread(target=partial(driver.run, cast("Any", interruption)))
    began = time.monotonic()
    driving.start()
    time.sleep(args.warmup_s)
    used, window = Used(args, storage, launcher), [time.monotonic()]
    ended = sum(claim.has_ended for claim in TrialClaims(storage.engine, name).all())
    peak = used.connections()
    moments = [*window]
    while moments[-1] < window[0] + args.measure_s:
        time.sleep(1.0)
        peak = max(peak, used.connections())
        moments.append(time.monotonic())
    window.append(moments[-1])
    found = used.since_then()
    ended = sum(claim.has_ended for claim in TrialClaims(storage.engine, name).all()) - ended
    held = len(expired)
    interruption.signum = 15
    driving.join()
    study_run.finish("KILLED", 10.0)
    mine.join(launcher.measured())
    bounds = (window[0], window[1])
    late = [took_s for took_s in mine.within("row until it is in MLflow", bounds) if took_s > _LATE_S]
    seconds = window[1] - window[0]
    return {
        "workers": workers,
        "warmup_s": window[0] - began,
        "measure_s": seconds,
        "longest_pause_s": float(np.diff(moments).max()),
        "trials_a_minute": 60 * ended / seconds,
        "expired_leases": held,
        "renewals_by_workers": len(mine.within("renewal by a worker itself", bounds)),
        "late_rows": len(late),
        "failures": mine.failures,
        "connections_opened_a_second": len(mine.within("connection", bounds)) / seconds,
        "most_connections": peak,
        **found,
        "calls": {kind: spread(mine.within(kind, bounds), seconds) for kind in _CALLS},
    }


def time_driver(driver: Driver, measured: Measured) -> None:
    """Time the two statements that a driver repeats."""
    claims = driver._claims

    def timed(call: Callable[..., Any], kind: str, *args: Any) -> Any:
        began_s = time.monotonic()
        try:
            return call(*args)
        finally:
            measured.add(kind, began_s)

    for name, kind in (("renew_all", "renewal of all leases"), ("all", "live table")):
        setattr(claims, name, partial(timed, getattr(claims, name), kind))


def spread(seconds: Sequence[float], window_s: float) -> dict[str, float]:
    """Return how many calls a second there were, and the median, the 95th and the 99th percentile in ms."""
    if not seconds:
        return {"a_second": 0.0}
    p50, p95, p99 = 1000 * np.percentile(seconds, [50, 95, 99])
    return {"a_second": len(seconds) / window_s, "p50_ms": p50, "p95_ms": p95, "p99_ms": p99}


class Used:
    """What the servers and this load use of the machine, from now on."""

    def __init__(self, args: argparse.Namespace, storage: RDBStorage, launcher: SimulatedLauncher):
        self._storage = storage
        here = [psutil.Process(), *(psutil.Process(one.pid) for one in launcher.processes)]
        self._processes = {
            "PostgreSQL": [server(host_and_port(args.storage, 5432)[1], "postgres")],
            "MLflow": [server(host_and_port(args.tracking, 80)[1], "mlflow server")],
            "simulated workers": here,
        }
        self._began = time.monotonic()
        self._before = self._cpu_s()
        self._transactions = self._commits()
        self._load = os.getloadavg()[0]

    def connections(self) -> int:
        """Return how many connections PostgreSQL has of all its clients, MLflow among them."""
        return self._count("SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend'")

    def since_then(self) -> dict[str, Any]:
        """Return the processors used by each, and the transactions of PostgreSQL a second."""
        seconds, after = time.monotonic() - self._began, self._cpu_s()
        return {
            "cores_used": {name: (after[name] - self._before[name]) / seconds for name in after},
            "transactions_a_second": (self._commits() - self._transactions) / seconds,
            "load_average": statistics.mean((self._load, os.getloadavg()[0])),
        }

    def _cpu_s(self) -> dict[str, float]:
        used = {name: sum(map(cpu_s, processes)) for name, processes in self._processes.items()}
        times = psutil.cpu_times()
        used["all on this machine"] = sum(times) - times.idle - times.iowait
        return used

    def _commits(self) -> int:
        return self._count("SELECT sum(xact_commit + xact_rollback) FROM pg_stat_database")

    def _count(self, question: str) -> int:
        with self._storage.engine.connect() as connection:
            return int(connection.execute(sa.text(question)).scalar_one())


def main() -> None:
    """Measure, print and write."""
    parser = benchmark_parser("scaling", __doc__, None)
    parser.add_argument("--storage", required=True, help="PostgreSQL, an empty database")
    parser.add_argument("--tracking", required=True, help="an MLflow server")
    parser.add_argument("--trials", type=int, default=2, help="of the real sweep")
    parser.add_argument("--iterations", type=int, default=20, help="of each of its trials")
    parser.add_argument("--calls", type=int, default=100, help="of each kind whose cost is measured")
    parser.add_argument("--run", type=Path, help="a run of an earlier sweep, in place of the real sweep")
    parser.add_argument("--workers", type=int, nargs="*", default=(100, 250, 500, 1000), help="of the loads")
    parser.add_argument("--warmup-s", type=float, default=30.0)
    parser.add_argument("--measure-s", type=float, default=120.0)
    args = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        demanded, loads = dict[str, Any](), list[dict[str, Any]]()
        cost = costs(args.storage, args.tracking, args.calls, folder)
        calls = [
            [name, number(one["postgresql_ms"], 2), number(one["mlflow_ms"], 2)] for name, one in cost.items()
        ]
        print(table(["CPU time of a call, ms", "PostgreSQL", "MLflow"], calls), flush=True)
        if args.run is None:
            args.run, demanded = real_sweep(args, folder)
            rows = [
                [f"{part} {name}", number(value / args.trials)]
                for part in ("database", "mlflow", "disk")
                for name, value in demanded[part].items()
            ]
            print(table([f"of a trial of {args.iterations} iterations", ""], rows), flush=True)
        for workers in args.workers:
            loads.append(load(args, folder / "runs", Template(args.run, 100, _EVERY), workers))
            print(f"\n{shown(loads[-1])}", flush=True)
            write_json(args.json, {"costs": cost, "trials": args.trials, "sweep": demanded, "loads": loads})


def shown(found: dict[str, Any]) -> str:
    """Return what was measured of a load, in words and a table."""
    cores = ", ".join(f"{name} {used:.2f}" for name, used in found["cores_used"].items())
    rows = [
        [kind, *(number(calls.get(name), digits) for name, digits in _COLUMNS)]
        for kind, calls in found["calls"].items()
    ]
    late = found["late_rows"] / max(
        found["calls"]["row until it is in MLflow"]["a_second"] * found["measure_s"], 1
    )
    return "\n".join(
        [
            f"{found['workers']} workers, {found['trials_a_minute']:.0f} trials a minute, {found['measure_s']:.0f} s; "
            f"load average {found['load_average']:.1f}, longest pause {found['longest_pause_s']:.1f} s",
            f"leases expired: {found['expired_leases']}; renewed by workers themselves: {found['renewals_by_workers']}",
            f"late rows: {percent(late, 1)}; failures: {len(found['failures'])} {found['failures'][:1] or ''}",
            f"cores used: {cores}",
            f"PostgreSQL: {found['transactions_a_second']:.0f} transactions/s, at most {found['most_connections']} "
            f"connections, {found['connections_opened_a_second']:.1f} opened/s",
            table(["call", "a second", "median ms", "p95 ms", "p99 ms"], rows),
        ]
    )


_COLUMNS = (("a_second", 1), ("p50_ms", 0), ("p95_ms", 0), ("p99_ms", 0))

if __name__ == "__main__":
    main()
