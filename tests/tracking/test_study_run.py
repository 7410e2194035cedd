import json
import threading

from mlflow import MlflowClient

from deepracer_exp.tracking.metadata import VIEW
from deepracer_exp.tracking.mlflow_run import MLflowRun
from deepracer_exp.tracking.store import Store, StoreUnavailableError
from deepracer_exp.tracking.study_run import (
    Progress,
    StudyRun,
    end_trial_run,
    open_trial_run,
)
from deepracer_exp.tracking.tracking_file import TrackedRun

SPACE = {"algorithm.lr": "tag(log, interval(1e-5, 1e-3))"}
BASE = ["track=reinvent_base", "+reward.constants.X=a<b"]


def progress(ended=3, **changes) -> Progress:
    known = {
        "total": 60,
        "complete": ended - 2,
        "pruned": 1,
        "failed": 1,
        "env_steps": 12_000,
        "best_trial": 7,
    }
    known |= {
        "best_values": {"race_score": 9.5},
        "best_shown": "race score 9.50 s",
        "best_line": "deepracer-exp train a=1",
        "lap_time_s": 9.4,
    }
    return Progress(**(known | {"completion": 98.0} | changes))


def runs_of(store: Store, name="spring"):
    client = MlflowClient(tracking_uri=store.uri)
    return client.search_runs([client.get_experiment_by_name(name).experiment_id])


def test_the_run_of_a_study_shows_its_search_its_progress_and_its_best(store, tmp_path, caplog):
    run = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    run_id = run.wait_for_id(60)
    run.update(progress())
    report = tmp_path / "report.html"
    report.write_text("<p>old</p>")
    run.log_file(tmp_path / "missing.html")
    run.log_file(report)
    assert run.finish("FINISHED", 60)
    (found,) = runs_of(store)
    assert (found.info.run_id, found.info.status, found.info.run_name) == (run_id, "FINISHED", "sweep spring")
    assert found.data.params == {**SPACE, "track": "reinvent_base", "reward.constants.X": "a<b"}
    assert found.data.tags["sweep.progress"] == "3 of 60 trials: 1 complete, 1 pruned, 1 failed"
    assert (found.data.tags["sweep.best_trial"], found.data.tags["end"]) == ("7", "finished")
    assert "deepracer-exp train \\\n    a=1\n" in found.data.tags["mlflow.note.content"]
    assert found.data.metrics["trial/race_score_s"] == 9.5
    assert (found.data.metrics["trial/lap_time_s"], found.data.metrics["study/complete"]) == (9.4, 1)
    client = MlflowClient(tracking_uri=store.uri)
    assert [file.path for file in client.list_artifacts(run_id)] == ["report.html"]
    assert "missing.html is gone" in caplog.text, "which blocks nothing"


def test_the_runs_table_of_a_study_opens_with_what_its_trials_differ_in(store):
    run = StudyRun(
        store, "spring", ["lap_time", "completion"], {**SPACE, "+reward.constants.X<": "0,1"}, BASE
    )
    run.wait_for_id(60)
    assert run.finish("FINISHED", 60)
    experiment = MlflowClient(tracking_uri=store.uri).get_experiment_by_name("spring")
    view = json.loads(experiment.tags[f"mlflow.sharedViewState.{VIEW}"])
    columns = view["selectedColumns"]
    (found,) = runs_of(store)
    assert [name for name in found.data.params if f"params.`{name}`" in columns] == [
        "algorithm.lr",
        "reward.constants.X_",
    ]
    assert {"metrics.`trial/lap_time_s`", "metrics.`trial/completion`", "tags.`end`"} <= set(columns)


def test_a_continued_study_continues_its_run(store):
    first = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    first.update(progress(3))
    assert first.finish("KILLED", 60)
    assert runs_of(store)[0].data.tags["end"] == "interrupted"
    second = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    assert second.wait_for_id(60) == first.run_id
    (found,) = runs_of(store)
    assert (found.info.status, "end" in found.data.tags) == ("RUNNING", False)
    second.update(progress(3))
    second.update(progress(4))
    second.update(progress(4, best_trial=5, best_values={"race_score": 9.75}))
    assert second.finish("FINISHED", 60)
    (found,) = runs_of(store)
    assert (found.data.metrics["trial/race_score_s"], found.data.tags["sweep.best_trial"]) == (9.75, "5")
    client = MlflowClient(tracking_uri=store.uri)
    assert [point.step for point in client.get_metric_history(first.run_id, "study/complete")] == [3, 4]


def test_trials_that_started_before_the_run_of_their_study_are_nested_under_it(store, monkeypatch):
    is_up, connect = threading.Event(), MLflowRun.connect

    def connect_late(run):
        is_up.wait(60)
        connect(run)

    early, other = MLflowRun(store), MLflowRun(store)
    for run, study in ((early, "spring"), (other, "autumn")):
        run.connect()
        tags = {"sweep.study": study, "sweep.trial": "0"}
        run.create(TrackedRun(None, "trial 0", "spring", 1000, store.shown, tags=tags), again=False)
    monkeypatch.setattr(MLflowRun, "connect", connect_late)
    study_run = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    assert study_run.wait_for_id(0.1) is None
    is_up.set()
    assert study_run.wait_for_id(60)
    late = MLflowRun(store)
    late.connect()
    tags = {"sweep.study": "spring", "sweep.trial": "1"}
    late.create(TrackedRun(None, "trial 1", "spring", 2000, store.shown, tags=tags), again=False)
    study_run.update(progress())
    assert study_run.finish("FINISHED", 60)
    above = {run.info.run_id: run.data.tags.get("mlflow.parentRunId") for run in runs_of(store)}
    ids = (early.run_id, late.run_id, other.run_id, study_run.run_id)
    assert [above[run_id] for run_id in ids] == [study_run.run_id, study_run.run_id, None, None]


