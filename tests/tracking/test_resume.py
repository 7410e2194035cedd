"""Runs that are continued by another process: one MLflow run, each point once."""

import json
import shutil

import pytest
from mlflow import MlflowClient

from deepracer_exp.errors import BadInput
from deepracer_exp.tracking.store import resolve_store
from deepracer_exp.tracking.tracking_file import (
    TrackedRun,
    begin_again,
    is_copy,
    read_tracked_run,
    write_tracked_run,
)

from .conftest import TrackerHere, begin, cover, points, runs_of, write_rows


def rows_until(iteration: int) -> list[dict[str, float]]:
    return [
        {"iteration": n, "env_steps": 100 * n, "wall_clock_s": n / 8, "completion": n / 3}
        for n in range(1, iteration + 1)
    ]


def logged_until(iteration: int) -> list[tuple[int, float]]:
    return [(row["env_steps"], row["completion"]) for row in rows_until(iteration)]


def reopened(store, folder) -> TrackerHere:
    """Return a tracker that continues a run."""
    tracker = TrackerHere(store)
    tracker.open(folder, read_tracked_run(folder))
    return tracker


@pytest.fixture
def killed(store, mlflow, tmp_path, wait_until):
    """Return the tracker of a run of ten iterations that was never finished."""
    tracker = TrackerHere(store)
    params, tags = {"seed": "1"}, {"track": "oval", "mlflow.note.content": "as it began"}
    begin(tracker, tmp_path, params=params, tags=tags)
    write_rows(tmp_path, rows_until(10))
    wait_until(lambda: tracker.run_id and len(points(mlflow, tracker.run_id)) == 10)
    thread = tracker.projector.thread
    tracker.projector.end()
    thread.join()
    return tracker


@pytest.fixture
def resumed(store, tmp_path, killed):
    """Return a tracker that continues that run."""
    return reopened(store, tmp_path)


def test_a_resumed_run_continues_the_same_mlflow_run(mlflow, tmp_path, killed, resumed):
    rows = rows_until(20)
    write_rows(tmp_path, rows[10:])
    resumed.finish("FINISHED")
    assert resumed.failure is None
    (run,) = runs_of(mlflow)
    assert run.info.run_id == resumed.run_id == killed.run_id
    assert run.info.status == "FINISHED"
    for key in ("completion", "iteration"):
        assert points(mlflow, run.info.run_id, key) == [(one["env_steps"], one[key]) for one in rows]
    history = mlflow.get_metric_history(run.info.run_id, "train/completion")
    start_ms = read_tracked_run(tmp_path).start_ms
    assert [point.timestamp - start_ms for point in history] == [125 * n for n in range(1, 21)]
    assert "env_steps" not in run.data.metrics


def test_points_wait_for_a_checkpoint_and_block_nothing_else(tracker, mlflow, wait_until, caplog, tmp_path):
    write_rows(tmp_path, rows_until(10), covered=0)
    tracker.set_tag("budget", "50%")
    wait_until(lambda: bool(tracker.run_id) and "budget" in mlflow.get_run(tracker.run_id).data.tags)
    assert points(mlflow, tracker.run_id) == []
    cover(tmp_path, 4)
    wait_until(lambda: len(points(mlflow, tracker.run_id)) == 4)
    tracker.set_tag("budget", "80%")
    tracker.finish("KILLED")
    assert tracker.failure is None
    assert points(mlflow, tracker.run_id) == logged_until(4)
    assert mlflow.get_run(tracker.run_id).data.tags["budget"] == "80%"
    assert not caplog.records


@pytest.mark.parametrize(("status", "steps"), [("KILLED", [500]), ("FINISHED", [500, 700])])
def test_an_evaluation_out_of_turn_counts_only_when_the_run_is_over(tracker, mlflow, tmp_path, status, steps):
    # Every fifth policy is evaluated, and the last when the run ends, which rewrites the last row.
    laps = {5: 9.5, 7: 9.25}
    write_rows(tmp_path, [{"eval_lap_time_s": laps.get(number), "kl": 1.0} for number in range(1, 8)])
    tracker.finish(status)
    assert tracker.failure is None
    assert [step for step, _ in points(mlflow, tracker.run_id, "eval_lap_time_s")] == steps
    assert len(points(mlflow, tracker.run_id, "kl")) == 7


def test_the_last_row_is_completed_when_the_run_is_over(tracker, mlflow, tmp_path, wait_until):
    write_rows(tmp_path, [{"kl": 1.0}] * 3)
    wait_until(lambda: tracker.run_id and len(points(mlflow, tracker.run_id, "kl")) == 3)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    lines[-1] = json.dumps(json.loads(lines[-1]) | {"eval_lap_time_s": 9.5})
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert points(mlflow, tracker.run_id, "eval_lap_time_s") == [(300, 9.5)]
    assert len(points(mlflow, tracker.run_id, "kl")) == 3


def test_a_run_whose_id_was_never_heard_is_found_again(store, mlflow, tmp_path, killed):
    (tmp_path / "mlflow.json").unlink()
    tracker = reopened(store, tmp_path)
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert [run.info.run_id for run in runs_of(mlflow)] == [killed.run_id]
    assert tracker.run_id == killed.run_id


