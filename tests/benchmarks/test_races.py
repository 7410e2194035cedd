"""The benchmark of races among others trains what it says and holds the laps against the boards' winners."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import races
from deepracer_exp.config.evaluation import EvaluationConfig
from tests.conftest import Ended


def test_each_seed_of_each_board_is_trained_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def train(folder: Path, overrides: list[str]) -> Path:
        asked.append((folder.name, overrides[-1]))
        return folder

    def measured(run: Path, board: races.Board) -> dict[str, float | None]:
        seed = int(run.name[-1])
        return {**dict.fromkeys(races.FIGURES, 1.0), "lap_s": [8.0, None, 9.0][seed], "crash_free": 0.5}

    monkeypatch.setattr(races, "trained", train)
    monkeypatch.setattr(races, "measure", measured)
    file = tmp_path / "races.json"
    words = ["--seeds", "3", "--tracks", "reInvent2019_track", "--cars", "own", "--jobs", "1"]
    assert races.main([*words, "--runs-dir", str(tmp_path), "--json", str(file)]) == 0
    assert asked == [
        (f"reInvent2019_track-{experiment}-own-{seed}", f"seed={seed}")
        for experiment in ("object_avoidance", "head_to_bot")
        for seed in range(3)
    ]
    boxes, bots = json.loads(file.read_text())["races"]
    assert (boxes["winner_s"], bots["winner_s"]) == (9.044, 8.33)
    assert boxes["lap_s"]["seeds"] == [8.0, None, 9.0]
    assert boxes["crash_free"]["iqm"] == 0.5
    assert "head_to_bot, reInvent2019_track, deepracer_v6" in capsys.readouterr().out


def test_a_board_with_boxes_is_raced_among_its_own_and_among_those_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trained: Callable[..., Ended]
) -> None:
    run = trained("race=six_boxes", "reward=avoid_objects", "observation.next_objects=2").folder
    boxes = next(board for board in races.BOARDS if board.race == "six_boxes")
    asked = []

    def short(board: races.Board, race: str) -> EvaluationConfig:
        asked.append(races_of(board, race))
        return replace(asked[-1], time_s=4, trials=3)

    races_of = races.board_protocol
    monkeypatch.setattr(races, "board_protocol", short)
    found = races.measure(run, boxes)
    assert [config.race for config in asked] == ["six_boxes", "object_avoidance"]
    assert {(config.laps, config.penalty_s.crashed, config.penalty_s.off_track) for config in asked} == {
        (3, 5, 5)
    }
    assert set(found) == {*races.FIGURES, *races.ELSEWHERE}
    assert (found["crash_free"], found["lap_s"]) == (0.0, None)
