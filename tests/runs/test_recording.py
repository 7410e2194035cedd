"""Runs of ours in the schema that all recordings share."""

import shutil

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import yaml

from deepracer_exp.aws.logs import sim_trace
from deepracer_exp.aws.logs.recorded import METRICS_COLUMNS, STEP_COLUMNS, UPDATE_COLUMNS
from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.env.action_space import build_action_space, metadata_of
from deepracer_exp.env.trace_columns import SCHEMA
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.tables.log_tables import headline
from deepracer_exp.reports.tables.log_view import prepare
from deepracer_exp.runs.recording import EVALUATION_COLUMNS, is_traced_run, read_run_recording
from deepracer_exp.runs.trace import read_trace

OWN = ("stream", "worker", "wall_clock")
"""Columns that a trace of ours does not have."""


def kinds(table) -> dict[str, str]:
    return {name: str(kind) for name, kind in table.dtypes.items()}


@pytest.fixture
def folder(copied):
    """Return a copy of a run's folder that may be spoilt, with a file of its trace for each iteration."""
    folder = copied()
    files = sorted((folder / "trace").iterdir())
    whole = pa.concat_tables([pq.read_table(file) for file in files])
    for file in files:
        file.unlink()
    for iteration in (1, 2, 3, 4):
        rows = whole.filter(pc.equal(whole["iteration"], iteration))
        pq.write_table(rows, folder / "trace" / f"{iteration:05d}-iteration.parquet")
    return folder


def test_the_steps_are_the_rows_of_the_trace(trained):
    steps = read_run_recording(trained().folder).recording.steps
    assert steps.groupby("episode")["iteration"].nunique().max() > 1
    assert kinds(steps) == {name: kind for name, (kind, _) in STEP_COLUMNS.items()}
    trace = read_trace(trained().folder / "trace").sort_values("episode", kind="stable")
    assert len(steps) == len(trace) == 4096
    for name in STEP_COLUMNS:
        if name not in OWN:
            np.testing.assert_array_equal(steps[name].astype(trace[name].dtype), trace[name], err_msg=name)
    assert set(steps["stream"]) == {"training"}
    assert set(steps["worker"]) == {0}
    assert steps["wall_clock"].isna().all()


def test_iterations_of_updates_evaluations_and_trace_are_those_of_the_metrics(trained):
    run = trained()
    log = read_run_recording(run.folder)
    recording = log.recording
    assert kinds(recording.updates) == {name: kind for name, (kind, _) in UPDATE_COLUMNS.items()}
    assert (
        recording.updates["iteration"].tolist()
        == sorted(recording.steps["iteration"].unique())
        == [row["iteration"] for row in run.metrics]
        == [1, 2, 3, 4]
    )
    for name in ("policy_loss", "value_loss", "kl", "entropy", "lr"):
        assert recording.updates[name].tolist() == [row[name] for row in run.metrics]
    evaluated = [row for row in run.metrics if row["eval_completion"] is not None]
    assert list(log.evaluations) == list(EVALUATION_COLUMNS)
    assert log.evaluations["iteration"].tolist() == [row["iteration"] for row in evaluated]
    assert log.evaluations["completion"].tolist() == [row["eval_completion"] for row in evaluated]
    assert list(recording.metrics) == list(METRICS_COLUMNS)
    assert recording.metrics.empty


def test_what_was_trained_with_is_reported_in_the_services_words(trained):
    recording = read_run_recording(trained().folder).recording
    assert recording.problems == ()
    assert recording.hyperparameters["batch_size"] == 256
    assert recording.hyperparameters["discount_factor"] == 0.97
    assert recording.track == "reinvent_base"
    assert recording.metadata.low == (-30.0, 1.0)
    assert "def reward_function" in recording.reward_source
    assert trained().folder / "config.yaml" in recording.files


@pytest.mark.parametrize(
    "overrides", [("action_space=discrete", "budget.iterations=1"), ()], ids=["discrete", "continuous"]
)
def test_the_action_space_is_that_of_the_environment(trained, overrides):
    experiment, _ = compose_experiment(["experiment=tiny", *overrides])
    recording = read_run_recording(trained(*overrides).folder).recording
    assert recording.metadata == metadata_of(build_action_space(experiment.action_space))
    assert recording.steps["action"].isna().all() == (not overrides)


