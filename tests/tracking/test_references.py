"""What a run may be called by."""

import json
import shutil

import pytest

from deepracer_exp.tracking.resolve import resolve
from deepracer_exp.tracking.store import is_run_id
from tests.conftest import refused


def refusal(run, season) -> str:
    return refused(resolve, run, season.runs_dir, None)


def best(season):
    return resolve("best:season", season.runs_dir, None).path.name


@pytest.mark.parametrize(
    ("results", "wanted"),
    [
        ([{"rank": (1, -11.0)}, {"rank": (1, -9.5)}, {"rank": (0, 99.0)}], "2"),
        # An evaluated run is better than one that was not.
        ([{"rank": (0, 50.0)}, {"lap_share": 1.0, "best_lap_time_s": 8.0}], "1"),
        # Without evaluations the share of laps counts before the fastest lap.
        (
            [
                {"lap_share": share, "best_lap_time_s": lap_s}
                for share, lap_s in ((0.9, 12.0), (0.9, 10.0), (0.5, 8.0), (None, 7.0))
            ],
            "2",
        ),
        # Of equals the newest is taken.
        ([{"rank": (1, -10.0)}, {"rank": (1, -10.0)}], "2"),
    ],
)
def test_the_best_of_an_experiment_is_its_run_of_the_highest_rank(season, results, wanted):
    for number, result in enumerate(results, 1):
        season.result(season.run(str(number)), **result)
    season.result(season.run("other", "elsewhere"), (1, -5.0))
    assert best(season) == wanted


@pytest.mark.parametrize(
    ("config", "metric", "words"),
    [
        ({"track": {"name": "bowtie"}}, "lap_time", "track is oval in 1 and bowtie in 2"),
        ({"track": {"name": "oval", "knots": [3]}}, "lap_time", "track.knots is [1, 2] in 1 and [3] in 2"),
        ({"car": {"name": "ideal"}}, "lap_time", "car is deepracer in 1 and ideal in 2"),
        ({"evaluation": {"trials": 1, "tracks": None}}, "lap_time", "evaluation is"),
        ({"race": {"boxes": {"number": 6}}}, "lap_time", "race is null in 1"),
        ({}, "progress", "what they are ranked by is lap_time in 1 and progress in 2"),
    ],
)
def test_runs_whose_ranks_mean_different_things_are_refused_by_name(season, config, metric, words):
    season.result(season.run("1"), (1, -10.0))
    season.result(season.run("2", **config), (1, -5.0), metric=metric)
    assert words in refusal("best:season", season)


@pytest.mark.parametrize("below", [".", "checkpoints"])
def test_a_run_named_from_its_own_folders_lies_in_its_experiment(season, monkeypatch, below):
    run = season.run("1")
    (run / below).mkdir(exist_ok=True)
    for place, name in ((run.parent, "1"), (run / below, "." if below == "." else "..")):
        monkeypatch.chdir(place)
        found = resolve(name, season.runs_dir, None).path
        assert found.parent.parent.resolve() == season.runs_dir.resolve()


def test_runs_trained_on_different_tracks_compare_when_evaluated_on_the_same(season):
    evaluation = {"trials": 8, "tracks": ["oval"]}
    season.result(season.run("1", evaluation=evaluation), (1, -10.0))
    season.result(season.run("2", evaluation=evaluation, track={"name": "bowtie"}), (1, -9.0))
    assert best(season) == "2"


def test_a_run_without_a_best_checkpoint_is_out(season):
    season.result(season.run("1"), (1, -10.0))
    gone = season.run("2")
    season.result(gone, (1, -5.0))
    shutil.rmtree(gone / "checkpoints" / "000020")
    season.run("3", status=None)
    assert best(season) == "1"


@pytest.mark.parametrize("name", ["", "..", "../season", "season/1", "/tmp", "a" * 81])
def test_an_experiment_is_a_name_and_no_path(season, name):
    season.result(season.run("1"), (1, -10.0))
    assert "a name has letters" in refusal(f"best:{name}", season)


def test_what_there_is_no_best_of_is_refused(season):
    season.run("1")
    season.run("2")
    assert "(did you mean season?)" in refusal("best:seeson", season)
    assert "none of its 2 runs has a result" in refusal("best:season", season)


def test_a_single_run_with_a_checkpoint_needs_no_result(season):
    run = season.run("1")  # as of an imported model
    assert best(season) == "1"
    (run / "checkpoints" / "best").unlink()
    assert "none of its 1 runs has a result" in refusal("best:season", season)


