"""Recordings with more steps than are held in memory."""

import io

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from deepracer_exp.formats import step_tables
from deepracer_exp.formats.recording_reader import read_recording
from deepracer_exp.formats.trace import read_trace
from deepracer_exp.formats.training_log import read_training_log

from . import made_up_logs as made

LINE = made.line(next(made.drives([0]).itertuples())) + "\n"


@pytest.fixture
def most_steps(monkeypatch):
    """Let so many steps be too many already."""

    def most(steps: int) -> None:
        monkeypatch.setattr(step_tables, "MOST_STEPS", steps)

    return most


def test_of_a_log_longer_than_memory_the_last_steps_are_held_and_the_others_counted(most_steps):
    raw = "".join(made.log_text(made.drives([episode], seed=episode)) for episode in range(4000)).encode()
    assert len(raw) > 2**21
    lines = raw.count(b"SIM_TRACE_LOG")
    whole = read_training_log(Pieces(raw)).steps
    assert (whole.rows, whole.left_out) == (lines, 0)
    most_steps(lines // 3)
    last = read_training_log(Pieces(raw)).steps
    assert last.rows + last.left_out == lines
    assert lines // 6 < last.rows <= lines // 3
    rows = whole.whole.to_pandas()[last.left_out :].reset_index(drop=True)
    pd.testing.assert_frame_equal(last.whole.to_pandas(), rows, check_categorical=False)


class Pieces(io.BytesIO):
    """Hands out a sixteenth of a megabyte at a time."""

    def read(self, size: int | None = -1) -> bytes:
        return super().read(2**16)


def peak_of_arrow(raw: bytes) -> int:
    before = pa.default_memory_pool()
    counting = pa.proxy_memory_pool(before)
    pa.set_memory_pool(counting)
    try:
        read_training_log(Pieces(raw))
        return counting.max_memory()
    finally:
        pa.set_memory_pool(before)


def test_memory_does_not_grow_with_a_log_of_nothing_but_steps(most_steps):
    most_steps(5_000)
    short, long = (peak_of_arrow((LINE * count).encode()) for count in (5_000, 50_000))
    assert short > 100 * 5_000
    assert long < 1.5 * short
    most_steps(50_000)
    assert peak_of_arrow((LINE * 50_000).encode()) > 5 * short


def test_of_many_files_the_first_of_the_training_go_and_evaluations_stay(tmp_path, most_steps):
    made.write_folder(made.console(), tmp_path)
    whole = read_recording(tmp_path)
    training = (whole.steps["stream"] == "training").sum()
    iterations = sorted(set(whole.steps.loc[whole.steps["stream"] == "training", "iteration"]))
    most_steps(len(whole.steps) + training - 1)  # the log tells the same steps again
    short = read_recording(tmp_path)
    assert len(short.steps) == len(whole.steps)
    most_steps(len(whole.steps) - 1)
    short = read_recording(tmp_path)
    rest = short.steps[short.steps["stream"] == "training"]
    assert sorted(set(rest["iteration"])) == iterations[1:]
    assert len(short.steps) - len(rest) == len(whole.steps) - training
    told = [problem for problem in short.problems if "left out: of a recording the last" in problem.reason]
    assert any(f"{training - len(rest)} steps" in problem.reason for problem in told)
    assert all(str(tmp_path) in problem.file for problem in told)


def test_of_a_run_of_ours_the_last_iterations_are_read(trained, most_steps):
    folder = trained().folder
    trace = read_trace(folder / "trace")
    counts = np.bincount(trace["iteration"])
    assert len(counts) > 2
    most_steps(len(trace))
    assert not read_recording(folder).problems
    most_steps(int(counts[-2:].sum()))
    last = read_recording(folder)
    assert (
        last.steps["iteration"].tolist()
        == trace.loc[trace["iteration"] >= len(counts) - 2, "iteration"].tolist()
    )
    (problem,) = last.problems
    assert problem.lines == counts[:-2].sum()
    assert problem.reason.startswith(f"{counts[:-2].sum():,} steps left out: of a recording the last")
    assert len(last.updates) == len(counts)
