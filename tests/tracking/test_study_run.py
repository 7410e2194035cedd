import json
import threading

import pytest

from deepracer_exp.tracking.calls import StoreUnavailableError
from deepracer_exp.tracking.metadata import VIEW
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import Store
from deepracer_exp.tracking.study_run import Progress, StudyRun, end_trial_run, open_trial_run
from deepracer_exp.tracking.tracking_file import Group, TrackedRun

from .conftest import ProjectorHere, runs_of

SPACE = {"algorithm.lr": "tag(log, interval(1e-5, 1e-3))"}
BASE = ["track=reinvent_base", "+reward.constants.X=a<b"]


def begin(store, space=SPACE, objectives=("race_score",)) -> StudyRun:
    return StudyRun(store, "spring", objectives, space, BASE, projector=ProjectorHere())


def progress(ended=3, **changes) -> Progress:
    counts = {"total": 60, "complete": ended - 2, "pruned": 1, "failed": 1, "env_steps": 12_000}
    best = {"best_trial": 7, "best_values": {"race_score": 9.5}, "best_shown": "race score 9.50 s"}
    best |= {"best_line": "deepracer-exp train a=1", "lap_time_s": 9.4, "completion": 98.0}
    return Progress(**(counts | best | changes))


@pytest.fixture
def is_up(monkeypatch) -> threading.Event:
    """Let no store be opened before this is set; until then each call says that it does not answer."""
    is_up, connect = threading.Event(), MLflowRun._connect

    def connect_if_up(run):
        if not is_up.is_set():
            raise StoreUnavailableError("down")
        return connect(run)

    monkeypatch.setattr(MLflowRun, "_connect", connect_if_up)
    return is_up


def test_the_run_of_a_study_shows_its_search_its_progress_and_its_best(store, mlflow, tmp_path):
    run = begin(store)
    run_id = run.wait_for_id(60)
    run.update(progress())
    report = tmp_path / "report.html"
    report.write_text("<p>old</p>")
    run.log_report(report)
    assert run.finish("FINISHED", 60)
    (found,) = runs_of(mlflow, "spring")
    assert (found.info.run_id, found.info.status, found.info.run_name) == (run_id, "FINISHED", "sweep spring")
    assert found.data.params == {**SPACE, "track": "reinvent_base", "reward.constants.X": "a<b"}
    assert found.data.tags["sweep.progress"] == "3 of 60 trials: 1 complete, 1 pruned, 1 failed"
    assert (found.data.tags["sweep.best_trial"], found.data.tags["end"]) == ("7", "finished")
    assert "deepracer-exp train \\\n    a=1\n" in found.data.tags["mlflow.note.content"]
    assert found.data.metrics["trial/race_score_s"] == 9.5
    assert (found.data.metrics["trial/lap_time_s"], found.data.metrics["study/complete"]) == (9.4, 1)
    assert [file.path for file in mlflow.list_artifacts(run_id)] == ["report.html"]


def test_the_runs_table_of_a_study_opens_with_what_its_trials_differ_in(store, mlflow):
    run = begin(store, {**SPACE, "+reward.constants.X<": "0,1"}, ["lap_time", "completion"])
    assert run.finish("FINISHED", 60)
    experiment = mlflow.get_experiment_by_name("spring")
    columns = json.loads(experiment.tags[f"mlflow.sharedViewState.{VIEW}"])["selectedColumns"]
    (found,) = runs_of(mlflow, "spring")
    shown = [name for name in found.data.params if f"params.`{name}`" in columns]
    assert shown == ["algorithm.lr", "reward.constants.X_"]
    assert {"metrics.`trial/lap_time_s`", "metrics.`trial/completion`", "tags.`end`"} <= set(columns)


def test_a_continued_study_continues_its_run(store, mlflow):
    first = begin(store)
    first.update(progress(3))
    assert first.finish("KILLED", 60)
    assert runs_of(mlflow, "spring")[0].data.tags["end"] == "interrupted"
    second = begin(store)
    assert second.wait_for_id(60) == first.run_id
    (found,) = runs_of(mlflow, "spring")
    assert (found.info.status, "end" in found.data.tags) == ("RUNNING", False)
    second.update(progress(3))
    second.update(progress(4))
    second.update(progress(4, best_trial=5, best_values={"race_score": 9.75}))
    assert second.finish("FINISHED", 60)
    (found,) = runs_of(mlflow, "spring")
    assert (found.data.metrics["trial/race_score_s"], found.data.tags["sweep.best_trial"]) == (9.75, "5")
    assert [point.step for point in mlflow.get_metric_history(first.run_id, "study/complete")] == [3, 4]


def test_trials_that_started_before_the_run_of_their_study_are_nested_under_it(store, mlflow, is_up):
    def trial(name, study, start_ms):
        run, tags = MLflowRun(store), {"sweep.study": study, "sweep.trial": "0"}
        run.open(TrackedRun(name, "spring", start_ms, tags=tags))
        return run.run_id

    is_up.set()
    early, other = trial("trial 0", "spring", 1000), trial("trial 0", "autumn", 1001)
    is_up.clear()
    study_run = begin(store)
    assert study_run.wait_for_id(0.1) is None
    is_up.set()
    assert study_run.wait_for_id(60)
    late = trial("trial 1", "spring", 2000)
    study_run.update(progress())
    assert study_run.finish("FINISHED", 60)
    above = {run.info.run_id: run.data.tags.get("mlflow.parentRunId") for run in runs_of(mlflow, "spring")}
    assert above == dict.fromkeys((early, late), study_run.run_id) | dict.fromkeys((other, study_run.run_id))