def test_a_run_that_was_never_created_begins_when_it_began(store, mlflow, tmp_path, free_port):
    away = TrackerHere(type(store)(f"http://127.0.0.1:{free_port}", None))
    begin(away, tmp_path, params={"seed": "1"}, tags={"track": "oval"})
    write_rows(tmp_path, rows_until(1))
    away.finish("KILLED", deadline_s=0)
    assert away.run_id is None
    tracked = read_tracked_run(tmp_path)
    tracker = reopened(store, tmp_path)
    write_rows(tmp_path, rows_until(2)[1:])
    tracker.finish("FINISHED")
    assert tracker.failure is None
    (run,) = runs_of(mlflow)
    assert (run.info.start_time, run.info.run_name) == (tracked.start_ms, "run")
    assert (run.data.params, run.data.tags["track"]) == ({"seed": "1"}, "oval")
    assert points(mlflow, run.info.run_id) == logged_until(2)


def test_a_run_resumed_with_another_store_is_complete_there(store, mlflow, tmp_path, killed, empty_database):
    (tmp_path / "other").mkdir()
    shutil.copy(empty_database, tmp_path / "other" / "mlflow.db")
    other = resolve_store(None, tmp_path / "other")
    tracker = reopened(other, tmp_path)
    write_rows(tmp_path, rows_until(12)[10:])
    tracker.finish("FINISHED")
    assert tracker.failure is None
    there = MlflowClient(tracking_uri=other.uri)
    assert [run.info.run_id for run in runs_of(there)] == [tracker.run_id]
    assert points(there, tracker.run_id) == logged_until(12)
    tracker = reopened(store, tmp_path)
    tracker.finish("FINISHED")
    assert tracker.failure is None
    assert [run.info.run_id for run in runs_of(mlflow)] == [killed.run_id]


def test_a_copy_of_a_run_is_another_run_of_the_store_with_all_rows(store, mlflow, tmp_path):
    original = tmp_path / "race" / "run"
    original.mkdir(parents=True)
    tracker = TrackerHere(store)
    begin(tracker, original, tags={"run_dir": str(original)})
    write_rows(original, rows_until(10))
    tracker.finish("FINISHED")
    copy = shutil.copytree(original, original.with_name("copy"), symlinks=True)
    assert (is_copy(original), is_copy(copy)) == (False, True)
    begin_again(copy, copy)
    own = reopened(store, copy)
    write_rows(copy, rows_until(12)[10:])
    own.finish("FINISHED")
    assert own.failure is None
    assert {run.info.run_id for run in runs_of(mlflow)} == {tracker.run_id, own.run_id}
    assert points(mlflow, tracker.run_id) == logged_until(10)
    assert points(mlflow, own.run_id) == logged_until(12)


@pytest.fixture
def run_and_copy(tmp_path):
    """Return the folders of a run that no store has answered yet, and of its copy."""
    run = tmp_path / "race" / "run"
    run.mkdir(parents=True)
    write_tracked_run(run, TrackedRun("run", "race", 1, tags={"run_dir": str(run), "note": f"in {run}"}))
    return run, shutil.copytree(run, run.with_name("copy"))


def test_a_copy_is_one_until_it_begins_again(run_and_copy, tmp_path):
    run, copy = run_and_copy
    assert (is_copy(run), is_copy(copy)) == (False, True)
    (tmp_path / "link").symlink_to(tmp_path / "race")
    assert not is_copy(tmp_path / "link" / "run")
    assert not is_copy(shutil.copytree(tmp_path / "race", tmp_path / "whole" / "race") / "run")
    begin_again(copy, copy)
    assert not is_copy(copy)
    assert read_tracked_run(copy).tags == {"run_dir": str(copy), "note": f"in {copy}"}


@pytest.mark.parametrize("lost", ["gone", "corrupt", "another run"])
def test_where_the_original_is_lost_the_copy_is_the_run(run_and_copy, lost):
    run, copy = run_and_copy
    if lost == "gone":
        shutil.rmtree(run)
    elif lost == "corrupt":
        (run / "tracking.json").write_text("{")
    else:
        write_tracked_run(run, TrackedRun("run", "race", 2, tags={"run_dir": str(run)}))
    assert not is_copy(copy)


@pytest.mark.parametrize("recorded", ["/" + 300 * "x", "nul\0", "~" + 5000 * "/x"])
def test_a_place_that_cannot_be_looked_at_has_no_original(tmp_path, recorded):
    write_tracked_run(tmp_path, TrackedRun("run", "race", 1, tags={"run_dir": recorded}))
    assert not is_copy(tmp_path)


