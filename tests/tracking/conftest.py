import contextlib
import io
import json
import os
import queue
import resource
import shutil
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from mlflow import MlflowClient

from deepracer_exp.runs.checkpoint_files import write_hashes
from deepracer_exp.runs.run_files import read_run_id
from deepracer_exp.tracking import download, project, projector
from deepracer_exp.tracking.mlflow_metrics import metric_name, now_ms
from deepracer_exp.tracking.registry import Registered, promote
from deepracer_exp.tracking.store import Store, resolve_store
from deepracer_exp.tracking.tracker import ProjectedTracker, Tracker
from deepracer_exp.tracking.tracking_file import TrackedRun
from tests import waiting
from tests.ports import find_port


class ProjectorHere(projector.Projector):
    """Records in a thread of this process, which has imported MLflow, in place of a process."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: project.Lines = queue.SimpleQueue()
        self.thread: threading.Thread | None = None

    @property
    def is_lost(self) -> bool:
        return self.thread is None or not self.thread.is_alive()

    def send(self, line: dict) -> None:
        if self.is_lost:
            self._lines = queue.SimpleQueue()
            self.thread = threading.Thread(target=project.serve, args=(self._lines,), daemon=True)
            self.thread.start()
        self._lines.put(json.loads(json.dumps(line)))

    def end(self) -> None:
        self._lines.put(None)
        self.thread = None


class TrackerHere(ProjectedTracker):
    """A tracker that records in a thread of this process."""

    def __init__(self, store: Store) -> None:
        self.projector = ProjectorHere()
        super().__init__(store, self.projector)

    def open(self, folder: Path, run: TrackedRun) -> None:
        self._folder = folder
        super().open(folder, run)

    @property
    def run_id(self) -> str | None:
        return read_run_id(self._folder)


@pytest.fixture
def store(empty_database: Path, tmp_path: Path) -> Store:
    shutil.copy(empty_database, tmp_path / "mlflow.db")
    return resolve_store(None, tmp_path)


@pytest.fixture
def mlflow(store: Store) -> MlflowClient:
    """A client of `store`."""
    return MlflowClient(tracking_uri=store.uri)


@pytest.fixture
def tracker(store: Store, tmp_path: Path) -> TrackerHere:
    """The tracker of a run that has just begun."""
    tracker = TrackerHere(store)
    begin(tracker, tmp_path)
    return tracker


def begin(tracker: Tracker, folder: Path, name: str = "run", **described: dict[str, str]) -> None:
    """Let a tracker record a new run of a folder, with `params` and `tags`."""
    tracker.open(folder, TrackedRun(name, "race", now_ms(), **described))


@pytest.fixture(autouse=True)
def prompt(monkeypatch) -> None:
    """Let every tracker bring its store up to date without pauses."""
    monkeypatch.setattr(projector, "UPDATE_S", 0.05)


def write_rows(folder: Path, rows: list[dict], covered: int | None = None) -> None:
    """Append rows to a run's metrics.jsonl, like a training whose last checkpoint covers all, or `covered` of them.

    There is a row an iteration; a row without its number, env steps or clock gets them.
    """
    folder.mkdir(exist_ok=True)
    (folder / "config.yaml").write_text("checkpoints: {every: 5}\n")
    file = folder / "metrics.jsonl"
    there = file.read_text().count("\n") if file.exists() else 0
    with file.open("a") as lines:
        for number, row in enumerate(rows, there + 1):
            full = {"iteration": number, "env_steps": 100 * number, "wall_clock_s": number / 8} | row
            lines.write(json.dumps(full) + "\n")
    cover(folder, there + len(rows) if covered is None else covered)


def cover(folder: Path, iteration: int) -> None:
    """Make an iteration's checkpoint the last."""
    (folder / "checkpoints" / f"{iteration:06d}").mkdir(parents=True, exist_ok=True)
    (folder / "checkpoints" / "last").unlink(missing_ok=True)
    (folder / "checkpoints" / "last").symlink_to(f"{iteration:06d}")


def runs_of(client: MlflowClient, experiment: str = "race") -> list:
    return client.search_runs([client.get_experiment_by_name(experiment).experiment_id])


def points(client: MlflowClient, run_id: str | None, column: str = "completion") -> list[tuple[int, float]]:
    """Return step and value of each point that a run has of a column of metrics.jsonl."""
    history = client.get_metric_history(run_id, metric_name(column))
    return sorted((point.step, point.value) for point in history)


@pytest.fixture
def downloads_here(monkeypatch):
    """Let the process that downloads be a call in this one: importing MLflow takes it seconds, each time."""

    @contextlib.contextmanager
    def running(command, **_):
        def communicate(wanted: bytes, _: float):
            said = io.StringIO()
            monkeypatch.setattr(sys, "argv", command[-2:])
            monkeypatch.setattr(sys, "stdin", io.StringIO(wanted.decode()))
            with contextlib.redirect_stderr(said):
                process.returncode = download._main()
            return None, said.getvalue().encode()

        process = SimpleNamespace(communicate=communicate, pid=os.getpid())
        yield process

    monkeypatch.setattr(download, "running", running)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture
def projector_here(monkeypatch) -> None:
    """Let the process that records runs be a thread of this one."""
    monkeypatch.setattr(projector, "Projector", ProjectorHere)


@pytest.fixture
def wait_until() -> Callable[[Callable[[], object]], object]:
    return waiting.wait_until


@pytest.fixture
def free_port() -> int:
    return find_port()


