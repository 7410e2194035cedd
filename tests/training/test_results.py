import numpy as np
import pytest

from deepracer_exp.config.stopping import NoStopping, ReliableStopping
from deepracer_exp.deepracer.trace import PACKED, STATUS_CODE
from deepracer_exp.runs.convergence import build_rule
from deepracer_exp.training.metrics import RunMetrics

RULE = ReliableStopping(kind="reliable", lap_share=0.75, episodes=4)


def drive(results: RunMetrics, track: int, laps: int, others: int = 0, steps: int = 31):
    """End as many complete laps and other episodes on a track, one car each."""
    trace = np.zeros((laps + others, 1, len(PACKED)))
    row = trace[:, 0]
    row[:, PACKED["car"]] = np.arange(len(row))
    row[:, PACKED["track"]] = track
    row[:, PACKED["steps"]] = steps
    row[:, PACKED["done"]] = 1
    row[:, PACKED["progress"]] = np.where(np.arange(len(row)) < laps, 100, 40)
    status = np.where(np.arange(len(row)) < laps, STATUS_CODE["lap_complete"], STATUS_CODE["off_track"])
    row[:, PACKED["episode_status"]] = status
    return results.enter(trace)[1]


def test_one_track_has_no_metrics_of_its_own():
    results = RunMetrics(["Oval_track"], 8, 1 / 15, RULE)
    finished = drive(results, 0, laps=3, others=1)
    assert results.row_of_tracks(finished) == {}
    assert list(results.row(finished)) == [
        *("mean_return", "completion", "lap_share", "best_lap_time_s", "mean_lap_time_s"),
    ]
    assert results.row(finished)["best_lap_time_s"] == pytest.approx(2.0)
    assert results.summary() == {"lap_share": 0.75, "best_lap_time_s": pytest.approx(2.0)}


def test_every_track_has_its_own_figures_and_the_whole_no_lap_time():
    results = RunMetrics(["a", "b", "c"], 8, 1 / 15, RULE)
    drive(results, 0, laps=4)
    finished = drive(results, 1, laps=1, others=3, steps=46)
    whole, each = results.row(finished), results.row_of_tracks(finished)
    assert (whole["completion"], whole["best_lap_time_s"], whole["mean_lap_time_s"]) == (55.0, None, None)
    assert each == {
        "completion/a": None,
        "lap_share/a": 1.0,
        "best_lap_time_s/a": pytest.approx(2.0),
        "mean_lap_time_s/a": None,
        "completion/b": 55.0,
        "lap_share/b": 0.25,
        "best_lap_time_s/b": pytest.approx(3.0),
        "mean_lap_time_s/b": pytest.approx(3.0),
        "completion/c": None,
        "lap_share/c": None,
        "best_lap_time_s/c": None,
        "mean_lap_time_s/c": None,
    }


def test_the_summary_has_each_track_by_its_name_with_what_was_known_last():
    results = RunMetrics(["Kurs ß", "b"], 8, 1 / 15, NoStopping(kind="none"))
    results.row_of_tracks(drive(results, 0, laps=1, others=1))
    results.row_of_tracks(drive(results, 1, laps=2, steps=16))
    summary = results.summary()
    assert summary["best_lap_time_s"] is None
    assert summary["tracks"]["Kurs ß"] == {
        "episodes": 2,
        "laps": 1,
        "completion": 70.0,
        "lap_share": None,
        "best_lap_time_s": pytest.approx(2.0),
        "mean_lap_time_s": pytest.approx(2.0),
    }
    assert summary["tracks"]["b"]["laps"] == 2


def reliable(results: RunMetrics) -> str | None:
    """Return what the stopping rule says of the results."""
    shares = {f"lap_share/{label}": None for label in results.labels}
    decision = build_rule(RULE, 5).observe({"lap_share": results.lap_share, **shares})
    return decision and decision.why


def test_reliable_is_what_is_reliable_on_every_track():
    results = RunMetrics(["a", "b"], 8, 1 / 15, RULE)
    drive(results, 0, laps=8)
    assert reliable(results) is None  # nothing is known of the other
    drive(results, 1, laps=2, others=2)
    assert reliable(results) is None
    drive(results, 1, laps=2)
    assert reliable(results) is None  # two of the last four
    drive(results, 1, laps=1)
    assert reliable(results) == "75% or more of the last 4 episodes completed the lap on each of 2 tracks"
    drive(results, 0, laps=0, others=2)
    assert reliable(results) is None


def test_the_share_of_laps_is_that_of_the_track_where_it_is_lowest():
    results = RunMetrics(["a", "b"], 8, 1 / 15, RULE)
    assert results.row(drive(results, 0, laps=4))["lap_share"] is None
    assert results.row(drive(results, 1, laps=1, others=3))["lap_share"] == 0.25
    assert results.summary()["lap_share"] == 0.25
