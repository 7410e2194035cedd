"""Runs and checkpoints read back, by function and by command."""

import io
import json
import re
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from rich.console import Console

from deepracer_exp.config.stored import request_evaluation
from deepracer_exp.evaluation.plan import plan_evaluation
from deepracer_exp.evaluation.results import Evaluation
from deepracer_exp.evaluation.run_evaluation import results_table
from deepracer_exp.runs.checkpoints import read_checkpoint
from deepracer_exp.tracking.resolve import resolve
from tests.conftest import refused

from .test_result import attempt, group


@pytest.fixture
def read(tmp_path):
    def go(run: object, checkpoint: str = "best"):
        stored = resolve(str(run), tmp_path / "runs", None)
        return read_checkpoint(stored.experiment, stored.checkpoints, checkpoint)

    return go


def weights(stored) -> torch.Tensor:
    return torch.cat([value.flatten() for value in stored.networks.state_dict().values()])


def test_a_run_is_found_by_folder_name_beginning_and_path_under_runs_dir(run_dir, read):
    name = run_dir.name
    found = [read(run) for run in (run_dir, name, f"tiny/{name}", name[:11])]
    assert all(torch.equal(weights(found[0]), weights(stored)) for stored in found)
    assert found[0].counters["env_steps"] > 0


def test_best_last_and_the_number_lead_to_checkpoints(run_dir, read):
    last = read(run_dir, "last")
    again = read(run_dir, last.path.name)
    short = read(run_dir, last.path.name.lstrip("0"))
    assert last.path == again.path == short.path
    assert torch.equal(weights(last), weights(again))


def test_a_beginning_that_several_runs_have_is_refused(run_dir, read):
    shutil.copytree(run_dir, run_dir.with_name(f"{run_dir.name}-2"), symlinks=True)
    assert "ambiguous: 2 runs match" in refused(read, run_dir.name[:8])
    assert read(run_dir.name).path.parents[1] == run_dir


def test_a_missing_run_is_answered_with_the_nearest(run_dir, read):
    assert run_dir.name in refused(read, run_dir.name.replace("seed0", "seed1"))
    assert "mlflow.db" in refused(read, "0" * 32)


def test_a_missing_checkpoint_is_answered_with_those_that_are_there(run_dir, read):
    assert "best, last" in refused(read, run_dir, "77")


def change_config(run_dir: Path, group: str, **values: object) -> None:
    file = run_dir / "config.yaml"
    mapping = yaml.safe_load(file.read_text())
    mapping[group] |= values
    file.write_text(yaml.safe_dump(mapping))


def test_a_checkpoint_of_another_network_is_refused(run_dir, read):
    change_config(run_dir, "network", hidden=[32])
    assert "does not fit" in refused(read, run_dir)


def test_an_unknown_key_in_a_run_s_configuration_is_refused(run_dir, read):
    change_config(run_dir, "network", wings=2)
    assert "config.yaml: network.wings: no such key" in refused(read, run_dir)


@pytest.mark.parametrize("text", ["", "- a", "a: [", "\x00"])
def test_a_configuration_that_is_none_is_refused(run_dir, read, text):
    (run_dir / "config.yaml").write_text(text)
    assert "config.yaml" in refused(read, run_dir)


