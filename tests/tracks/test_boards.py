"""Official leaderboards, and where a lap would stand on them."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.aws.worlds.routes import world_rows
from deepracer_exp.config.custom_files.model_files import CARS
from deepracer_exp.config.options import options
from deepracer_exp.tracks import boards
from deepracer_exp.tracks.boards import Board, boards_of, standings, what_it_sees

ALL = [
    board for world in dict.fromkeys(board.world for board in boards.boards()) for board in boards_of(world)
]


def stand(world: str, lap_s: float, **changes: object) -> list[boards.Standing]:
    given = {"best_lap_s": lap_s, "car": "deepracer_v5", "sees": "features", "off_track_penalty_s": None}
    return standings(world, **{"mean_lap_s": lap_s, **given, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("board", ALL, ids=lambda board: f"{board.world} {board.date}")
def test_a_board_is_one_of_a_world_and_of_the_time_of_four_metres_per_second(board: Board):
    name = board.world if board.world in worlds() else f"{board.world}_ccw"
    assert boards_of(name) == boards_of(board.world)
    center = world_rows(name)[:, :2]
    length_m = np.linalg.norm(np.diff(center, axis=0), axis=1).sum()
    assert 1.0 < length_m / board.record_s < 4.0
    times = [board.record_s, board.winner_s]
    times += [board.first_1_percent_s, board.first_10_percent_s, board.half_s]
    assert times == sorted(times)
    assert board.date >= "2020-03"
    assert board.car in options("car")


def test_there_are_sixty_boards_and_none_of_a_track_driven_the_other_way():
    assert len(ALL) == len(boards.boards()) == 60
    assert boards_of("reInvent2019_track_ccw") == boards_of("reInvent2019_track")
    assert boards_of("reInvent2019_track_cw") == boards_of("reinvent_base") == ()


@pytest.mark.parametrize(
    ("date", "car", "is_of_version_3"),
    [
        ("2020-03-02", "deepracer_v4", True),
        ("2020-09-01", "deepracer_v4", True),
        ("2020-10-01", "deepracer_v4", False),
        ("2022-07-01", "deepracer_v4", False),
        ("2022-08-01", "deepracer_v5", False),
        ("2025-01-07", "deepracer_v5", False),
    ],
)
def test_the_car_of_a_board_is_that_of_its_time_and_version_4_stands_in_for_version_3(
    date, car, is_of_version_3
):
    board = next(board for board in ALL if board.date == date)
    assert (board.car, board.is_of_version_3) == (car, is_of_version_3)


def test_models_raced_on_a_day_state_the_version_of_the_boards_car(reference):
    """Logs of a leaderboard of 3 July 2022 state version 4; the first known ones of version 5 are of 21 July."""
    june = next(board for board in ALL if board.date == "2022-06-01")
    (log,) = (reference / "console_training/logs/leaderboard").glob(
        "leaderboard-20220703172842-*-robomaker.log"
    )
    for file, day in (
        (log, "2022-07-03"),
        (reference / "race_pace/console_v5_reinvent_base.log.gz", "2022-07-21"),
    ):
        metadata = read_recording(file).metadata
        assert metadata is not None
        assert replace(june, date=day).car == CARS[metadata.version]


def test_a_place_is_said_as_far_as_the_board_says_it():
    (board,) = boards_of("2022_april_open")
    assert board.place(14.0) == "have won (14.80 s won)"
    assert board.place(15.1) == "be among the first 1 % (14.80 s won)"
    assert board.place(20.0) == "be between the first 1 and 10 % (17.64 and 25.22 s)"
    assert board.place(30.0) == "be between the first 10 and 50 % (25.22 and 44.09 s)"
    assert board.place(60.0) == "be in the slower half (44.09 s and more)"


@pytest.mark.parametrize("board", ALL[::7], ids=lambda board: board.world)
def test_a_faster_lap_never_has_a_worse_place(board: Board):
    places = [board.place(lap_s).partition(" (")[0] for lap_s in np.linspace(5.0, 150.0, 2901)]
    assert 4 <= len([place for place, _ in itertools.groupby(places)]) <= 5
    assert len({*places}) == len([place for place, _ in itertools.groupby(places)])


def test_a_sentence_says_who_raced_there_how_and_what_differs():
    (one,) = stand("2022_august_open", 28.0)
    assert one.words == (
        "August Qualifier 2022 (4,197 racers, total of 3 laps): 28.00 s a lap would be among the first 1 % (14.44 s "
        "won); driven with deepracer_v5 from features, the board's racers from a camera; leaving the track cost 3 s "
        "there, here it ends a lap"
    )
    assert one.is_comparable


def test_another_car_is_not_comparable_and_how_to_compare_is_said():
    (one,) = stand("2022_april_open", 15.1, car="deepracer_v5", off_track_penalty_s=3.0)
    assert not one.is_comparable
    assert one.words.endswith(
        "driven with deepracer_v5 from features, the board's racers with deepracer_v4 from a camera; to compare, "
        "train with car=deepracer_v4"
    )


@pytest.mark.parametrize("car", ["deepracer_v4", "deepracer_v6"])
def test_a_board_of_version_3_says_that_another_car_stands_in_for_it(car):
    (one,) = (
        stand("Belille", 20.0, car=car)[-1:] if car == "deepracer_v6" else stand("Belille", 20.0, car=car)[:1]
    )
    assert one.board.date == "2020-09-01"
    assert "the board's racers with simulation version 3 from a camera" in one.words
    assert one.words.endswith("; there is no car of version 3, and deepracer_v4 stands in for it")
    assert ("; to compare, train with car=deepracer_v4" in one.words) == (not one.is_comparable)


@pytest.mark.parametrize("car", ["deepracer_v4", "deepracer_v5"])
def test_boards_of_the_cars_own_time_come_first(car):
    found = stand("Albert", 20.0, car=car)
    assert [one.board.car for one in found] == sorted(
        {"deepracer_v4", "deepracer_v5"}, key=lambda one: one != car
    )
    assert [one.is_comparable for one in found] == [True, False]


def test_where_the_best_lap_counted_it_counts_if_it_is_known():
    new, old = stand("Albert", 16.0, best_lap_s=14.0)
    assert (new.board.timing, new.lap_s, old.board.timing, old.lap_s) == (
        "BEST_LAP_TIME",
        14.0,
        "TOTAL_TIME",
        16.0,
    )
    assert "a best lap of 14.00 s would be among the first 1 %" in new.words
    (mean, _) = stand("Albert", 16.0, best_lap_s=None)
    assert "16.00 s a lap would be between the first 1 and 10 %" in mean.words


def test_a_standing_is_json():
    read = json.loads(json.dumps(stand("Monaco", 20.0)[0].as_dict()))
    assert {"board", "racers", "timing", "record_s", "half_s", "lap_s", "comparable", "words"} <= read.keys()


def test_what_a_policy_sees_is_named():
    assert what_it_sees(None, None) == "features"
    assert what_it_sees({}, None) == "a camera"
    assert what_it_sees({}, {}) == "a camera and a LIDAR"
