"""What a sweep demands of its database, of MLflow and of the disk, and what load these two servers bear here.

    python -m benchmarks.scaling --storage postgresql+psycopg://racer@127.0.0.1/study --tracking http://127.0.0.1:5000

Both servers are the reader's own (docs/scaling.md starts them). A real sweep talks to them through a relay that counts
what passes.
"""

import argparse
import json
import re
import socket
import subprocess
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from mlflow import MlflowClient
from mlflow.entities import Metric
from optuna.storages import RDBStorage

from deepracer_exp.sweeps.queue.claims import TABLE, TrialClaims
from deepracer_exp.sweeps.queue.storage import open_storage
from deepracer_exp.sweeps.trial import SeedRun, runs_as_json

from .command import command_line
from .report import benchmark_parser, number, table, write_json

_REQUEST = re.compile(rb"(GET|POST|PUT|PATCH) /\S* HTTP/1\.1\r\n")
_SWEEP = (
    "sweep.workers=2",
    "sweep.rerank=0",
    "algorithm.lr=tag(log,interval(1e-4,1e-3))",
    "sweep.pruners=[]",
)
_TRIALS = (10, 100, 1000)
_CLIENTS = (1, 8, 32)


class Relay:
    """Passes connections on to a server, and counts them, the HTTP requests and the bytes either way."""

    def __init__(self, host: str, port: int):
        self._to = (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._lock = threading.Lock()
        self.counts = {"connections": 0, "requests": 0, "bytes_up": 0, "bytes_down": 0}
        threading.Thread(target=self._accept, daemon=True).start()

    def taken(self) -> dict[str, int]:
        """Return the counts, and start again from zero."""
        with self._lock:
            counts, self.counts = self.counts, dict.fromkeys(self.counts, 0)
        return counts

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
                    self._count("requests", len(_REQUEST.findall(data)))
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


def real_sweep(args: argparse.Namespace, folder: Path, iterations: int) -> dict[str, Any]:
    """Return what a sweep of the default experiment demands, with `iterations` in each trial."""
    database, tracking = Relay(*host_and_port(args.storage, 5432)), Relay(*host_and_port(args.tracking, 80))
    storage = open_storage(args.storage, folder)
    before, written = commits(storage), wal_bytes(storage)
    name = f"scaling-{uuid.uuid4().hex[:8]}"
    line = command_line(
        *("sweep", f"study={name}", f"sweep.trials={args.trials}", *_SWEEP, "budget.env_steps=null"),
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
    return {
        "iterations": iterations,
        "seconds": took_s,
        "trial_s": held_s / args.trials,
        "database": {**database.taken(), "transactions": commits(storage) - before},
        "wal_bytes": wal_bytes(storage) - written,
        "mlflow": tracking.taken(),
        "disk": {part: sum(size(run / part) for run in runs) for part in ("trace", "checkpoints", ".")},
    }


def host_and_port(url: str, port: int) -> tuple[str, int]:
    """Return where a server listens."""
    found = sa.make_url(url)
    return found.host or "127.0.0.1", found.port or port


def size(path: Path) -> int:
    """Return the bytes of the files below a folder."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def single_calls(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Return the cost of one call of each kind that is made repeatedly, with studies of several sizes."""
    relay, found = Relay(*host_and_port(args.storage, 5432)), {}
    direct = open_storage(args.storage, folder)
    storage = open_storage(through(relay, args.storage), folder)
    for trials in _TRIALS:
        study = f"calls-{uuid.uuid4().hex[:8]}"
        fill(direct, study, trials)
        claim = TrialClaims(direct.engine, study).claim("bench:1:a", trials + 1, 3600)
        assert claim is not None
        far = TrialClaims(storage.engine, study)
        calls: dict[str, Callable[[], object]] = {
            "renewal of a lease": lambda far=far, claim=claim: far.renew(claim, 3600.0, {"iteration": 1}),  # type: ignore[misc]
            "look of the live view": lambda far=far: far.all(),  # type: ignore[misc]
            "claim when nothing is free": partial(far.claim, "bench:2:b", trials + 1, 3600),
        }
        for name, call in calls.items():
            relay.taken()
            before, began = commits(direct), time.monotonic()
            for _ in range(20):
                call()
            took_s = (time.monotonic() - began) / 20
            counts = relay.taken()
            found[f"{name}, {trials} trials"] = {
                "transactions": (commits(direct) - before - 1) / 20,
                "bytes": (counts["bytes_up"] + counts["bytes_down"]) / 20,
                "ms": 1000 * took_s,
            }
    return found


def fill(storage: RDBStorage, study: str, trials: int) -> None:
    """Give a study `trials` finished trials, as large as those of the default experiment."""
    run = SeedRun(
        seed=0,
        run_dir="x" * 120,
        reason="x" * 60,
        status="finished",
        values=[10.0],
        ending="finished",
        env_steps=10**6,
    )
    row = {"attempt": 1, "owner": "bench:1:a", "state": "COMPLETE", "is_reported": True, "expires_s": 0.0}
    TrialClaims(storage.engine, study)
    there = sa.Table(TABLE, sa.MetaData(), autoload_with=storage.engine)
    rows = [
        {
            **row,
            "study": study,
            "number": number,
            "runs": json.dumps(runs_as_json([run])),
            "objective_values": "[10.0]",
        }
        for number in range(trials)
    ]
    with storage.engine.begin() as connection:
        connection.execute(sa.insert(there), rows)


def renewals_a_second(args: argparse.Namespace, folder: Path, clients: int) -> float:
    """Return how many leases a second the database renews for `clients`, with a connection for each transaction."""
    storage, study = open_storage(args.storage, folder), f"rate-{uuid.uuid4().hex[:8]}"
    claims = [TrialClaims(storage.engine, study).claim(f"bench:{n}:a", clients, 3600) for n in range(clients)]
    return rate(
        [lambda claim=claim: TrialClaims(storage.engine, study).renew(claim, 3600.0) for claim in claims]  # type: ignore[misc]
    )


def batches_a_second(args: argparse.Namespace, clients: int) -> float:
    """Return how many iterations a second, of 20 metrics each, MLflow's server takes from `clients`."""
    client = MlflowClient(tracking_uri=args.tracking)
    known = client.get_experiment_by_name("scaling-rate")
    experiment = known.experiment_id if known else client.create_experiment("scaling-rate")
    runs = [client.create_run(experiment).info.run_id for _ in range(clients)]
    steps = iter(range(10**9))

    def log(run: str) -> None:
        step = next(steps)
        client.log_batch(run, [Metric(f"m{k}", 1.0, int(time.time() * 1000), step) for k in range(20)])

    return rate([lambda run=run: log(run) for run in runs])  # type: ignore[misc]


def rate(calls: list[Callable[[], object]]) -> float:
    """Return how many calls a second are answered in eight, each made repeatedly by a thread of its own."""
    seconds = 8.0
    until = time.monotonic() + seconds

    def again(call: Callable[[], object]) -> int:
        made = 0
        while time.monotonic() < until:
            call()
            made += 1
        return made

    with ThreadPoolExecutor(len(calls)) as pool:
        return sum(pool.map(again, calls)) / seconds


def main() -> None:
    """Measure, print and write."""
    parser = benchmark_parser("scaling", __doc__, None)
    parser.add_argument("--storage", required=True, help="PostgreSQL, an empty database")
    parser.add_argument("--tracking", required=True, help="an MLflow server")
    parser.add_argument("--trials", type=int, default=2)
    parser.add_argument("--iterations", type=int, nargs=2, default=(5, 15), metavar=("FEW", "MANY"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        found: dict[str, Any] = {"trials": args.trials}
        steps: dict[str, Callable[[], Any]] = {
            "sweeps": lambda: [real_sweep(args, folder, iterations) for iterations in args.iterations],
            "calls": lambda: single_calls(args, folder),
            "renewals_a_second": lambda: {n: renewals_a_second(args, folder, n) for n in _CLIENTS},
            "mlflow_batches_a_second": lambda: {n: batches_a_second(args, n) for n in _CLIENTS},
        }
        for name, step in steps.items():
            found[name] = step()
            print(name, "measured", flush=True)
    write_json(args.json, found)
    rows = [
        [f"{sweep['iterations']} iterations: {part} {name}", number(value / args.trials)]
        for sweep in found["sweeps"]
        for part in ("database", "mlflow", "disk")
        for name, value in sweep[part].items()
    ]
    print(table(["of a real sweep", "a trial"], rows))
    calls = [
        [name, number(one["transactions"], 1), number(one["bytes"]), number(one["ms"], 1)]
        for name, one in found["calls"].items()
    ]
    print(table(["one call", "transactions", "bytes", "ms"], calls))
    for name in ("renewals_a_second", "mlflow_batches_a_second"):
        print(name, {clients: round(value) for clients, value in found[name].items()})


if __name__ == "__main__":
    main()