class Server:
    """A real `mlflow server`, which can be stopped, killed and started again on its port."""

    def __init__(self, database: Path, port: int) -> None:
        self.uri = f"http://127.0.0.1:{port}"
        self._command = [
            *(sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port)),
            *("--workers", "1", "--backend-store-uri", f"sqlite:///{database}"),
            *("--artifacts-destination", str(database.parent / "server-artifacts")),
        ]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = {
            **os.environ,
            "MLFLOW_DISABLE_TELEMETRY": "true",
            "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        }
        self._process = subprocess.Popen(
            self._command, env=environment, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        waiting.wait_until(self._answers, "answer of the server")

    def _answers(self) -> bool:
        try:
            urllib.request.urlopen(f"{self.uri}/health", timeout=5).close()
        except OSError:
            return False
        return True

    def signal(self, signum: int) -> None:
        assert self._process is not None
        os.killpg(self._process.pid, signum)

    def kill(self) -> None:
        if self._process is not None:
            self.signal(signal.SIGKILL)
            self._process.wait()
            self._process = None


@pytest.fixture
def server(empty_database: Path, tmp_path: Path, free_port: int) -> Iterator[Server]:
    shutil.copy(empty_database, tmp_path / "server.db")
    server = Server(tmp_path / "server.db", free_port)
    server.start()
    yield server
    server.kill()


FEATURES = ("offset", "speed", "yaw_rate")
"""Of a policy that is promoted."""
SEEN = {"observation": (len(FEATURES),)}


CONFIG = {
    "track": {"name": "oval", "knots": [1, 2]},
    "car": {"name": "deepracer"},
    "observation": {
        **{"lookahead_m": [0.5, 1.0], "lookahead_scale_m": 2.0},
        **{"speed_scale_mps": 4.0, "yaw_rate_scale_radps": 5.0},
    },
    "evaluation": {"trials": 8, "tracks": None},
    "algorithm": {"lr": 0.001},
}


class Season:
    """Run folders as trainings leave them, without the training."""

    def __init__(self, runs_dir: Path) -> None:
        self.runs_dir = runs_dir

    def run(
        self, name: str, experiment: str = "season", /, status: str | None = "finished", **config
    ) -> Path:
        """Make a run with the checkpoints 10, 20 (best) and 30 (last); without a status it has no end."""
        run = self.runs_dir / experiment / name
        for iteration in (10, 20, 30):
            self.checkpoint(run, iteration)
        (run / "checkpoints" / "best").symlink_to("000020")
        (run / "checkpoints" / "last").symlink_to("000030")
        (run / "trace").mkdir()
        (run / "trace" / "00001-iteration.parquet").write_bytes(bytes(1000))
        (run / "config.yaml").write_text(yaml.safe_dump(CONFIG | {"name": experiment} | config))
        (run / "overrides.yaml").write_text("[]\n")
        (run / "provenance.json").write_text("{}")
        if status is not None:
            self.result(run, status=status)
        return run

    def checkpoint(self, run: Path, iteration: int) -> Path:
        folder = run / "checkpoints" / f"{iteration:06d}"
        (folder / "agent").mkdir(parents=True)
        (folder / "manifest.json").write_text("{}")
        (folder / "agent" / "state.tdz").write_text(f"{run.name} {iteration}")
        write_hashes(folder)
        return folder

    def result(self, run: Path, rank=None, lap_s=None, metric="lap_time", completion=90.0, **more) -> None:
        """Write the summary of a run, with the evaluation of its best checkpoint if it has a rank."""
        best = None
        if rank is not None:
            best = {"iteration": 20, "env_steps": 1, "metric": metric, "rank": list(rank)}
            best |= {"eval_completion": completion, "eval_lap_time_s": lap_s, "held_out_completion": None}
        summary = {"status": "finished", "best": best, "lap_share": None, "best_lap_time_s": None} | more
        (run / "summary.json").write_text(json.dumps(summary))

    def clone(
        self, name: str, parent: Path, generation: int = 1, checkpoint: str = "000020", **config
    ) -> Path:
        run = self.run(name, **config)
        lineage = {"parent": parent.name, "parent_dir": str(parent.resolve()), "parent_run_id": None}
        lineage |= {"checkpoint": checkpoint, "sha256": "0" * 64, "registered": None}
        lineage["generation"] = generation
        (run / "lineage.json").write_text(json.dumps(lineage))
        return run

    def recorded(self, run: Path, client: MlflowClient) -> str:
        """Record a run in MLflow; return its id."""
        found = client.get_experiment_by_name("season")
        place = (self.runs_dir / "artifacts").as_uri()
        experiment = found.experiment_id if found else client.create_experiment("season", place)
        run_id = client.create_run(experiment, 0, {"run_dir": str(run.resolve())}).info.run_id
        (run / "mlflow.json").write_text(json.dumps({"run_id": run_id}))
        return run_id

    def promote(self, run: Path, name="best", model="season", uri: str | None = None) -> Registered:
        """Promote a checkpoint of a recorded run as champion."""
        return promote(run, name, model, "champion", FEATURES, SEEN, uri, self.runs_dir)

    def champion(self, client: MlflowClient, name: str = "best") -> Path:
        """Make and record a run, and promote a checkpoint of it."""
        run = self.run("1")
        self.recorded(run, client)
        self.promote(run, name)
        return run


@pytest.fixture
def season(tmp_path: Path) -> Season:
    return Season(tmp_path / "runs")


@pytest.fixture
def client(season: Season, empty_database: Path) -> MlflowClient:
    """Of a store in the season's folder."""
    season.runs_dir.mkdir(exist_ok=True)
    shutil.copy(empty_database, season.runs_dir / "mlflow.db")
    return MlflowClient(tracking_uri=resolve_store(None, season.runs_dir).uri)
