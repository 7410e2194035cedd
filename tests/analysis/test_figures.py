"""Laws of the figures."""

import io
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from deepracer_exp.analysis.charts.run_pictures import (
    LINE_COLUMNS,
    driven_line,
    driven_lines,
    episodes,
    learning_curves,
)
from deepracer_exp.tracks.track import Track

CONSOLE = (
    Path(__file__).parents[2] / "../shared/reference/console_training/sim-trace/training/training-simtrace"
)


def circle_track() -> Track:
    angle = np.linspace(0, 2 * np.pi, 61)
    angle[-1] = 0.0
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    return Track.from_route(np.hstack([3.0 * ring, 2.6 * ring, 3.4 * ring]), "circle", title="Circle")


def drive(
    *,
    steps: int,
    status: str,
    share: float = 1.0,
    car: int = 0,
    episode: int = 0,
    start_s: float = 0.0,
    first_step: int = 1,
    top_mps: float = 2.0,
    track: str = "circle",
) -> pd.DataFrame:
    """One episode on the circle, at constant speed from the prepare row on."""
    step = np.arange(first_step, steps + 1)
    angle = 2 * np.pi * share * (step - 1) / (steps - 1)
    return pd.DataFrame(
        {
            "car": car,
            "episode": episode,
            "steps": step,
            "X": 3 * np.cos(angle),
            "Y": 3 * np.sin(angle),
            "progress": 100 * share * (step - 1) / (steps - 1),
            "episode_status": ["prepare" if n == 1 else "in_progress" for n in step[:-1]] + [status],
            "tstamp": start_s + (step - 1) / 15,
            "iteration": 5,
            "speed_mps": np.linspace(0, top_mps, len(step)),
            "track": track,
        }
    )


def caption(figure: Figure) -> str:
    return " ".join(text.get_text() for text in figure.texts)


def driven(figure: Figure) -> LineCollection:
    return all_driven(figure)[0]


def all_driven(figure: Figure) -> list[LineCollection]:
    lines = [item for axes in figure.axes for item in axes.collections]
    return [line for line in lines if isinstance(line, LineCollection) and line.get_array() is not None]


def png(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=40)
    return file.getvalue()


def test_a_lap_takes_its_steps_after_the_prepare_row_at_fifteen_a_second() -> None:
    table = episodes(drive(steps=151, status="lap_complete", start_s=1234.5))
    assert table["lap_time_s"].item() == pytest.approx(150 / 15)
    assert table["rows"].item() == 151


@pytest.mark.parametrize("status", ["off_track", "in_progress", "time_up", "reversed"])
def test_only_a_complete_lap_has_a_lap_time(status: str) -> None:
    assert math.isnan(episodes(drive(steps=100, status=status))["lap_time_s"].item())


def test_a_lap_whose_beginning_is_missing_has_no_lap_time() -> None:
    assert math.isnan(episodes(drive(steps=100, status="lap_complete", first_step=80))["lap_time_s"].item())


def test_an_episode_goes_on_into_the_next_iteration() -> None:
    whole = drive(steps=90, status="lap_complete")
    split = pd.concat(
        [whole[:40], drive(steps=20, status="off_track", car=1, episode=1), whole[40:].assign(iteration=6)]
    )
    table = episodes(split)
    assert table.loc[0, "lap_time_s"] == pytest.approx(89 / 15)
    assert table.loc[0, "iteration"] == 6


@pytest.mark.skipif(not CONSOLE.is_dir(), reason="no recording of the console beside the project")
def test_the_consoles_recording_has_47_laps_the_best_in_14_13_seconds() -> None:
    trace = pd.concat([pd.read_csv(path).assign(iteration=0, car=0) for path in CONSOLE.glob("*.csv")])
    laps = episodes(trace)["lap_time_s"]
    assert laps.notna().sum() == 47
    assert laps.min() == pytest.approx(14.128, abs=1e-6)


def test_the_fastest_complete_lap_is_drawn_though_others_end_sooner() -> None:
    trace = pd.concat(
        [
            drive(steps=200, status="lap_complete", episode=0),
            drive(steps=151, status="lap_complete", episode=1),
            drive(steps=30, status="off_track", share=0.4, episode=2),
        ]
    )
    figure = driven_line(trace, circle_track())
    assert "lap in 10.00 s" in caption(figure)
    assert "Circle" in caption(figure)
    segments = driven(figure).get_segments()
    assert len(segments) == 150
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(segments), axis=1), 3.0)


def test_without_a_lap_the_episode_that_came_farthest_is_drawn() -> None:
    trace = pd.concat(
        [
            drive(steps=400, status="immobilized", share=0.2, episode=0),
            drive(steps=100, status="off_track", share=0.613, episode=1),
        ]
    )
    figure = driven_line(trace, circle_track())
    assert "61.3 % of the lap, off track" in caption(figure)


def test_the_named_columns_are_all_the_line_needs() -> None:
    trace = drive(steps=20, status="lap_complete").assign(reward=1.0)
    assert png(driven_line(trace[list(LINE_COLUMNS)], circle_track())) == png(
        driven_line(trace, circle_track())
    )


