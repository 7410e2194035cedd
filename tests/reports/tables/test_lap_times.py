"""A lap takes what the service says it took: on its clock, from the reset, in logs and in races of our own."""

import json
import tarfile
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.aws.logs.recorded import TRAINING, Recording
from deepracer_exp.env.rules import lap_clock_s
from deepracer_exp.reports.charts.run_pictures import episodes as pictured
from deepracer_exp.reports.tables.log_tables import facts
from deepracer_exp.reports.tables.log_view import LogView, prepare
from deepracer_exp.reports.tables.step_columns import add_derived
from deepracer_exp.reports.tables.tables import episode_table
from tests.conftest import REFERENCE

from .conftest import CONSOLE
from .made_up import HZ, Drive, made_up_recording

FAST = REFERENCE / "race_pace" / "droa_v6_fast.tar.gz"
STEP_S = 1 / HZ


def official_laps(text: str, phase: str) -> dict[int, float]:
    """Return the times of the complete laps of a metrics file, in seconds, by their episodes from 0."""
    items: list[Mapping[str, Any]] = json.loads(text)["metrics"]
    return {
        item.get("episode", item["trial"]) - 1: item["elapsed_time_in_milliseconds"] / 1000
        for item in items
        if item["completion_percentage"] == 100 and item.get("phase", "evaluation") == phase
    }


def laps_of(view: LogView) -> dict[int, float]:
    laps = view.episodes.dropna(subset="lap_time_s")
    return dict(zip(laps["episode"], laps["lap_time_s"], strict=True))


def without_metrics(recording: Recording) -> LogView:
    return prepare(replace(recording, metrics=recording.metrics[:0]))


@pytest.fixture(scope="module")
def fast() -> Recording:
    if not FAST.is_file():
        pytest.skip(f"no recording at {FAST}")
    return read_recording(FAST)


def test_laps_of_the_console_took_what_its_metrics_files_say(console: LogView) -> None:
    (training,) = (CONSOLE / "metrics" / "training").glob("*.json")
    official = official_laps(training.read_text(), "training")
    found = laps_of(console)
    assert len(found) == 48
    assert found == pytest.approx({episode: official[episode] for episode in found}, abs=1e-9)
    for file in (CONSOLE / "metrics" / "evaluation").glob("*.json"):
        job = file.stem.removeprefix("evaluation-")
        raced = console.evaluation_episodes
        raced = raced[raced["stream"].astype(str) == job].set_index("episode")["lap_time_s"]
        assert raced.to_dict() == pytest.approx(official_laps(file.read_text(), "evaluation"), abs=1e-9)


def test_laps_at_race_pace_took_what_the_metrics_file_says(fast: Recording) -> None:
    with tarfile.open(FAST) as archive:
        (name,) = (name for name in archive.getnames() if name.endswith("training.json"))
        file = archive.extractfile(name)
        assert file is not None
        official = official_laps(file.read().decode(), "training")
    view = prepare(fast)
    found = laps_of(view)
    assert len(found) == 90
    assert found == pytest.approx({episode: official[episode] for episode in found}, abs=1e-9)
    assert ("Lap times", "as in the service's metrics file") in facts(view)


def test_without_a_metrics_file_laps_are_counted_from_the_reset_and_that_is_said(
    console: LogView, fast: Recording
) -> None:
    """The newest service adds a second step, which its rows do not show."""
    for recording, official, near_s in ((console.recording, console, 0.03), (fast, prepare(fast), 0.12)):
        counted = without_metrics(recording)
        late_s = pd.Series(laps_of(official)) - pd.Series(laps_of(counted))
        assert late_s.abs().max() < near_s
        assert counted.laps_timed == 0
        (said,) = (words for name, words in facts(counted) if name == "Lap times")
        assert said.startswith("counted from the reset")


def test_a_lap_is_counted_from_the_reset_whether_it_is_the_first_or_the_next() -> None:
    view = prepare(made_up_recording([Drive(), Drive(until=0.5)]))
    rows = view.steps[view.steps["episode"] == 0]
    assert view.episodes["lap_time_s"].iloc[0] == pytest.approx(np.ptp(rows["tstamp"]) + STEP_S)
    # In a race the next lap begins with the last row of the one before.
    first = view.recording.steps[lambda table: table["episode"] == 0]
    second = first.assign(
        episode=1, steps=first["steps"] + len(first), tstamp=first["tstamp"] + len(first) * STEP_S
    )
    steps = pd.concat([first, second], ignore_index=True)
    laps = episode_table(add_derived(steps, view.course, 0.9))["lap_time_s"]
    since_s = steps["tstamp"].iloc[-1] - first["tstamp"].iloc[-1]
    assert laps.tolist() == pytest.approx([np.ptp(first["tstamp"]) + STEP_S, since_s])


def test_a_generation_without_a_prepare_row_counts_two_steps_before_its_first_row() -> None:
    recording = made_up_recording([Drive()])
    whole = prepare(recording).episodes["lap_time_s"].iloc[0]
    for number, kept in (
        (2, recording.steps[1:]),
        (0, recording.steps.assign(steps=recording.steps["steps"] - 1)),
    ):
        assert kept["steps"].iloc[0] == number
        assert prepare(replace(recording, steps=kept)).episodes["lap_time_s"].iloc[0] == pytest.approx(whole)


def test_a_lap_of_our_own_takes_as_many_periods_as_it_has_rows_wherever_it_is_shown() -> None:
    """The race, the training, the picture of a run and its report: tests of the first two are beside them."""
    steps = made_up_recording([Drive()]).steps
    steps = steps.assign(tstamp=np.arange(7, 7 + len(steps)) * STEP_S, car=0, stream=TRAINING)
    expected = float(lap_clock_s(len(steps), STEP_S))
    assert expected == pytest.approx(len(steps) / 15)
    assert pictured(steps)["lap_time_s"].tolist() == pytest.approx([expected])
    assert episode_table(add_derived(steps, None, 0.9))["lap_time_s"].tolist() == pytest.approx([expected])
