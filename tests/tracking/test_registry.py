"""Promotion into a real registry of models."""

import json
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.models import Model

from deepracer_exp.runs.checkpoint_files import checkpoint_sha256, pinned
from deepracer_exp.tracking.registry import look_up

from .conftest import FEATURES


def model_id(version) -> str:
    return version.source.removeprefix("models:/")


def check_promotion(season, client, uri):
    run = season.run("1")
    run_id = season.recorded(run, client)
    first = season.promote(run, uri=uri)
    version = client.get_model_version_by_alias("season", "champion")
    assert version.run_id == run_id
    assert version.tags == {
        "run_dir": str(run),
        "checkpoint": "000020",
        "sha256": checkpoint_sha256(run / "checkpoints" / "000020"),
    }
    kept = {file.path for file in client.list_logged_model_artifacts(model_id(version), "checkpoint/agent")}
    assert kept == {"checkpoint/agent/state.tdz"}
    assert pinned(run / "checkpoints") == {"000020": ["registered as season"]}
    assert season.promote(run, "20", uri=uri) == first
    second = season.promote(run, "last", uri=uri)
    assert int(second.version) > int(first.version)
    for reference in ("season@champion", "champion"):
        assert look_up(reference, uri, season.runs_dir) == second
    assert len(client.search_model_versions("name = 'season'")) == 2


def test_a_promoted_checkpoint_is_registered_kept_and_found_by_its_alias(season, client):
    check_promotion(season, client, None)


def test_a_run_is_promoted_whatever_its_folder_is_called(season, client):
    run = season.run("20261101-120000-oval-reward.v2 'fast'-seed0")
    season.recorded(run, client)
    season.promote(run)
    assert look_up("champion", None, season.runs_dir).run_dir == run


@pytest.mark.slow
def test_a_server_takes_promotions_as_well(season, server):
    season.runs_dir.mkdir()
    client = MlflowClient(tracking_uri=server.uri)
    client.create_experiment("season")
    check_promotion(season, client, server.uri)


def test_a_promoted_version_has_metrics_signature_report_and_description(season, client):
    run = season.run("1")
    run_id = season.recorded(run, client)
    rows = [{"iteration": n, "env_steps": 100 * n, "eval_lap_time_s": 9.876543, "kl": 1.0} for n in (10, 20)]
    rows[1] |= {"eval_completion": 98.7654, "eval_race_score_s": 9.5}
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run / "report.html").write_text("<p>what the training reports")
    client.log_metric(run_id, "race/score_s", 9.5, 1234, 2000)
    season.promote(run)
    version = client.get_model_version_by_alias("season", "champion")
    assert version.description.startswith(
        "Checkpoint 20 of `season/1`: mean usual lap 9.88 s, 98.8% of the lap, race score (usual) 9.50 s."
    )
    logged = client.get_logged_model(model_id(version))
    metrics = {metric.key: metric.value for metric in logged.metrics}
    assert metrics == {"race/lap_time_s": 9.876543, "race/completion": 98.7654, "race/score_s": 9.5}
    assert len(client.get_metric_history(run_id, "race/score_s")) == 1
    files = Path(logged.artifact_location.removeprefix("file://"))
    assert {file.name for file in files.iterdir()} == {"MLmodel", "report.html", "checkpoint"}
    signature = Model.load(str(files / "MLmodel")).signature
    assert signature.inputs.inputs[0].shape == (-1, len(FEATURES))
    assert signature.outputs.inputs[0].shape == (-1, 2)
    assert not [path for path in files.rglob("*") if path.suffix in (".pkl", ".pickle", ".pt", ".pth")]


RECORDED = "mlflow.json"


@pytest.mark.parametrize(
    ("argument", "file", "text", "words"),
    [
        (None, "checkpoints/000020/agent/state.tdz", "?", "corrupt"),
        (None, RECORDED, None, "is not recorded in MLflow"),
        (None, RECORDED, '{"run_id": null}', "is not recorded in MLflow"),
        (None, RECORDED, "[]", "mlflow.json"),
        (None, RECORDED, '{"run_id": 3}', "run_id: 3"),
        (None, RECORDED, json.dumps({"run_id": "0" * 32}), "not found"),
        (None, None, None, "was deleted in MLflow"),
        ("checkpoint=77", None, None, "000077 is not there"),
        ("checkpoint=../x", None, None, "best, last, fastest or the number"),
        ("tracking.uri=ftp://x", None, None, "tracking.uri=ftp://x"),
    ],
)
def test_what_cannot_be_promoted_is_refused_in_one_line(season, client, call, argument, file, text, words):
    run = season.run("1")
    run_id = season.recorded(run, client)
    if file is not None:
        (run / file).unlink()
        if text is not None:
            (run / file).write_text(text)
    elif argument is None:
        client.delete_run(run_id)
    ended = call("runs", "promote", "1", *filter(None, [argument]))
    ended.assert_refused(words)
    assert len(ended.stderr.splitlines()) == 1
    assert not client.search_registered_models()
    assert not (run / "checkpoints" / "pinned.json").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        *(
            (("--alias", name), f"{name!r} is not an alias")
            for name in ("latest", "Latest", "v12", "", "a b", "champion\n")
        ),
        *((("--model", name), f"{name!r} is not a model name") for name in ("a/b", "", "a:b")),
    ],
)
def test_a_name_that_cannot_be_is_refused_before_anything_is_asked(call, arguments, words):
    ended = call("runs", "promote", "nowhere", *arguments)
    ended.assert_refused(words)
    assert len(ended.stderr.splitlines()) == 1


def test_a_server_that_does_not_answer_is_one_line_without_its_password(season, client, call, free_port):
    season.recorded(season.run("1"), client)
    ended = call("runs", "promote", "1", f"tracking.uri=http://me:s3cr3t@127.0.0.1:{free_port}")
    ended.assert_refused(f"http://127.0.0.1:{free_port}")
    assert "s3cr3t" not in ended.stderr


def test_the_command_names_the_experiment_s_model_and_says_what_to_do_next(season, client, call):
    run = season.run("1")
    season.recorded(run, client)
    ended = call("runs", "promote", "1")
    assert ended.code == 0, ended.stderr
    assert ended.stdout.splitlines()[0] == "season@champion: version 1"
    assert "deepracer-exp evaluate season@champion" in ended.stdout
    assert ended.stderr == ""
    again = call("runs", "promote", "champion", "--alias", "rain")
    assert again.code == 0, again.stderr
    assert client.get_model_version_by_alias("season", "rain").version == 1
