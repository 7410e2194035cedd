"""Runs that are listed, named, tagged and deleted, in their folders and in MLflow."""

import csv
import io
import json
import shutil
from pathlib import Path

import pytest

from deepracer_exp.errors import RunFailed
from deepracer_exp.runs import clean
from deepracer_exp.runs.checkpoint_files import pin
from deepracer_exp.tracking.delivery import undelivered
from deepracer_exp.tracking.store import resolve_store
from tests.tracking.conftest import Season, client, free_port, season, server

__all__ = ["client", "free_port", "season", "server"]


@pytest.fixture
def recorded(season: Season, client, tmp_path: Path) -> Path:
    """A run that MLflow has, too, in the working folder's runs/."""
    run = season.run("20261101-120000-oval")
    (run / "provenance.json").write_text(json.dumps({"machine": {"user": "anna", "host": "box"}}))
    run_id = season.recorded(run, client)
    store = resolve_store(None, season.runs_dir).shown
    tracked = {"run_name": "1", "experiment": "season", "start_ms": 0, "store": store, "end_ms": 1}
    (run / "tracking.json").write_text(json.dumps(tracked))
    (run / "mlflow.json").write_text(json.dumps({"store": store, "run_id": run_id, "end_ms": 1}))
    return run


def listed(call, *arguments: str) -> list[dict]:
    ended = call("runs", "list", "--format", "json", *arguments)
    assert ended.code == 0, ended.stderr
    return json.loads(ended.stdout)


def test_a_name_a_note_and_tags_are_in_the_folder_and_in_mlflow_and_find_the_run(recorded, client, call):
    run_id = json.loads((recorded / "mlflow.json").read_text())["run_id"]
    for words in (
        ("rename", recorded.name, "blue"),
        ("note", "blue", "tyres=new, 5 s faster"),
        ("tag", "blue", "car=red", "odd=1"),
        ("tag", "blue", "odd="),
    ):
        ended = call("runs", *words)
        assert ended.code == 0, ended.stderr
    wanted = {
        "name": "blue",
        "note": "tyres=new, 5 s faster",
        "tag.car": "red",
        "user": "anna",
        "host": "box",
    }
    (row,) = listed(call)
    assert row.items() >= wanted.items()
    assert "tag.odd" not in row
    tags = client.get_run(run_id).data.tags
    assert (tags["mlflow.runName"], tags["note"], tags["tag.car"]) == ("blue", "tyres=new, 5 s faster", "red")
    assert "tag.odd" not in tags
    uri = resolve_store(None, recorded.parents[1]).uri
    (row,) = listed(call, f"tracking.uri={uri}")
    assert {key: row[key] for key in ("name", "note", "tag.car", "id")} == {
        **{"name": "blue", "note": "tyres=new, 5 s faster", "tag.car": "red", "id": run_id}
    }


def test_conditions_and_an_order_hold_of_what_is_listed_in_every_format(season, call):
    for number, score in enumerate([9.0, 7.5, None, 8.0]):
        run = season.run(f"2026110{2 * number + 1}-120000-oval")
        season.result(run, best={"eval_race_score_s": score}, laps=number)
    rows = listed(call, "--where", "score_s<9", "--sort", "score_s")
    assert [row["score_s"] for row in rows] == [7.5, 8.0]
    # Runs without a value are the last in either order.
    scores = [row["score_s"] for row in listed(call, "--sort", "score_s", "--reverse")]
    assert scores == [9.0, 8.0, 7.5, None]
    assert [row["exploring_laps"] for row in listed(call, "--sort", "exploring_laps", "--reverse")] == [
        3,
        2,
        1,
        0,
    ]
    assert [
        row["exploring_laps"]
        for row in listed(call, "--where", "began>=2026-11-04T12", "--where", "exploring_laps!=3")
    ] == [2]
    assert listed(call, "--where", "run~NOTHING") == []
    table = call("runs", "list", "--where", "state=finished", "--format", "csv").stdout
    assert [row["exploring_laps"] for row in csv.DictReader(io.StringIO(table))] == ["3", "2", "1", "0"]
    call("runs", "list", "--where", "exploring_lap=3").assert_refused("no such column", "exploring_laps")
    call("runs", "list", "--where", "exploring_laps<many").assert_refused("'many' is no number")


def test_a_run_is_deleted_here_and_in_mlflow_only_with_yes(recorded, client, call):
    refused = call("runs", "delete", recorded.name)
    assert refused.code == 2
    assert "--yes" in refused.complaint
    assert recorded.is_dir()
    run_id = json.loads((recorded / "mlflow.json").read_text())["run_id"]
    assert call("runs", "delete", recorded.name, "--yes").code == 0
    assert not recorded.exists()
    assert client.get_run(run_id).info.lifecycle_stage == "deleted"


def test_a_copy_is_deleted_without_the_record_of_its_original(recorded, client, call):
    copy = shutil.copytree(recorded, recorded.with_name("copy"), symlinks=True)
    run_id = json.loads((recorded / "mlflow.json").read_text())["run_id"]
    for folder, stage in ((copy, "active"), (recorded, "deleted")):
        assert call("runs", "delete", folder.name, "--yes").code == 0
        assert not folder.exists()
        assert client.get_run(run_id).info.lifecycle_stage == stage


