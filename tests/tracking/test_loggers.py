"""Runs recorded by TensorBoard and Weights & Biases."""

import json
import struct
from dataclasses import replace

import pytest

from deepracer_exp.config.running import WandbTracking
from deepracer_exp.runs.run_files import TENSORBOARD, WANDB
from deepracer_exp.tracking.delivery import undelivered
from deepracer_exp.tracking.loggers import TensorBoardProjection, WandbProjection
from deepracer_exp.tracking.mlflow_metrics import METRICS, metric_name
from deepracer_exp.tracking.projection import RunProjection
from deepracer_exp.tracking.tracking_file import TrackedRun, write_tracked_run
from tests.conftest import IN_PROCESS
from tests.waiting import PATIENCE_S

from .conftest import write_rows

ROWS = [
    {"iteration": k, "env_steps": 100 * k, "wall_clock_s": 2.0 * k, "mean_return": float(k)}
    | {"eval_lap_time_s": None}
    for k in (1, 2, 3)
]


def record(projection: RunProjection, rows, covered: int, status=None, laps=()) -> None:
    """Project a folder with these rows, of which a checkpoint covers some; then their last laps, and the end."""
    folder = projection.folder
    (folder / "metrics.jsonl").unlink(missing_ok=True)
    write_rows(folder, rows, covered)
    run = TrackedRun("progress_delta s1", "tiny", 1, {"seed": "1"}, {"reward": "progress_delta"})
    write_tracked_run(folder, run)
    assert projection.update() is None
    if status is not None:
        (folder / "metrics.jsonl").unlink()
        write_rows(folder, [*rows[:-1], {**rows[-1], **dict(laps)}], covered)
        tags = {**run.tags, "end": "finished: budget"}
        write_tracked_run(folder, replace(run, tags=tags, status=status, end_ms=2))
        assert projection.update() is None
        assert projection.is_done


def scalars(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}, events


@pytest.fixture
def tensorboard(tmp_path):
    """Open a projection to TensorBoard."""
    pytest.importorskip("tensorboard")
    return lambda: TensorBoardProjection(tmp_path)


def test_tensorboard_has_the_metrics_under_their_names_in_mlflow(tensorboard, tmp_path):
    record(tensorboard(), ROWS, 2, "FINISHED", {"eval_lap_time_s": 9.5})
    found, events = scalars(tmp_path / TENSORBOARD)
    assert found == {
        "train/iteration": [(100, 1.0), (200, 2.0), (300, 3.0)],
        "train/mean_return": [(100, 1.0), (200, 2.0), (300, 3.0)],
        "time/wall_clock_s": [(100, 2.0), (200, 4.0), (300, 6.0)],
        "race/lap_time_s": [(300, 9.5)],
    }
    texts = {tag.removesuffix("/text_summary") for tag in events.Tags()["tensors"]}
    assert texts == {"parameters", "reward", "end"}


def test_a_resumed_run_has_each_row_once_in_tensorboard(tensorboard, tmp_path):
    record(tensorboard(), ROWS, 3, "KILLED")
    found, _ = scalars(tmp_path / TENSORBOARD)
    assert found["train/mean_return"] == [(100, 1.0), (200, 2.0), (300, 3.0)]
    record(tensorboard(), [*ROWS[:2], {**ROWS[2], "mean_return": 7.0}], 3, "FINISHED")
    found, _ = scalars(tmp_path / TENSORBOARD)
    assert found["train/mean_return"] == [(100, 1.0), (200, 2.0), (300, 7.0)]


def read_wandb(folder) -> list[dict[str, float]]:
    """Return the rows of an offline run, whose file is a LevelDB log behind seven bytes."""
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = folder.glob("offline-run-*/*.wandb")
    data, at, rows, content = file.read_bytes(), 7, [], b""
    while at + 7 < len(data):
        if 32768 - at % 32768 < 7:  # no header fits into the rest of the block
            at += 32768 - at % 32768
            continue
        _, length, part = struct.unpack_from("<IHB", data, at)
        if at + 7 + length > len(data):
            break
        content += data[at + 7 : at + 7 + length]
        at += 7 + length
        if part in (1, 4):  # whole, or the last part
            message = Record.FromString(content)
            content = b""
            if message.HasField("history"):
                items = message.history.item
                rows.append({item.key or item.nested_key[0]: json.loads(item.value_json) for item in items})
    return rows


def test_wandb_has_only_rows_that_a_checkpoint_covers_and_each_once(tmp_path, wait_until, monkeypatch):
    pytest.importorskip("wandb")
    for variable in ("WANDB__SERVICE_WAIT", "WANDB_INIT_TIMEOUT"):  # for the start of W&B's own process
        monkeypatch.setenv(variable, str(PATIENCE_S))
    config = WandbTracking(kind="wandb", project="deepracer-exp", entity=None, mode="offline")
    for status, steps in (("KILLED", [100, 200]), ("FINISHED", [100, 200, 300])):
        record(WandbProjection(config, tmp_path), ROWS, 2, status)
        # W&B's own process may still be writing.
        wait_until(lambda steps=steps: len(read_wandb(tmp_path / WANDB)) >= len(steps))
        rows = read_wandb(tmp_path / WANDB)
        assert [row["_step"] for row in rows] == steps
        assert [row["train/mean_return"] for row in rows] == [step / 100 for step in steps]
        assert "race/lap_time_s" not in rows[0]


@pytest.mark.processes
@pytest.mark.parametrize("kind", [TENSORBOARD, WANDB])
def test_a_missing_package_is_one_line_that_names_the_extra(call, kind, monkeypatch):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == kind else find(name, *a)
    )
    ended = call("train", "experiment=tiny", f"tracking={kind}")
    ended.assert_bad_input(f"tracking={kind}", f"pip install 'deepracer-exp[{kind}]'")


@pytest.mark.usefixtures("projector_here")
def test_a_training_writes_its_curves_for_tensorboard(call):
    pytest.importorskip("tensorboard")
    ended = call("train", *IN_PROCESS, "tracking=tensorboard", "budget.iterations=1")
    assert ended.code == 0, ended.stderr
    found, _ = scalars(ended.folder / TENSORBOARD)
    steps = [row["env_steps"] for row in ended.metrics]
    assert [step for step, _ in found[metric_name("entropy")]] == steps
    assert found.keys() & {name for name, _ in METRICS.values()} == found.keys()
    assert not undelivered([ended.folder])  # which is of MLflow
