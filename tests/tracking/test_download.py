"""A promoted model where the folder of its run is not."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from deepracer_exp.errors import BadInput
from deepracer_exp.runs.checkpoint_files import verify
from deepracer_exp.tracking.calls import StoreRefusedError
from deepracer_exp.tracking.download import Download, download
from deepracer_exp.tracking.registry import look_up
from deepracer_exp.tracking.resolve import resolve
from deepracer_exp.tracking.store import Store, resolve_store
from tests.conftest import refused


@pytest.fixture
def away(season, client) -> Path:
    """The folder of a promoted run, which is gone; MLflow has its files."""
    run = season.champion(client)
    run_id = json.loads((run / "mlflow.json").read_text())["run_id"]
    for name in ("config.yaml", "overrides.yaml", "provenance.json", "summary.json"):
        client.log_artifact(run_id, str(run / name))
    shutil.rmtree(run)
    return run


def files_of(client) -> Path:
    """Return the folder of the registered checkpoint in MLflow."""
    version = client.get_model_version_by_alias("season", "champion")
    logged = client.get_logged_model(version.source.removeprefix("models:/"))
    return Path(logged.artifact_location.removeprefix("file://")) / "checkpoint"


@pytest.mark.processes
def test_a_promoted_model_is_downloaded_whole_once_and_as_it_was_registered(away, season, client):
    found = resolve("season@champion", season.runs_dir, None)
    assert (found.path, found.checkpoint) == (away, "000020")
    verify(away / "checkpoints" / "000020")
    assert {file.name for file in away.iterdir()} == {
        *("config.yaml", "overrides.yaml", "provenance.json", "summary.json", "checkpoints")
    }
    shutil.rmtree(files_of(client))  # it is not asked for again
    assert resolve("champion", season.runs_dir, None) == found
    assert [path.name for path in away.parent.iterdir()] == [away.name]


@pytest.mark.usefixtures("downloads_here")
def test_a_checkpoint_that_is_gone_from_its_run_is_downloaded_alone(season, client, away):
    run = season.run("1")
    shutil.rmtree(run / "checkpoints" / "000020")
    (run / "config.yaml").write_text("own: true\n")
    assert resolve("champion", season.runs_dir, None).path == run
    verify(run / "checkpoints" / "000020")
    assert (run / "config.yaml").read_text() == "own: true\n"


def test_a_checkpoint_is_not_downloaded_into_another_run_of_the_same_name(season, away):
    other = season.run("1")
    shutil.rmtree(other / "checkpoints" / "000020")
    (other / "tracking.json").write_text(json.dumps({"run_id": "0" * 32}))
    assert f"{other} is another run" in refused(resolve, "champion", season.runs_dir, None)
    assert not (other / "checkpoints" / "000020").exists()


@pytest.mark.usefixtures("downloads_here")
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (lambda at: (at / "agent" / "state.tdz").write_text("other"), "state.tdz is not as it was written"),
        (lambda at: (at / "hashes.json").write_text("{}"), "names 0 files"),
        (lambda at: (at / "hashes.json").write_text('{"../../../evil": "0"}'), "'../../../evil'"),
        (lambda at: (at / "hashes.json").write_text('{"/etc/passwd": "0"}'), "'/etc/passwd'"),
        (lambda at: (at / "hashes.json").write_text("[" * 9), "JSON"),
        (lambda at: (at / "manifest.json").unlink(), "manifest.json"),
    ],
)
def test_files_that_are_not_the_registered_ones_are_refused_and_leave_nothing(
    away, season, client, harm, words
):
    harm(files_of(client))
    message = refused(resolve, "champion", season.runs_dir, None)
    assert words in message
    assert len(message) < 500
    assert not list(away.parent.iterdir())


@pytest.mark.usefixtures("downloads_here")
def test_a_registry_of_gigabytes_fills_no_disk(away, season, client, tmp_path):
    with (files_of(client) / "agent" / "state.tdz").open("wb") as file:
        file.truncate(10**8)
    store, found = resolve_store(None, season.runs_dir), look_up("champion", None, season.runs_dir)
    wanted = Download(store.uri, found.model_id, found.run_id, found.checkpoint, found.sha256, True, 10**6)
    with pytest.raises(BadInput, match="more than 1,000,000 bytes"):
        download("champion", wanted, store, tmp_path / "runs" / "season" / "1")
    assert not list(away.parent.iterdir())


SERVER, FILE = Store("http://127.0.0.1:5000", None), Store("sqlite:////x/mlflow.db", None)


@pytest.mark.parametrize(
    ("store", "place"),
    [
        *(
            (SERVER, f"{scheme}://other/x")
            for scheme in ("http", "mlflow-artifacts", "ftp", "s3", "gs", "sftp")
        ),
        *((SERVER, place) for place in ("file:///etc", "/etc", "dbfs:/x", "http://127.0.0.1:5000@other/x")),
        *((FILE, place) for place in ("s3://other/x", "http://other/x", "file://other/x")),
    ],
)
def test_files_are_neither_read_from_nor_sent_to_where_a_store_must_not_have_them(store, place):
    with pytest.raises(StoreRefusedError, match="keeps the files at "):
        store.files_at(place)


@pytest.mark.parametrize(
    ("store", "place"),
    [
        *((SERVER, place) for place in ("mlflow-artifacts:/1/x", "http://127.0.0.1:5000/api/x")),
        *((FILE, place) for place in ("file:///runs/x", "/runs/x")),
    ],
)
def test_a_server_has_the_files_itself_and_a_database_has_them_in_a_folder(store, place):
    store.files_at(place)


@pytest.mark.usefixtures("downloads_here")
def test_what_killed_downloads_have_left_is_removed_by_the_next_one(away, season, client):
    left = away.parent / ".download-left"
    left.mkdir(parents=True)
    resolve("champion", season.runs_dir, None)
    assert [path.name for path in away.parent.iterdir()] == [away.name]


def test_a_name_from_the_registry_becomes_no_path_out_of_runs_dir(away, season, monkeypatch):
    found = look_up("champion", None, season.runs_dir)
    for run_dir in ("/x/../..", "/x/.ssh/run", "/x/season/a b"):
        odd = replace(found, run_dir=Path(run_dir))
        monkeypatch.setattr("deepracer_exp.tracking.resolve.look_up", lambda *_, odd=odd: odd)
        assert "is not the name of a run" in refused(resolve, "champion", season.runs_dir, None)


@pytest.mark.slow
def test_a_champion_trained_elsewhere_is_raced_and_cloned_here(server, call_at, tmp_path):
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    store = f"tracking.uri={server.uri}"
    tiny = ("experiment=tiny", "collector=in_process", "collector.threads=1")
    trained = call_at(there, "train", *tiny, store)
    assert trained.code == 0, trained.stderr
    assert call_at(there, "runs", "promote", trained.folder.name, store).code == 0
    name = trained.folder.name
    shutil.rmtree(there)
    raced = call_at(
        here, "evaluate", "tiny@champion", store, "evaluation.trials=1", "evaluation.held_out=null"
    )
    assert raced.code == 0, raced.stderr
    assert raced.folder.name == name
    cloned = call_at(here, "clone", "tiny@champion", store, "collector=in_process", "budget.iterations=1")
    assert cloned.code == 0, cloned.stderr
