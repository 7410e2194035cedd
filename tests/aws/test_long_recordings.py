"""Recordings with more steps than are held in memory."""

import io

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from deepracer_exp.aws.logs import blocks as log_blocks
from deepracer_exp.aws.logs import sim_trace
from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.text_log import TrainingLog, read_training_logs
from deepracer_exp.runs.recording import read_run_recording
from deepracer_exp.runs.trace import read_trace

from . import made_up_logs as made

LINE = made.line(next(made.drives([0]).itertuples())) + "\n"


def read_training_log(raw: bytes) -> TrainingLog:
    (log,) = read_training_logs(io.BytesIO(raw))
    return log


@pytest.fixture
def most_steps(monkeypatch):
    """Lower the number of steps that are held in memory."""

    def most(steps: int) -> None:
        monkeypatch.setattr(sim_trace, "MOST_STEPS", steps)
        monkeypatch.setattr(log_blocks, "SIZE", 2**16)

    return most


def test_the_last_steps_of_a_log_too_long_for_memory_are_kept_and_the_others_counted(most_steps):
    raw = 80 * "".join(made.log_text(made.drives([drive], seed=drive)) for drive in range(50)).encode()
    assert len(raw) > 2**21
    lines = raw.count(b"SIM_TRACE_LOG")
    whole = read_training_log(raw).steps
    assert (whole.rows, whole.left_out) == (lines, 0)
    most_steps(lines // 3)
    last = read_training_log(raw).steps
    assert last.rows + last.left_out == lines
    assert lines // 6 < last.rows <= lines // 3
    rows = whole.whole.to_pandas()[last.left_out :].reset_index(drop=True)
    pd.testing.assert_frame_equal(last.whole.to_pandas(), rows, check_categorical=False)


def peak_of_arrow(raw: bytes) -> int:
    before = pa.default_memory_pool()
    counting = pa.proxy_memory_pool(before)
    pa.set_memory_pool(counting)
    try:
        read_training_log(raw)
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


def test_of_many_files_the_first_training_steps_are_dropped_and_evaluations_stay(tmp_path, most_steps):
    made.write_folder(made.console(), tmp_path)
    whole = read_recording(tmp_path)
    training = (whole.steps["stream"] == "training").sum()
    iterations = sorted(set(whole.steps.loc[whole.steps["stream"] == "training", "iteration"]))
    most_steps(len(whole.steps) + training - 1)  # the log repeats the same steps
    short = read_recording(tmp_path)
    assert len(short.steps) == len(whole.steps)
    most_steps(len(whole.steps) - 1)
    short = read_recording(tmp_path)
    rest = short.steps[short.steps["stream"] == "training"]
    assert sorted(set(rest["iteration"])) == iterations[1:]
    assert len(short.steps) - len(rest) == len(whole.steps) - training
    reported = [
        problem for problem in short.problems if "steps are left out: only the last" in problem.reason
    ]
    assert any(f"{training - len(rest)} steps are" in problem.reason for problem in reported)
    assert all(str(tmp_path) in problem.file for problem in reported)


def test_the_last_iterations_of_our_own_run_are_read(trained, most_steps):
    folder = trained().folder
    trace = read_trace(folder / "trace")
    counts = np.bincount(trace["iteration"])
    assert len(counts) > 2
    most_steps(len(trace))
    assert not read_run_recording(folder).recording.problems
    most_steps(int(counts[-2:].sum()))
    last = read_run_recording(folder).recording
    rows = trace[trace["iteration"] >= len(counts) - 2].sort_values("episode", kind="stable")
    for name in ("iteration", "episode", "steps"):
        assert last.steps[name].tolist() == rows[name].tolist()
    (problem,) = last.problems
    assert problem.lines == counts[:-2].sum()
    assert problem.reason.startswith(f"{counts[:-2].sum():,} steps are left out: only the last")
    assert len(last.updates) == np.count_nonzero(counts)  # iterations are numbered from 1


def test_the_oldest_pieces_of_a_rolled_log_are_dropped(tmp_path, most_steps):
    pieces = {".10": [0, 1], ".2": [2, 3], ".1": [4, 5], "": [6, 7]}
    for ending, episodes in pieces.items():
        log = made.log_text(made.drives(episodes, seed=episodes[0] + 1))
        (tmp_path / f"robomaker.log{ending}").write_text(log)
    assert set(read_recording(tmp_path).steps["episode"]) == set(range(8))
    most_steps(3 * 12)
    assert set(read_recording(tmp_path).steps["episode"]) == set(range(2, 8))
    most_steps(12)
    assert set(read_recording(tmp_path).steps["episode"]) == {6, 7}


def test_the_first_iterations_of_several_workers_are_dropped(tmp_path, most_steps):
    made.write_folder(made.drfc_workers(), tmp_path)
    whole = read_recording(tmp_path)
    counts = whole.steps.groupby("iteration").size()
    most_steps(int(counts.iloc[1:].sum()))
    short = read_recording(tmp_path)
    assert set(short.steps["iteration"]) == set(counts.index[1:])
    assert set(short.steps["worker"]) == set(whole.steps["worker"])


def test_what_is_known_of_steps_that_are_left_out_is_left_out_and_counted(tmp_path, most_steps):
    rounds = {
        name: {
            **made.training_csvs("sim-trace/training/training-simtrace", seed=100 * seed),
            f"logs/training/training-2024010{seed}101010-a-sagemaker.log": made.trainer_text(3),
            f"metrics/training/training-2024010{seed}101010-a.json": made.training_metrics(
                made.drives(range(6), seed=seed)
            ),
        }
        for seed, name in ((1, "a"), (2, "b"))
    }
    for name, files in rounds.items():
        made.write_folder(files, tmp_path / name)
    whole = read_recording(tmp_path)
    assert (len(whole.steps), len(whole.metrics), whole.updates["iteration"].nunique()) == (72, 12, 6)
    most_steps(36)
    last = read_recording(tmp_path)
    assert (len(last.steps), len(last.metrics), last.updates["iteration"].nunique()) == (36, 6, 3)
    reasons = [problem.reason for problem in last.problems]
    assert any("policy updates are left out, as their steps are" in reason for reason in reasons)
    assert any("6 episodes are left out, as their steps are" in reason for reason in reasons)
    most_steps(60)
    last = read_recording(tmp_path)
    assert sorted(last.metrics["episode"]) == sorted(set(last.steps["episode"]))