def test_a_resumed_run_is_shown_as_running(store, mlflow, tmp_path, killed, wait_until):
    killed.set_tag("end", "interrupted: by Ctrl-C")
    mlflow.set_tag(killed.run_id, "end", "interrupted: by Ctrl-C")
    mlflow.set_terminated(killed.run_id, "KILLED")
    mlflow.set_tag(killed.run_id, "mlflow.note.content", "edited in the UI")
    tracker = reopened(store, tmp_path)
    wait_until(lambda: mlflow.get_run(killed.run_id).info.status == "RUNNING")
    tracker.set_tag("went", "on")
    wait_until(lambda: "went" in mlflow.get_run(killed.run_id).data.tags)
    data = mlflow.get_run(killed.run_id).data
    assert "end" not in data.tags
    assert data.tags["mlflow.note.content"] == "edited in the UI"
    assert (data.params, data.tags["track"]) == ({"seed": "1"}, "oval")
    tracker.finish("FINISHED")
    assert tracker.failure is None


def test_a_run_that_had_ended_and_goes_on_has_no_end_and_its_new_rows_at_once(
    store, mlflow, tmp_path, resumed, wait_until
):
    resumed.finish("FINISHED")
    ended = read_tracked_run(tmp_path)
    assert ended.end_ms is not None
    again = reopened(store, tmp_path)
    write_rows(tmp_path, rows_until(12)[10:])
    wait_until(lambda: points(mlflow, resumed.run_id) == logged_until(12))
    assert mlflow.get_run(resumed.run_id).info.status == "RUNNING"
    assert read_tracked_run(tmp_path).end_ms is None
    again.finish("FINISHED")
    assert again.failure is None
    assert mlflow.get_run(resumed.run_id).info.end_time > ended.end_ms


def test_a_run_deleted_in_mlflow_is_not_recorded_and_says_so_in_one_line(
    store, mlflow, tmp_path, killed, caplog
):
    mlflow.delete_run(killed.run_id)
    tracker = reopened(store, tmp_path)
    write_rows(tmp_path, rows_until(20)[10:])
    tracker.finish("FINISHED")
    assert tracker.failure is not None
    (record,) = caplog.records
    assert f"run {killed.run_id} was deleted in MLflow; restore it there" in record.message
    assert points(mlflow, killed.run_id) == logged_until(10)


def test_a_repeated_iteration_that_differs_is_not_doubled(mlflow, killed, tmp_path, resumed):
    *same, last = rows_until(10)
    (tmp_path / "metrics.jsonl").unlink()
    write_rows(tmp_path, [*same, last | {"completion": 99.0}])
    resumed.finish("FINISHED")
    assert resumed.failure is None
    assert points(mlflow, killed.run_id) == logged_until(10)


TRACKED = {"run_id": None, "run_name": "a", "experiment": "b", "start_ms": 2, "store": "c"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "is missing"),
        ("{", "Invalid JSON"),
        ("[]", "accepted: what a training writes there"),
        ("{}", "run_name: Field required"),
        (json.dumps(TRACKED | {"run_id": 1}), "run_id: Input should be"),
        (json.dumps(TRACKED | {"start_ms": "x"}), "start_ms: Input should be"),
    ],
)
def test_a_file_that_no_tracker_wrote_is_refused(store, tmp_path, text, says):
    if text is not None:
        (tmp_path / "tracking.json").write_text(text)
    with pytest.raises(BadInput, match=says) as refused:
        reopened(store, tmp_path)
    assert str(tmp_path / "tracking.json") in str(refused.value)


def test_the_result_of_a_run_heads_its_description_and_that_of_its_experiment(store, mlflow, tmp_path):
    def train(name: str, lap_s: float) -> str:
        folder = tmp_path / name
        folder.mkdir()
        tracker = TrackerHere(store)
        tags = {"mlflow.note.content": "as it began"}
        begin(tracker, folder, name, tags=tags)
        (folder / "best_lap.png").write_bytes(b"picture")
        best = {"iteration": 4, "env_steps": 400, "metric": "race_score", "rank": [1.0, -lap_s]}
        best |= {"eval_lap_time_s": lap_s, "eval_race_score_s": lap_s, "eval_completion": 100.0}
        summary = {"status": "finished", "reason": "converged: all", "best": best}
        (folder / "summary.json").write_text(json.dumps(summary))
        tracker.finish("FINISHED", 60)
        assert tracker.failure is None
        return str(tracker.run_id)

    def note_of_experiment() -> str:
        return mlflow.get_experiment_by_name("race").tags["mlflow.note.content"]

    train("slow", 12.3456789)
    fast = train("fast", 8.7654321)
    of_run = mlflow.get_run(fast).data.tags["mlflow.note.content"]
    assert of_run.startswith("**finished**: converged: all")
    assert "**Best policy, iteration 4**: mean usual lap 8.77 s, 100.0% of the lap" in of_run
    assert f"(get-artifact?path=best_lap.png&run_uuid={fast})" in of_run
    assert of_run.endswith("as it began")
    assert "[fast]" in note_of_experiment()
    assert "8.77 s" in note_of_experiment()
    assert mlflow.get_run(fast).data.metrics["race/best/lap_time_s"] == 8.7654321
    experiment_id = mlflow.get_run(fast).info.experiment_id
    mlflow.set_experiment_tag(experiment_id, "mlflow.note.content", "mine")
    train("fastest", 7.0)
    assert note_of_experiment() == "mine"