def test_another_search_of_the_same_name_gets_a_run_of_its_own(store):
    ids = set()
    for space in (SPACE, {"algorithm.lr": "interval(0, 1)"}):
        run = StudyRun(store, "spring", ["race_score"], space, BASE)
        ids.add(run.wait_for_id(60))
        assert run.finish("FINISHED", 60)
    assert len(ids) == 2


def test_of_two_runs_created_at_the_same_moment_the_older_one_stays(store, monkeypatch):
    tracked = TrackedRun(None, "sweep", "spring", 2000, store.shown, tags={"sweep.study": "spring"})
    mine, theirs = MLflowRun(store), MLflowRun(store)
    mine.connect()
    theirs.connect()
    create = MLflowRun.create

    def create_after_the_other(run, tracked, *, again):
        # The other one looked before this run was there, and created its own a little earlier.
        create(theirs, TrackedRun(None, "sweep", "spring", 1000, store.shown, tags=tracked.tags), again=False)
        create(run, tracked, again=again)

    monkeypatch.setattr(MLflowRun, "create", create_after_the_other)
    mine.create_once(tracked, ["sweep.study"])
    assert mine.run_id == theirs.run_id
    assert [run.info.run_id for run in runs_of(store)] == [theirs.run_id]


def test_a_store_that_comes_late_gets_the_newest_progress_only(store, monkeypatch, caplog):
    is_up, connect = threading.Event(), MLflowRun.connect

    def connect_if_up(run):
        if not is_up.is_set():
            raise StoreUnavailableError("down")
        connect(run)

    monkeypatch.setattr(MLflowRun, "connect", connect_if_up)
    run = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    assert run.wait_for_id(1.0) is None
    for ended in range(3, 9):
        run.update(progress(ended))
    is_up.set()
    run_id = run.wait_for_id(60)
    assert run.finish("FINISHED", 60)
    client = MlflowClient(tracking_uri=store.uri)
    assert [point.step for point in client.get_metric_history(run_id, "study/complete")] == [8]
    assert sum("does not answer" in record.message for record in caplog.records) == 1


def test_a_store_that_never_answers_blocks_nothing(free_port, caplog):
    unreachable = Store(f"http://127.0.0.1:{free_port}", None)
    run = StudyRun(unreachable, "spring", ["race_score"], SPACE, BASE)
    run.update(progress())
    assert not run.finish("FINISHED", 1.0)
    assert run.run_id is None
    assert "could not be marked FINISHED" in caplog.text
    assert open_trial_run(unreachable, "spring", 7, "0" * 32, []) is None
    assert "trial 7 has no run there" in caplog.text


def test_a_run_deleted_in_the_ui_is_reported_once_and_blocks_nothing(store, wait_until, caplog):
    run = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    MlflowClient(tracking_uri=store.uri).delete_run(run.wait_for_id(60))
    run.update(progress(3))
    wait_until(lambda: "refused" in caplog.text)
    run.update(progress(4))
    assert not run.finish("FINISHED", 60)
    assert sum("refused" in record.message for record in caplog.records) == 1


def test_the_seeds_of_a_trial_share_one_parent_run(store):
    study = StudyRun(store, "spring", ["race_score"], SPACE, BASE)
    parent = study.wait_for_id(60)
    ids = {open_trial_run(store, "spring", 7, parent, ["algorithm.lr=0.001"]) for _ in range(2)}
    other = open_trial_run(store, "spring", 8, parent, ["algorithm.lr=0.002"])
    (run_id,) = ids
    end_trial_run(store, "spring", run_id, "FINISHED", "finished: converged", {"trial/lap_time_s": 9.1})
    study.finish("FINISHED", 60)
    found = {run.info.run_id: run for run in runs_of(store)}
    assert set(found) == {parent, run_id, other}
    assert found[run_id].data.tags["mlflow.parentRunId"] == parent
    assert found[run_id].data.params == {"algorithm.lr": "0.001"}
    assert (found[run_id].info.status, found[run_id].data.metrics) == ("FINISHED", {"trial/lap_time_s": 9.1})
    assert found[other].info.status == "RUNNING"


def test_a_store_that_hangs_holds_up_a_trial_for_its_deadline_at_most(store, monkeypatch, caplog):
    goes_on = threading.Event()

    def hang(run):
        goes_on.wait(60)
        raise StoreUnavailableError("gone")

    monkeypatch.setattr(MLflowRun, "connect", hang)
    assert open_trial_run(store, "spring", 7, "0" * 32, [], deadline_s=0.2) is None
    goes_on.set()
    assert "trial 7 has no run there" in caplog.text