@pytest.mark.parametrize("text", ["[]", "{", '{"best": 3}', '{"best": {"metric": "x", "rank": [1]}}'])
def test_a_summary_that_is_none_is_named(season, text):
    (season.run("1") / "summary.json").write_text(text)
    assert "1/summary.json" in refusal("best:season", season)


def test_an_alias_leads_to_run_and_checkpoint(season, client):
    run = season.champion(client, "10")
    for given in ("champion", "season@champion"):
        found = resolve(given, season.runs_dir, None)
        assert (found.path, found.checkpoint, found.registered) == (run, "000010", "season@champion")
    assert resolve("1", season.runs_dir, None).checkpoint is None


def test_a_runs_name_goes_before_an_alias(season, client):
    run = season.champion(client)
    named = season.run("champion-of-all")
    assert resolve("champion", season.runs_dir, None).path == named
    assert resolve("season@champion", season.runs_dir, None).path == run


def test_the_folder_of_a_registered_run_may_move_with_all_runs(season, client, tmp_path):
    season.champion(client)
    moved = tmp_path / "moved"
    season.runs_dir.rename(moved)
    assert resolve("champion", moved, None).path == moved / "season" / "1"


@pytest.mark.usefixtures("downloads_here")
def test_a_checkpoint_that_is_not_the_registered_one_is_refused(season, client):
    run = season.champion(client)
    checkpoint = run / "checkpoints" / "000020"
    file = checkpoint / "agent" / "state.tdz"
    file.write_text("other weights")
    assert "corrupt" in refusal("champion", season)
    hashes = json.loads((checkpoint / "hashes.json").read_text())
    (checkpoint / "hashes.json").unlink()
    assert "corrupt" in refusal("champion", season)
    shutil.rmtree(checkpoint)
    assert resolve("champion", season.runs_dir, None).path == run  # downloaded again
    assert json.loads((checkpoint / "hashes.json").read_text()) == hashes
    assert resolve("champion", season.runs_dir, None).checkpoint == "000020"
    shutil.rmtree(checkpoint)
    season.checkpoint(season.runs_dir / "season" / "2", 20).rename(checkpoint)
    assert "is not the checkpoint that was registered as season@champion" in refusal("champion", season)


UNKNOWN = {
    "chmpion": "(did you mean season@champion?)",
    "season@rain": "no registered model has this alias",
    "other@champion": "no registered model has this alias",
    "season@latest": "'latest' is not an alias",
    "season@v2": "'v2' is not an alias",
    "season@": "'' is not an alias",
    "@champion": "'' is not a model name",
    "..@champion": "'..' is not a model name",
    "a@b@champion": "'a@b' is not a model name",
    "2026": "no such run",
    "../champion": "no such run",
}


def test_what_no_model_is_called_by_is_refused(season, client):
    season.champion(client)
    for reference, words in UNKNOWN.items():
        assert words in refusal(reference, season), reference


def test_a_bare_alias_of_two_models_is_refused(season, client):
    season.promote(season.champion(client), model="spring")
    client.set_registered_model_alias("spring", "rain", "1")
    assert "2 models have this alias: season@champion, spring@champion; give" in refusal("champion", season)
    assert resolve("spring@champion", season.runs_dir, None).registered == "spring@champion"


def test_a_model_that_others_registered_is_refused(season, client):
    client.create_registered_model("theirs")
    client.create_model_version("theirs", "file:///somewhere", tags={"run_dir": "/", "checkpoint": "../.."})
    client.set_registered_model_alias("theirs", "champion", "1")
    assert "was not registered by deepracer-exp runs promote" in refusal("champion", season)


def test_without_a_store_a_word_is_no_alias(season):
    season.run("1")
    assert "no such run" in refusal("champion", season)
    assert "mlflow.db" in refusal("season@champion", season)
    assert not (season.runs_dir / "mlflow.db").exists()


def test_an_id_leads_to_the_folder_until_the_run_is_deleted(season, client, tmp_path):
    run = season.run("one")
    run_id, foreign = season.recorded(run, client), client.create_run("0").info.run_id
    assert is_run_id(run_id)
    assert resolve(run_id, season.runs_dir, None).path == run
    client.delete_run(run_id)
    (tmp_path / "empty").mkdir()
    for given, runs_dir, words in (
        (run_id, season.runs_dir, "was deleted in MLflow"),
        ("0" * 32, season.runs_dir, f"Run with id={'0' * 32} not found"),
        (foreign, season.runs_dir, "not a run of deepracer-exp"),
        (run_id, tmp_path / "empty", "no mlflow.db"),
    ):
        assert words in refused(resolve, given, runs_dir, None)
    assert not list((tmp_path / "empty").iterdir())
