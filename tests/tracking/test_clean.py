"""What clean lists, what it removes, and what it never touches."""

import fcntl
import json
import os
import shutil
from pathlib import Path

import pytest

from deepracer_exp.runs.checkpoint_files import pin
from deepracer_exp.runs.clean import (
    DELETED,
    DROP,
    FAILED_TRACE,
    SPARE_CHECKPOINTS,
    asked_traces,
    remove,
    replays,
    survey,
)
from deepracer_exp.runs.run_files import full_name
from deepracer_exp.tracking.registry import read_overview

HOUR_S = 3600


def tree(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def surveyed(season, asked: bool):
    """Look what may go; `asked`: MLflow is read."""
    return survey(season.runs_dir, read_overview(None, season.runs_dir) if asked else None)


def listed(season, *, asked: bool = False) -> list[tuple[str, str, list[str]]]:
    removable = surveyed(season, asked).removable
    return [(item.run.name, item.what, [path.name for path in item.paths]) for item in removable]


def kept(season, *, asked: bool = False) -> dict[str, str]:
    return {run.name: reason for run, reason in surveyed(season, asked).kept}


def age(run: Path, seconds: float) -> None:
    for path in (run, *run.rglob("*")):
        then = path.lstat().st_mtime - seconds
        os.utime(path, (then, then), follow_symlinks=False)


def test_a_clones_parent_is_known_by_name_where_its_folder_was_moved(season, tmp_path):
    season.clone("2", season.run("1"), checkpoint="000010")
    season.runs_dir.rename(tmp_path / "moved")
    season.runs_dir = tmp_path / "moved"
    assert listed(season) == [("2", SPARE_CHECKPOINTS, ["000010"])]
    pin(season.runs_dir / "season" / "2" / "checkpoints", "000010", "cloned into season")
    assert listed(season) == []


def test_what_is_needed_of_a_run_is_not_kept_of_another_experiments_run_of_the_same_name(season, client):
    season.champion(client)
    season.clone("2", season.run("9"), checkpoint="000010")
    for name in ("1", "9"):
        season.run(name, "other")
    removable = surveyed(season, asked=True).removable
    spare = {full_name(item.run): [path.name for path in item.paths] for item in removable}
    assert spare["other/1"] == spare["other/9"] == ["000010"]
    assert "season/9" not in spare


def test_a_registered_checkpoint_stays_though_nothing_else_says_so(season, client):
    run = season.champion(client, "10")
    (run / "checkpoints" / "pinned.json").unlink()
    client.delete_registered_model_alias("season", "champion")
    assert listed(season, asked=True) == []


def test_checkpoints_of_a_recorded_run_stay_while_its_registry_is_not_asked(season, client):
    season.recorded(season.run("1"), client)
    season.run("2")
    assert listed(season) == [("2", SPARE_CHECKPOINTS, ["000010"])]
    assert "tracking.uri" in kept(season)["1"]
    assert len(listed(season, asked=True)) == 2
    (season.runs_dir / "season" / "1" / "mlflow.json").write_text(json.dumps({"run_id": "0" * 32}))
    assert len(listed(season, asked=True)) == 1


def test_traces_of_failed_runs_can_go_and_of_no_others(season):
    for name, status in (("1", "finished"), ("2", "failed"), ("3", "interrupted"), ("4", "stopped early")):
        shutil.rmtree(season.run(name, status=status) / "checkpoints")
    assert listed(season) == [("2", FAILED_TRACE, ["trace"])]


def test_replays_of_ended_runs_are_offered_and_no_others(season):
    for name, status in (("1", "finished"), ("2", "failed"), ("3", "interrupted"), ("4", None)):
        part = season.run(name, status=status) / "replay" / "000020"
        part.mkdir(parents=True)
        (part / "state.tdz").write_bytes(bytes(5000))
        age(part.parent.parent, 2 * HOUR_S)
    found = surveyed(season, False)
    offered = replays(found.offered)
    assert [(item.run.name, item.size) for item in offered] == [("1", 5000), ("2", 5000)]
    assert "replay" not in {path.name for item in found.removable for path in item.paths}
    assert [item.run.name for item in asked_traces(found.offered, DROP)] == ["1"]
    assert all(map(remove, offered))
    assert [(season.runs_dir / "season" / name / "replay").exists() for name in "123"] == [False, False, True]


def test_a_run_deleted_in_mlflow_can_go_whole_and_an_active_one_cannot(season, client):
    ids = [season.recorded(season.run(name), client) for name in ("1", "2")]
    client.delete_run(ids[0])
    first = ("1", DELETED, ["1"])
    assert listed(season, asked=True) == [first, ("2", SPARE_CHECKPOINTS, ["000010"])]
    client.delete_experiment(client.get_experiment_by_name("season").experiment_id)
    assert listed(season, asked=True) == [first, ("2", DELETED, ["2"])]


def test_a_deleted_run_that_is_needed_is_kept_with_a_reason(season, client):
    cloned, registered = season.run("1"), season.run("2")
    season.clone("3", cloned)
    ids = [season.recorded(run, client) for run in (cloned, registered)]
    season.promote(registered)
    for run_id in ids:
        client.delete_run(run_id)
    assert DELETED not in [what for _, what, _ in listed(season, asked=True)]
    reasons = kept(season, asked=True)
    assert reasons["1"] == "deleted in MLflow, but needed: checkpoint 20 cloned to season/3"
    assert reasons["2"] == "deleted in MLflow, but needed: checkpoint 20 registered as season"


def test_a_run_that_a_training_holds_stays_until_it_is_released(season):
    run = season.run("1", status="failed")
    with (run / ".running").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert listed(season) == []
        assert kept(season) == {"1": "a training is running in it"}
    assert [what for _, what, _ in listed(season)] == [SPARE_CHECKPOINTS, FAILED_TRACE]


@pytest.mark.processes
def test_a_run_without_an_end_stays_for_an_hour_after_its_last_change(season):
    run = season.run("1", status=None)
    assert listed(season) == []
    assert "has not ended" in kept(season)["1"]
    age(run, HOUR_S / 2)
    assert listed(season) == []
    age(run, HOUR_S)
    assert listed(season) == [("1", SPARE_CHECKPOINTS, ["000010"])]
    (run / "metrics.jsonl").write_text("{}\n")
    assert listed(season) == []


def test_if_last_is_corrupt_the_other_checkpoints_are_kept(season):
    run = season.run("1")
    (run / "checkpoints" / "000030" / "agent" / "state.tdz").write_text("?")
    assert listed(season) == []
    assert "may be needed" in kept(season)["1"]
    (run / "checkpoints" / "last").unlink()
    assert listed(season) == []


def test_what_is_no_run_of_ours_is_left_alone(season, tmp_path):
    outside = tmp_path / "outside"
    season.run("1").rename(outside)
    place = season.runs_dir / "season"
    (place / "linked").symlink_to(outside)
    (season.runs_dir / "linked").symlink_to(season.run("2", "elsewhere").parent)
    shutil.move(place.parent / "elsewhere", tmp_path / "elsewhere")
    foreign = season.run("3", status="failed")
    (foreign / "provenance.json").unlink()
    inner = season.run("4", status="failed")
    for name in ("checkpoints", "trace"):
        shutil.rmtree(inner / name)
        (inner / name).symlink_to(outside / name)
    odd = season.run("5")
    shutil.rmtree(odd / "checkpoints" / "000010")
    (odd / "checkpoints" / "000010").symlink_to(outside / "checkpoints" / "000010")
    (odd / "checkpoints" / "notes").mkdir()
    (place / "notes.txt").write_text("mine")
    assert listed(season) == []


def test_apply_removes_what_was_listed_and_nothing_else(season, call):
    season.run("1")
    failed = season.run("2", status="failed")
    gone = ("season/1/checkpoints/000010", "season/2/checkpoints/000010", "season/2/trace")
    spare = [path for path in (failed / "checkpoints" / "000010").rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in spare)
    before = tree(season.runs_dir)
    shown = call("runs", "clean")
    assert shown.code == 0, shown.stderr
    words = " ".join(shown.stdout.split())
    assert "--apply removes it" in words
    assert f"{size} bytes checkpoints neither best nor last: 10" in words
    assert "1.0 kB trace of a failed run season/2" in words
    assert f"{(2 * size + 1000) / 1000:.1f} kB in all" in words
    assert tree(season.runs_dir) == before
    assert call("runs", "clean", "--apply").code == 0
    assert tree(season.runs_dir) == {
        path for path in before if not any(f"{path}/".startswith(f"{part}/") for part in gone)
    }
    assert "nothing to remove" in call("runs", "clean").stdout


def test_what_a_link_inside_leads_to_outlives_it(season, client, call, tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("dear")
    run = season.run("1")
    for place in (run, run / "trace", run / "checkpoints" / "000010"):
        (place / "link").symlink_to(precious)
    client.delete_run(season.recorded(run, client))
    ended = call("runs", "clean", "--apply")
    assert ended.code == 0, ended.stderr
    assert not run.exists()
    assert (precious / "file").read_text() == "dear"


def test_an_unavailable_store_is_reported_and_its_part_skipped(season, client, call, free_port):
    client.delete_run(season.recorded(season.run("1"), client))
    season.run("2")
    ended = call("runs", "clean", "--apply", f"tracking.uri=http://127.0.0.1:{free_port}")
    assert ended.code == 0
    assert "runs deleted there, and checkpoints of runs recorded there, are left out" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    spare = [(season.runs_dir / "season" / name / "checkpoints" / "000010").exists() for name in "12"]
    assert spare == [True, False]


def test_a_training_or_a_pin_that_came_after_the_survey_is_heeded(season):
    runs = [season.run(name) for name in ("1", "2")]
    first, second = survey(season.runs_dir, None).removable
    pin(runs[0] / "checkpoints", "000010", "cloned into season")
    assert not remove(first)
    with (runs[1] / ".running").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert not remove(second)
    assert all((run / "checkpoints" / "000010").is_dir() for run in runs)
    assert remove(second)
    assert not (runs[1] / ".running").exists()


@pytest.mark.parametrize(
    "name", ["lineage.json", "checkpoints/pinned.json", "tracking.json", "mlflow.json", "summary.json"]
)
def test_where_a_file_cannot_be_read_nothing_is_removed(season, call, name):
    season.run("1")
    (season.run("2") / name).write_text("{")
    before = tree(season.runs_dir)
    call("runs", "clean", "--apply").assert_refused(name)
    assert tree(season.runs_dir) == before
