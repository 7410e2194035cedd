"""What a log holds beside its training: races, evaluations, and logs of other tracks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.reports.findings import findings
from deepracer_exp.reports.pages.log_report import LogPage, html
from deepracer_exp.reports.tables.log_tables import facts, headline, other_tracks, raced_beside
from deepracer_exp.reports.tables.log_view import LogView, prepare


def test_races_beside_a_training_without_a_lap_are_in_words(reference: Path) -> None:
    view = prepare(read_recording(reference / "inputs/fourth/08-races-beside-a-training"))
    words = "2 complete laps in 2 episodes of 2 races, the fastest in 7.60 s"
    assert headline(view).endswith(f"; no complete exploring lap. Beside it {words}.")
    assert dict(facts(view))["Races and evaluations"] == words
    (submit,) = (finding.sentence for finding in findings(view) if finding.rule == "submit")
    assert submit.startswith("The training names no checkpoint to submit: no iteration has 3 complete laps")
    assert submit.endswith(f"What was raced beside it: {words}.")


def test_laps_with_resets_beside_a_training_are_counted_apart(console: LogView) -> None:
    assert raced_beside(console).startswith(
        "12 complete laps in 12 episodes of 4 races, the fastest in 15.60 s"
    )
    put_back = console.evaluation_episodes.assign(resets=[1] * 5 + [0] * 7)
    assert raced_beside(replace(console, evaluation_episodes=put_back)).endswith("; 5 more laps with resets")


@pytest.mark.parametrize(
    ("track", "other", "steps"),
    [
        (None, "Oval_track (second; 295 control steps)", 540),
        ("reinvent_base", "Oval_track (second; 295 control steps)", 540),
        ("Oval_track", "reinvent_base (first; 540 control steps)", 295),
    ],
)
def test_of_logs_of_two_tracks_one_has_the_page_and_the_other_is_named(
    reference: Path, track: str | None, other: str, steps: int
) -> None:
    view = prepare(read_recording(reference / "inputs/fourth/01-logs-of-two-tracks"), track)
    assert len(view.steps) == steps
    assert other_tracks(view) == other
    assert other in html(LogPage(view, findings(view)))


def test_a_training_on_another_track_has_no_part_in_iterations_and_candidates(reference: Path) -> None:
    recording = read_recording(reference / "inputs/fourth/01-logs-of-two-tracks")
    lap = {
        "worker": 0,
        "phase": "evaluation",
        "reward": 1.0,
        "completion": 100.0,
        "time_s": 9.5,
        "resets": 0.0,
    }
    metrics = pd.DataFrame({"stream": "training", "iteration": [1, 3], "episode": [9, 14], **lap})
    updates = pd.DataFrame({"iteration": np.arange(4), "epoch": 0, "entropy": 1.0})
    recording = replace(
        recording,
        metrics=metrics.reindex(columns=recording.metrics.columns),
        updates=updates.reindex(columns=recording.updates.columns),
    )
    here, there = prepare(recording), prepare(recording, "Oval_track")
    assert here.iterations["iteration"].tolist() == [0, 1]
    assert here.candidates["checkpoint"].tolist() == ["1_Step-265"]
    assert there.iterations["iteration"].tolist() == [2, 3]
    assert there.candidates["checkpoint"].tolist() == ["1_Step-290"]