def test_an_episode_can_be_chosen() -> None:
    trace = pd.concat([drive(steps=60, status="off_track", episode=k, share=0.1 * (k + 1)) for k in range(3)])
    assert "10.0 % of the lap" in caption(driven_line(trace, circle_track(), 0))
    with pytest.raises(KeyError):
        driven_line(trace, circle_track(), 9)


def test_colours_are_the_speeds_at_the_ends_of_the_segments() -> None:
    trace = drive(steps=60, status="lap_complete")
    line = driven(driven_line(trace, circle_track()))
    np.testing.assert_array_equal(line.get_array(), trace["speed_mps"][1:])


@pytest.mark.parametrize("steps", [2, 3, 60])
def test_even_the_shortest_episode_is_a_picture(steps: int) -> None:
    trace = drive(steps=steps, status="off_track", share=0.01)
    assert png(driven_line(trace, circle_track())).startswith(b"\x89PNG")


def test_each_track_has_its_own_best_episode_and_one_scale_of_speed_holds_for_all() -> None:
    trace = pd.concat(
        [
            drive(steps=200, status="lap_complete", episode=0, track="a"),
            drive(steps=151, status="lap_complete", episode=1, track="a", top_mps=3.0),
            drive(steps=60, status="off_track", episode=2, share=0.3, track="b", top_mps=1.0),
            drive(steps=60, status="off_track", episode=3, share=0.2, track="b", top_mps=4.0),
        ]
    )
    figure = driven_lines(trace, {"a": circle_track(), "b": circle_track(), "c": circle_track()})
    words = [text.get_text() for text in figure.texts]
    assert words == [
        *("Circle", "lap in 10.00 s"),
        *("Circle", "30.0 % of the lap, off track"),
        *("Circle", "not driven"),
    ]
    lines = all_driven(figure)
    assert [len(line.get_segments()) for line in lines] == [150, 59]
    assert {line.get_clim() for line in lines} == {lines[0].get_clim()}
    assert lines[0].get_clim()[1] == 3.0


@pytest.mark.parametrize("count", [2, 7, 18])
def test_any_number_of_tracks_is_a_picture_on_which_no_two_roads_meet(count: int) -> None:
    figure = driven_lines(
        drive(steps=3, status="off_track", track="0"), {str(k): circle_track() for k in range(count)}
    )
    roads = [axes.get_position() for axes in figure.axes[:count]]
    assert all(0 <= box.x0 < box.x1 <= 1 and 0 <= box.y0 < box.y1 <= 1 for box in roads)
    assert not any(one.overlaps(other) for k, one in enumerate(roads) for other in roads[:k])
    assert png(figure).startswith(b"\x89PNG")


def metrics(rows: int, laps: bool = True) -> pd.DataFrame:
    lap_s = np.linspace(14, 9, rows) if laps else np.full(rows, np.nan)
    return pd.DataFrame(
        {
            "env_steps": 4096 * np.arange(1, rows + 1),
            "completion": np.linspace(0, 100, rows),
            "lap_share": np.linspace(0, 1, rows),
            "mean_return": np.linspace(1, 90, rows),
            "best_lap_time_s": lap_s,
            "mean_lap_time_s": lap_s + 1,
            "entropy": np.linspace(2.7, 1.0, rows),
        }
    )


def test_each_curve_stands_against_control_steps_and_both_shares_are_per_cent() -> None:
    figure = learning_curves(metrics(20))
    driving = figure.axes[0]
    for line in (line for axes in figure.axes for line in axes.lines):
        np.testing.assert_array_equal(line.get_xdata(), 4096 * np.arange(1, 21))
    assert [line.get_ydata()[-1] for line in driving.lines] == [100, 100]
    assert sum(len(axes.lines) for axes in figure.axes) == 6


@pytest.mark.parametrize("rows", [0, 1, 3, 50])
def test_a_run_of_any_length_is_a_picture_even_before_its_first_lap(rows: int) -> None:
    figure = learning_curves(metrics(rows, laps=False))
    assert png(figure).startswith(b"\x89PNG")
    assert [text.get_text() for text in figure.axes[2].texts] == ["none yet"]


def test_each_track_has_a_thin_line_without_the_iterations_that_tell_nothing_of_it() -> None:
    frame = metrics(20).assign(best_lap_time_s=np.nan, mean_lap_time_s=np.nan)
    for name, every in (("a", 1), ("b", 2)):
        told = np.arange(20) % every == 0
        frame[f"completion/{name}"] = np.where(told, 50.0, np.nan)
        frame[f"mean_lap_time_s/{name}"] = np.where(told, 12.0, np.nan)
    figure = learning_curves(frame)
    driving, _, laps, _ = figure.axes
    assert [len(line.get_xdata()) for line in driving.lines] == [20, 10, 20, 20]
    assert driving.lines[0].get_linewidth() < driving.lines[2].get_linewidth()
    assert [len(line.get_xdata()) for line in laps.lines] == [20, 10]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]
    assert png(figure).startswith(b"\x89PNG")


def test_values_read_from_json_as_none_are_gaps() -> None:
    frame = metrics(4)
    frame["completion"] = pd.Series([None, 1.0, None, 3.0], dtype=object)
    assert png(learning_curves(frame)).startswith(b"\x89PNG")


def test_drawing_needs_no_pyplot_and_so_no_screen() -> None:
    code = (
        "import sys, deepracer_exp.analysis.charts.run_pictures; sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