def test_evaluate_prints_a_table_and_writes_a_file(run_dir, call):
    ended = call("evaluate", run_dir.name, "evaluation.trials=2", "evaluation.held_out=aws")
    assert ended.code == 0, ended.stderr
    assert re.search(r"reinvent_base +usual +\d of 2", ended.stdout)
    assert re.search(r"reinvent_base +held out +\d of 2", ended.stdout)
    (file,) = (run_dir / "evaluations").iterdir()
    assert str(file.relative_to(run_dir)) in ended.stdout
    found = json.loads(file.read_text())
    assert found["checkpoint"]["env_steps"] > 0
    assert found["evaluation"]["trials"] == 2
    assert [group["condition"] for group in found["groups"]] == ["usual", "held_out"]
    assert all(len(group["attempts"]) == 2 for group in found["groups"])
    low, high = found["groups"][0]["completion"]["interval"]
    assert low <= found["groups"][0]["completion"]["mean"] <= high


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("evaluate",), ("RUN: missing",)),
        (("evaluate", "nowhere"), ("nowhere: no such run",)),
        (
            ("evaluate", "x", "tracking=off"),
            ("tracking: no such group for evaluate", "accepted: tracking.uri"),
        ),
        (("evaluate", "x", "track=Oval_track"), ("track: no such key", "evaluate --cfg")),
        (("checkpoints", "evaluation=summit"), ("RUN: missing",)),
        (("checkpoints", "one", "two"), ("one two: 2 runs given",)),
        (("checkpoints", "x", "checkpoint=best"), ("checkpoint=best", "evaluate")),
        (("checkpoints", "x", "-o", "nowhere/picture.html"), ("--output nowhere/picture.html",)),
        (("checkpoints", "x", "-o", "picture.txt"), ("--output picture.txt",)),
    ],
)
def test_bad_input_is_one_line(call, arguments, words):
    call(*arguments).assert_refused(*words)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("evaluation.trails=2", ("evaluation.trails", "trials")),
        ("evaluation.trials=0", ("evaluation.trials=0",)),
        ("evaluation.tracks=Ovale", ("evaluation.tracks", "Oval_track")),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "checkpoints"])
def test_a_bad_value_of_the_run_s_protocol_is_one_line(run_dir, call, command, override, words):
    call(command, run_dir.name, override).assert_refused(*words)


def test_a_run_is_evaluated_as_its_training_did_unless_a_protocol_is_named(run_dir):
    change_config(run_dir, "evaluation", trials=5, time_s=7.5)
    store = f"runs_dir={run_dir.parents[1]}"
    trained = resolve(str(run_dir), run_dir.parents[1], None).experiment.evaluation
    assert plan_evaluation(str(run_dir), request_evaluation([store])).config.evaluation == trained
    changed = plan_evaluation(
        str(run_dir), request_evaluation([store, "evaluation.seed=3"])
    ).config.evaluation
    assert (changed.trials, changed.time_s, changed.seed) == (5, 7.5, 3)
    named = plan_evaluation(
        str(run_dir), request_evaluation([store, "evaluation=three_trials", "evaluation.seed=3"])
    )
    assert (named.config.evaluation.trials, named.config.evaluation.seed) == (3, 3)


def test_evaluate_repeats_the_figures_of_the_training_s_last_screen(run_dir, call):
    summary = json.loads((run_dir / "summary.json").read_text())["best"]
    ended = call("evaluate", run_dir.name)
    assert ended.code == 0, ended.stderr
    (file,) = (run_dir / "evaluations").iterdir()
    usual, _ = json.loads(file.read_text())["groups"]
    assert len(usual["attempts"]) == summary["eval_laps_tried"]
    assert usual["completion"]["mean"] == pytest.approx(summary["eval_completion"])


def test_a_video_needs_a_library_to_draw_with(run_dir, call, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setattr("sys.platform", "linux")
    call("evaluate", str(run_dir), "--video", "lap.mp4").assert_refused("EGL nor OSMesa")


@pytest.mark.parametrize(
    ("width", "median", "intervals"), [(200, True, True), (90, False, True), (60, False, False)]
)
def test_a_narrow_table_leaves_out_columns_but_cuts_no_figure(protocol, width, median, intervals):
    laps = (attempt(at, 10.25 + at, resets=at) for at in range(3))
    evaluation = Evaluation((group(*laps, track="reinvent_base"),))
    console = Console(width=width, file=io.StringIO())
    console.print(results_table(evaluation, protocol("summit"), ["reinvent_base"], console))
    text = console.file.getvalue()
    assert "11.25" in text
    assert ("median" in text, "(10.25" in text) == (median, intervals)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