def test_a_run_that_mlflow_no_longer_knows_is_deleted(recorded, client, call):
    state = json.loads((recorded / "mlflow.json").read_text())
    (recorded / "mlflow.json").write_text(json.dumps(state | {"run_id": "0" * 32}))
    ended = call("runs", "delete", recorded.name, "--yes")
    assert ended.code == 0, ended.stderr
    assert not recorded.exists()


@pytest.mark.parametrize("why", ["in use", "cannot be removed"])
def test_a_run_that_cannot_be_removed_stays_active_in_mlflow(recorded, client, call, monkeypatch, why):
    def removed(_: object) -> bool:
        if why == "in use":
            return False
        raise RunFailed("checkpoints: cannot be removed: Permission denied")

    monkeypatch.setattr(clean, "remove", removed)
    run_id = json.loads((recorded / "mlflow.json").read_text())["run_id"]
    ended = call("runs", "delete", recorded.name, "--yes")
    assert ended.code == (2 if why == "in use" else 3)
    assert recorded.is_dir()
    assert client.get_run(run_id).info.lifecycle_stage == "active"


def test_what_is_needed_or_elsewhere_is_never_deleted(season, call, tmp_path):
    run, other = season.run("20261101-120000-a"), season.run("20261102-120000-b")
    pin(run / "checkpoints", "000020", "registered as season")
    season.clone("20261103-120000-c", other)
    outside = tmp_path / "elsewhere" / "season" / "20261104-120000-d"
    outside.parent.mkdir(parents=True)
    season.run("20261104-120000-d").rename(outside)
    (season.runs_dir / "season" / "20261105-120000-e").symlink_to(outside)
    (season.runs_dir / "linked").symlink_to(outside.parent)
    for name, words in (
        (run.name, "registered as season"),
        (other.name, "cloned to season/20261103-120000-c"),
        (str(outside), "is not a run's own folder"),
        ("20261105-120000-e", "is not a run's own folder"),
        (f"linked/{outside.name}", "is not a run's own folder"),
        (f"{season.runs_dir}/season/../../elsewhere/season/{outside.name}", "is not a run's own folder"),
    ):
        ended = call("runs", "delete", name, "--yes")
        assert ended.code == 2
        assert words in ended.complaint
    assert (outside / "config.yaml").is_file()
    assert run.is_dir()
    assert other.is_dir()


def test_a_label_that_a_server_did_not_take_is_sent_later(recorded, call, client, free_port):
    away = f"http://127.0.0.1:{free_port}"
    tracked = json.loads((recorded / "tracking.json").read_text())
    (recorded / "tracking.json").write_text(json.dumps(tracked | {"store": away}))
    ended = call("runs", "tag", recorded.name, "car=red", f"tracking.uri={away}")
    assert ended.code == 0
    assert f"send it later: deepracer-exp runs send runs/season/{recorded.name}" in ended.stderr
    assert away in json.loads((recorded / "mlflow.json").read_text())["problem"]
    assert undelivered([recorded]) == {recorded: away}
    assert json.loads((recorded / "labels.json").read_text())["tags"] == {"car": "red"}


def test_a_run_of_another_machine_is_labelled_by_its_id(recorded, client, call, tmp_path):
    run_id = json.loads((recorded / "mlflow.json").read_text())["run_id"]
    uri = resolve_store(None, recorded.parents[1]).uri
    recorded.rename(tmp_path / "gone")
    assert call("runs", "tag", run_id, "car=red", f"tracking.uri={uri}").code == 0
    assert call("runs", "note", run_id, "fast", f"tracking.uri={uri}").code == 0
    tags = client.get_run(run_id).data.tags
    assert (tags["tag.car"], tags["note"]) == ("red", "fast")


def test_the_traces_of_finished_runs_are_offered_with_their_size_and_go_only_if_asked(season, call):
    run = season.run("20261101-120000-a")
    for number in range(2, 41):
        (run / "trace" / f"{number:05d}-iteration.parquet").write_bytes(bytes(1000))
    shown = call("runs", "clean", "--apply").stdout
    assert "traces of 1 finished run: --traces drop removes 40.0 kB, --traces thin 30.0 kB" in shown
    assert len(list((run / "trace").iterdir())) == 40
    assert call("runs", "clean", "--traces", "thin").code == 0
    assert len(list((run / "trace").iterdir())) == 40
    assert call("runs", "clean", "--traces", "thin", "--apply").code == 0
    left = sorted(file.name for file in (run / "trace").iterdir())
    assert left == [f"{number:05d}-iteration.parquet" for number in range(31, 41)]
    assert call("runs", "clean", "--traces", "drop", "--apply").code == 0
    assert not (run / "trace").exists()
    assert (run / "summary.json").exists()


def test_a_run_without_its_trace_says_so_to_who_analyses_it(season, call):
    run = season.run("20261101-120000-a")
    assert call("runs", "clean", "--traces", "drop", "--apply").code == 0
    call("analyze", run.name).assert_refused("has no trace", "runs clean")