@pytest.mark.parametrize("kind", ["incomplete", "of another kind"])
def test_a_file_of_the_trace_that_cannot_be_read_is_left_out_and_reported(folder, kind):
    file = folder / "trace" / "00002-iteration.parquet"
    if kind == "incomplete":
        file.write_bytes(file.read_bytes()[:-100])
    else:
        pd.DataFrame({"episode": np.arange(10)}).to_parquet(file)
    recording = read_run_recording(folder).recording
    assert set(recording.steps["iteration"]) == {1, 3, 4}
    (problem,) = recording.problems
    assert problem.file == str(file)
    assert problem.reason.startswith("left out: ")
    assert file not in recording.files


def test_what_a_trace_lacks_is_counted_by_the_metrics(folder, monkeypatch):
    whole = prepare(read_run_recording(folder))
    assert whole.run.counted is None
    monkeypatch.setattr(sim_trace, "MOST_STEPS", 1100)
    view = prepare(read_run_recording(folder))
    assert len(view.steps) == 1024
    for name in ("iteration", "steps", "episodes", "complete"):
        assert view.iterations[name].tolist() == whole.iterations[name].tolist(), name
    assert headline(view).startswith("4,096 control steps of training in ")


def test_episodes_on_usual_conditions_are_known_where_only_a_share_of_the_cars_differs(folder):
    assert read_run_recording(folder).usual_episodes is None
    usual = set()
    for file in sorted((folder / "trace").glob("*-iteration.parquet")):
        rows = pq.read_table(file).to_pandas()
        rows["friction_scale"] = np.where(rows["episode"] % 3 == 0, 0.9, 1.0)
        usual |= set(rows["episode"][rows["episode"] % 3 > 0])
        pq.write_table(pa.Table.from_pandas(rows, pq.read_schema(file), preserve_index=False), file)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["randomization"] |= {"action_delay_steps": [0, 2], "friction_scale": [0.7, 1.2]}
    for share, known in ((0.5, True), (1, False), (0, False)):
        config["randomization"]["car_share"] = share
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        log = read_run_recording(folder)
        assert not log.recording.problems
        assert (log.usual_episodes is not None) is known
        if log.usual_episodes is not None:
            assert set(log.usual_episodes) == usual


def test_files_of_earlier_versions_which_have_no_decimals_are_read_beside_others(folder):
    steps = read_run_recording(folder).recording.steps
    file = folder / "trace" / "00002-iteration.parquet"
    pq.write_table(pq.read_table(file).cast(SCHEMA), file)
    mixed = read_run_recording(folder).recording
    assert not mixed.problems
    for name in ("X", "progress", "tstamp", "reward"):
        np.testing.assert_allclose(mixed.steps[name], steps[name], rtol=1e-12, err_msg=name)
    pd.testing.assert_series_equal(mixed.steps["episode_status"], steps["episode_status"])


def test_a_line_of_the_metrics_cut_off_by_a_kill_is_reported(folder):
    file = folder / "metrics.jsonl"
    file.write_text(file.read_text()[:-40])
    recording = read_run_recording(folder).recording
    assert recording.updates["iteration"].tolist() == [1, 2, 3]
    (problem,) = recording.problems
    assert (problem.file, problem.line) == (str(file), 4)


def test_missing_files_beside_the_trace_are_reported(folder):
    missing = [folder / name for name in ("config.yaml", "metrics.jsonl", "reward_function.py")]
    for file in missing:
        file.unlink()
    log = read_run_recording(folder)
    recording = log.recording
    assert len(recording.steps) == 4096
    assert len(recording.updates) == len(log.evaluations) == 0
    assert (
        recording.metadata is recording.hyperparameters is recording.reward_source is recording.track is None
    )
    assert sorted(problem.file for problem in recording.problems) == list(map(str, missing))


def test_without_a_trace_there_is_nothing_to_read(folder):
    assert is_traced_run(folder)
    for path in (folder / "trace").iterdir():
        path.write_bytes(b"nothing")
    with pytest.raises(BadInput, match="nothing of the trace can be read"):
        read_run_recording(folder)
    shutil.rmtree(folder / "trace")
    assert not is_traced_run(folder)
    with pytest.raises(BadInput, match=r"has no trace: .*; accepted: the folder of a run"):
        read_run_recording(folder)