def test_another_search_of_the_same_name_gets_a_run_of_its_own(store):
    ids = set()
    for space in (SPACE, {"algorithm.lr": "interval(0, 1)"}):
        run = begin(store, space)
        assert run.finish("FINISHED", 60)
        ids.add(run.run_id)
    assert len(ids) == 2


def test_of_two_runs_created_at_the_same_moment_the_older_one_stays(store, mlflow, monkeypatch):
    tracked = TrackedRun("sweep", "spring", 2000, tags={"sweep.study": "spring"})
    mine, theirs = MLflowRun(store), MLflowRun(store)
    create = MLflowRun._create

    def create_after_the_other(run, experiment_id, tracked):
        # The other one looked before this run was there, and created its own a little earlier.
        earlier = TrackedRun("sweep", "spring", 1000, tags=tracked.tags)
        theirs.run_id = create(theirs, experiment_id, earlier)
        return create(run, experiment_id, tracked)

    monkeypatch.setattr(MLflowRun, "_create", create_after_the_other)
    mine.open_only(tracked, Group(marks=("sweep.study",)))
    assert mine.run_id == theirs.run_id
    assert [run.info.run_id for run in runs_of(mlflow, "spring")] == [theirs.run_id]


def test_a_store_that_comes_late_gets_the_newest_progress_only(store, mlflow, is_up, caplog):
    run = begin(store)
    assert run.wait_for_id(0.05) is None
    for ended in range(3, 9):
        run.update(progress(ended))
    is_up.set()
    run_id = run.wait_for_id(60)
    assert run.finish("FINISHED", 60)
    assert [point.step for point in mlflow.get_metric_history(run_id, "study/complete")] == [8]
    assert not caplog.records


def test_a_store_that_never_answers_blocks_nothing(free_port, caplog, tmp_path):
    unreachable = Store(f"http://127.0.0.1:{free_port}", None)
    run = begin(unreachable)
    run.update(progress())
    # Limits of CPU time, of which attempts in this process use little.
    assert not run.finish("FINISHED", 0.05)
    assert run.run_id is None
    assert "could not be marked FINISHED" in caplog.text
    (tmp_path / "7").mkdir()
    assert (
        open_trial_run(tmp_path / "7", unreachable, "spring", 7, "0" * 32, [], ProjectorHere(), 0.05) is None
    )
    assert "trial 7 has no run there" in caplog.text


def test_the_seeds_of_a_trial_share_one_parent_run(store, mlflow, tmp_path):
    study = begin(store)
    parent, projector = study.wait_for_id(60), ProjectorHere()

    def open_one(folder: str, trial: int, lr: str) -> str | None:
        (tmp_path / folder).mkdir()
        return open_trial_run(
            tmp_path / folder, store, "spring", trial, parent, [f"algorithm.lr={lr}"], projector
        )

    (run_id,) = {open_one("first", 7, "0.001"), open_one("again", 7, "0.001")}
    other = open_one("other", 8, "0.002")
    values = {"trial/lap_time_s": 9.1, "trial/completion": None}
    end_trial_run(tmp_path / "again", store, "FINISHED", "finished: converged", values, projector)
    study.finish("FINISHED", 60)
    found = {run.info.run_id: run for run in runs_of(mlflow, "spring")}
    assert set(found) == {parent, run_id, other}
    assert found[run_id].data.tags["mlflow.parentRunId"] == parent
    assert found[run_id].data.params == {"algorithm.lr": "0.001"}
    assert (found[run_id].info.status, found[run_id].data.metrics) == ("FINISHED", {"trial/lap_time_s": 9.1})
    assert found[other].info.status == "RUNNING"


def test_a_store_that_hangs_holds_up_a_trial_for_its_deadline_at_most(store, monkeypatch, caplog, tmp_path):
    goes_on = threading.Event()

    def hang(run):
        goes_on.wait(60)
        raise StoreUnavailableError("gone")

    monkeypatch.setattr(MLflowRun, "_connect", hang)
    (tmp_path / "7").mkdir()
    assert open_trial_run(tmp_path / "7", store, "spring", 7, "0" * 32, [], ProjectorHere(), 0.2) is None
    goes_on.set()
    assert "trial 7 has no run there" in caplog.text


def test_the_experiment_names_the_winner_of_the_study_and_not_the_run_of_the_lowest_score(store, mlflow):
    run = begin(store)
    run.wait_for_id(60)
    run.update(progress())
    assert run.finish("FINISHED", 60)
    # A seed of another trial, and a training under the same name, have lower scores than the mean that won.
    lucky = MLflowRun(store)
    tracked = TrackedRun("lucky", "spring", 1)
    lucky.open(tracked)
    best = {"iteration": 1, "env_steps": 1, "eval_race_score_s": 1.5}
    lucky.conclude(tracked, {"status": "finished", "reason": "budget", "best": best}, [])
    note = mlflow.get_experiment_by_name("spring").tags["mlflow.note.content"]
    assert "trial 7, race score 9.50 s" in note
    assert "1.50" not in note
