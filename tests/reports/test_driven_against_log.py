"""Laps raced as those of a log: from its starts, in its direction, on its track."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.analysis.log_view import prepare_races
from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.writer import TRACE_HEADER
from deepracer_exp.errors import BadInput
from deepracer_exp.reports.against_log import AgainstLog, laps_on, logged_laps
from deepracer_exp.reports.driven_against_log import course_driven, race_as_logged
from deepracer_exp.tracks.track import Track
from tests.analysis.made_up import Drive, made_up_recording


def started(course: Track, races: list[tuple[float, int]]) -> pd.DataFrame:
    """Return a log of which only the starts are known: where each race starts, and its laps."""
    rows = []
    for start, laps in races:
        x, y = course.points_at(np.array([start]))[0]
        for lap in range(laps):
            # A lap that follows without a stop counts its steps on.
            numbers = (1, 2) if lap == 0 else (2 + lap,)
            episode = rows[-1]["episode"] + 1 if rows else 0
            rows += [{"episode": episode, "steps": number, "X": x, "Y": y} for number in numbers]
    return pd.DataFrame(rows).assign(stream="evaluation", progress=0.0, tstamp=np.arange(len(rows)) / 15)


def written(steps: pd.DataFrame, folder: Path) -> Path:
    """Write steps as the service writes those of an evaluation."""
    table = steps.assign(
        action=[f"[{a} {b}]" for a, b in zip(steps["steer"], steps["throttle"], strict=True)]
    )
    file = folder / "evaluation-simtrace" / "0-iteration.csv"
    file.parent.mkdir(parents=True)
    table[TRACE_HEADER.split(",")].to_csv(file, index=False)
    return folder


@pytest.mark.parametrize("direction", ["forward", "reversed"])
def test_a_policy_beside_its_own_log_differs_in_nothing(experiment, driver, tmp_path, direction):
    (config,) = experiment.tracks.values()
    config = dataclasses.replace(config, direction=direction)
    track = Track.from_config(config)
    first = race_as_logged(experiment, driver(), config, track, started(track, [(0.0, 2), (0.25, 1)]))
    view = prepare_races(read_recording(written(first, tmp_path / "log")))

    config, found = course_driven(view, experiment)
    assert (config.direction, found.reversed) == (direction, direction == "reversed")
    logged = logged_laps(view, found)
    again = race_as_logged(experiment, driver(), config, found, logged.steps)
    assert len(again) == len(first)
    for name in ("X", "Y", "yaw", "steer", "throttle", "progress", "tstamp"):
        np.testing.assert_allclose(again[name], first[name], atol=1e-6)

    both = AgainstLog(course=found, logged=logged, simulated=laps_on(found, again, "again"))
    numbers = both.table.set_index("name")
    assert np.abs(numbers["difference"]).max() < 1e-6
    assert numbers.loc["complete laps, %", "logged"] == 100.0
    # The second of the first race is a flying lap, the third starts a quarter of the lap further.
    standing_s, flying_s, later_s = logged.episodes["lap_time_s"]
    assert flying_s < min(standing_s, later_s) - 0.2
    assert standing_s == pytest.approx(later_s, abs=1.5 / 15)
    assert both.sentences[1].startswith("Line and speed are the same all along the track")


def test_a_car_that_leaves_the_track_is_put_back_and_its_mistakes_are_counted(experiment, driver):
    (config,) = experiment.tracks.values()
    track = Track.from_config(config)
    steps = race_as_logged(experiment, driver(gain=0.0), config, track, started(track, [(0.0, 1)]))
    laps = laps_on(track, steps, "straight on")
    put_back = laps.measures()["off the track or stuck, per lap"]
    assert put_back >= 3
    moved_s = len(steps) / 15
    # Two seconds each time, as in the service.
    assert laps.episodes["time_s"].sum() == pytest.approx(moved_s + 2 * put_back, abs=0.5)


def test_a_log_of_another_track_is_refused(experiment):
    view = prepare_races(made_up_recording([Drive()]))
    elsewhere = dataclasses.replace(view, steps=view.steps.assign(X=2 * view.steps["X"], track_len=31.4))
    with pytest.raises(BadInput, match=r"none of the service's worlds .* accepted: --track"):
        course_driven(elsewhere, experiment)
    with pytest.raises(BadInput, match="--track Oval_track: is not where the car of made_up drove"):
        course_driven(view, experiment, "Oval_track")


def test_the_races_of_the_console_are_driven_as_often_and_from_the_same_starts(experiment, driver, reference):
    view = prepare_races(read_recording(reference / "console_training" / "logs" / "leaderboard"))
    config, track = course_driven(view, experiment)
    assert (config.name, config.direction) == ("reinvent_base", "forward")
    logged = logged_laps(view, track)
    assert logged.words.startswith("6 laps of 2 evaluations (leaderboard-2022")
    numbers = logged.measures()
    assert (round(numbers["fastest lap, s"], 2), round(numbers["median lap, s"], 2)) == (15.6, 16.26)
    steps = race_as_logged(experiment, driver(), config, track, logged.steps)
    begun = steps[steps["steps"] == 1]
    assert len(begun) == 2  # each race has three laps in a row
    assert steps["episode"].nunique() == 6
    standing = logged.steps[logged.steps["steps"] == 1]
    np.testing.assert_allclose(begun[["X", "Y"]], standing[["X", "Y"]], atol=0.01)
    alike = AgainstLog(course=track, logged=logged, simulated=logged)
    assert np.abs(alike.table["difference"]).max() == 0.0


def test_a_training_without_an_evaluation_stands_with_its_fastest_laps(experiment, reference):
    view = prepare_races(read_recording(reference / "console_training" / "sim-trace" / "training"))
    logged = logged_laps(view, course_driven(view, experiment)[1])
    assert "the fastest 10 of 47 complete laps of the training" in logged.words
    assert round(logged.episodes["lap_time_s"].min(), 3) == 14.195
    assert np.isnan(logged.measures()["complete laps, %"])
