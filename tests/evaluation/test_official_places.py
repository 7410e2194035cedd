"""The place on official boards in `evaluate` and in the report of a training."""

import dataclasses
import json

import pytest

from deepracer_exp.config.compose import compose_experiment
from deepracer_exp.evaluation.results import HELD_OUT, USUAL, Evaluation, TrialGroup
from deepracer_exp.evaluation.run_evaluation import official_places
from deepracer_exp.runs.next_steps import official_place
from deepracer_exp.runs.run_files import RunRecord
from deepracer_exp.tracks import boards
from tests.page_html import Html

from .test_result import attempt

LAPS = ("track=Straight_track", "action_space=deepracer", "reward=speed_on_track", "budget.env_steps=16384")


def driven(track: str, *times_s: float, condition: str = USUAL) -> TrialGroup:
    laps = [attempt(trial, time_s=time_s) for trial, time_s in enumerate(times_s)]
    return TrialGroup(track, condition, tuple(range(len(times_s))), tuple(laps))


def places(*groups: TrialGroup, overrides: tuple[str, ...] = (), **protocol: object) -> dict:
    experiment, _ = compose_experiment([f"track={groups[0].track}", *overrides])
    config = dataclasses.replace(experiment.evaluation, **protocol)
    return official_places(experiment, config, Evaluation(groups))


def test_the_usual_laps_have_the_place():
    found = places(driven("Albert", 14.0, 16.0), driven("Albert", 40.0, condition=HELD_OUT))
    new, old = sorted(found["Albert"], key=lambda one: one.board.date, reverse=True)
    assert (new.lap_s, old.lap_s) == (14.0, 15.0)
    assert new.sees == "features"


def test_a_track_without_a_board_driven_the_other_way_or_by_the_real_car_has_none():
    assert places(driven("reinvent_base", 10.0)) == {}
    assert places(driven("Albert", 14.0), overrides=("track.direction=reversed",)) == {}
    both = places(
        driven("Albert", 14.0), driven("Albert reversed", 14.0), overrides=("track.direction=alternate",)
    )
    assert list(both) == ["Albert"]
    assert places(driven("Albert")) == {}
    real = compose_experiment(["evaluation=real_car"])[0].evaluation.real_car
    assert places(driven("Albert", 14.0), real_car=real) == {}


def test_a_camera_and_the_car_are_named():
    (one, _) = places(
        driven("Albert", 14.0), overrides=("observation=camera", "car=deepracer_v4", "network=cnn_small")
    )["Albert"]
    assert (
        "driven with deepracer_v4 from a camera, the board's racers with simulation version 3 from a camera"
        in (one.words)
    )


@pytest.fixture
def board_of_the_straight(monkeypatch) -> boards.Board:
    (april,) = boards.boards_of("2022_april_open")
    board = dataclasses.replace(april, world="Straight_track", board="Drag Race", winner_s=0.5)
    monkeypatch.setattr(boards, "boards_of", lambda world: (board,) if world == board.world else ())
    return board


def test_evaluate_prints_and_stores_the_place(copied, call, board_of_the_straight):
    run = copied(*LAPS)
    ended = call("evaluate", str(run), "evaluation.held_out=null")
    assert ended.code == 0, ended.stderr
    (line,) = [line for line in ended.stdout.splitlines() if line.startswith("Drag Race (1,728 racers")]
    (file,) = (run / "evaluations").glob("*.json")
    (stored,) = json.loads(file.read_text())["boards"]["Straight_track"]
    assert line.startswith(stored["words"])
    assert f"{stored['lap_s']:.2f} s a lap would " in line


def test_the_report_of_a_training_names_the_place(copied, call, board_of_the_straight):
    run = copied(*LAPS)
    assert call("analyze", str(run)).code == 0
    assert (
        "On the official board: Drag Race (1,728 racers, total of 3 laps): "
        in Html((run / "report.html").read_text()).text
    )


def test_a_run_of_several_tracks_among_others_of_the_real_car_or_without_a_lap_has_no_place(tmp_path):
    best = {"metric": "race_score", "rank": [1.0, -14.0], "iteration": 3, "eval_completion": 100.0}
    (tmp_path / "summary.json").write_text(json.dumps({"best": best | {"eval_lap_time_s": 14.0}}))
    albert = {"name": "Albert", "direction": "forward", "file": None, "knots": None}

    def place(track: dict, rivals: dict | None = None, **protocol: object) -> str | None:
        config = {"track": track, "race": {"rivals": rivals}, "evaluation": protocol}
        return official_place(RunRecord(tmp_path, config, [], {}, {}))

    assert "May 2024 Qualifier" in (place(albert) or "")
    assert place({"A": albert}) is None
    assert place(albert, rivals={"policy": None}) is None
    assert place(albert, race="head_to_head") is None
    assert place(albert, real_car={"picture": None, "timing": None, "controls": None}) is None
    assert place(albert | {"direction": "reversed"}) is None
    assert place(albert | {"file": "mine.npy"}) is None
    (tmp_path / "summary.json").write_text(json.dumps({"best": best | {"eval_lap_time_s": None}}))
    assert place(albert) is None
