"""The two pictures of every run."""

import io
import math
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from deepracer_exp.reports.charts.run_pictures import LINE_COLUMNS, driven_lines, episodes, learning_curves
from deepracer_exp.tracks.track import Track


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
            "tstamp": 1234.5 + (step - 1) / 15,
            "iteration": 5,
            "speed_mps": np.linspace(0, top_mps, len(step)),
            "track": track,
        }
    )


def words(figure: Figure) -> list[str]:
    return [
        word
        for axes in figure.axes
        for text in axes.texts
        for word in (axes.get_title("left"), text.get_text())
    ]


def driven(figure: Figure) -> list[LineCollection]:
    lines = [item for axes in figure.axes for item in axes.collections]
    return [line for line in lines if isinstance(line, LineCollection) and line.get_array() is not None]


def png(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=40)
    assert file.getvalue().startswith(b"\x89PNG")
    return file.getvalue()


@pytest.mark.parametrize(
    ("trace", "lap_time_s"),
    [
        (drive(steps=150, status="lap_complete"), 10.0),
        (drive(steps=100, status="off_track"), math.nan),
        (drive(steps=100, status="in_progress"), math.nan),
        (drive(steps=100, status="lap_complete", first_step=80), math.nan),
    ],
    ids=["a lap", "off the road", "still driving", "without its beginning"],
)
def test_only_a_whole_lap_has_a_lap_time(trace: pd.DataFrame, lap_time_s: float) -> None:
    assert episodes(trace)["lap_time_s"].item() == pytest.approx(lap_time_s, nan_ok=True)


def test_an_episode_continues_in_the_next_iteration() -> None:
    whole = drive(steps=90, status="lap_complete")
    split = [
        whole[:40],
        drive(steps=20, status="off_track", car=1, episode=1),
        whole[40:].assign(iteration=6),
    ]
    table = episodes(pd.concat(split))
    assert table.loc[0, "lap_time_s"] == pytest.approx(90 / 15)
    assert table.loc[0, "iteration"] == 6


def test_the_fastest_complete_lap_is_drawn_in_the_speeds_at_the_ends_of_its_segments() -> None:
    lap = drive(steps=150, status="lap_complete", episode=1)
    others = [
        drive(steps=200, status="lap_complete"),
        drive(steps=30, status="off_track", share=0.4, episode=2),
    ]
    trace = pd.concat([*others, lap]).assign(reward=1.0)
    figure = driven_lines(trace, {"circle": circle_track()})
    title, result = words(figure)
    assert title == "Circle"
    assert result.startswith("exploring lap in 10.00 s")
    (line,) = driven(figure)
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(line.get_segments()), axis=1), 3.0)
    np.testing.assert_array_equal(line.get_array(), lap["speed_mps"][1:])
    assert png(driven_lines(trace[list(LINE_COLUMNS)], {"circle": circle_track()})) == png(figure)


def test_a_lap_on_usual_conditions_is_drawn_before_a_faster_one_of_a_car_that_differs() -> None:
    trace = pd.concat(
        [
            drive(steps=150, status="lap_complete", car=1),
            drive(steps=200, status="lap_complete", episode=1),
        ]
    )
    for usual, lap in (([True, False], "13.33"), ([True, True], "10.00"), ([False, False], "10.00")):
        figure = driven_lines(trace, {"circle": circle_track()}, None, np.array(usual))
        assert words(figure)[1].startswith(f"exploring lap in {lap} s")


def test_each_track_has_its_own_best_episode_and_one_scale_of_speed_holds_for_all() -> None:
    trace = pd.concat(
        [
            drive(steps=200, status="lap_complete", episode=0, track="a"),
            drive(steps=150, status="lap_complete", episode=1, track="a", top_mps=3.0),
            drive(steps=60, status="off_track", episode=2, share=0.3, track="b", top_mps=1.0),
            drive(steps=60, status="off_track", episode=3, share=0.2, track="b", top_mps=4.0),
        ]
    )
    figure = driven_lines(trace, {"a": circle_track(), "b": circle_track(), "c": circle_track()})
    assert words(figure)[1::2] == ["exploring lap in 10.00 s", "30.0% of the lap, off track", "not driven"]
    lines = driven(figure)
    assert [len(line.get_segments()) for line in lines] == [149, 59]
    assert {line.get_clim() for line in lines} == {lines[0].get_clim()}
    assert lines[0].get_clim()[1] == 3.0


@pytest.mark.parametrize(("count", "steps"), [(1, 2), (2, 3), (18, 3)])
def test_any_number_of_tracks_is_a_picture_on_which_no_two_roads_meet(count: int, steps: int) -> None:
    trace = drive(steps=steps, status="off_track", share=0.01, track="0")
    figure = driven_lines(trace, {str(k): circle_track() for k in range(count)})
    png(figure)
    roads = [axes.get_position() for axes in figure.axes[:count]]
    assert all(0 <= box.x0 < box.x1 <= 1 and 0 <= box.y0 < box.y1 <= 1 for box in roads)
    assert not any(one.overlaps(other) for k, one in enumerate(roads) for other in roads[:k])


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
    for line in (line for axes in figure.axes for line in axes.lines):
        np.testing.assert_array_equal(line.get_xdata(), 4096 * np.arange(1, 21))
    assert [line.get_ydata()[-1] for line in figure.axes[0].lines] == [100, 100]
    assert sum(len(axes.lines) for axes in figure.axes) == 6


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_a_run_of_any_length_is_a_picture_even_before_its_first_lap(rows: int) -> None:
    frame = metrics(rows, laps=False)
    if rows > 1:  # as read from JSON
        frame["completion"] = pd.Series([None, *frame["completion"][1:]], dtype=object)
    figure = learning_curves(frame)
    png(figure)
    assert [text.get_text() for text in figure.axes[2].texts] == ["none yet"]


def test_each_track_has_a_thin_line_without_the_iterations_that_know_nothing_of_it() -> None:
    frame = metrics(20).assign(best_lap_time_s=np.nan, mean_lap_time_s=np.nan)
    for name, every in (("a", 1), ("b", 2)):
        known = np.arange(20) % every == 0
        frame[f"completion/{name}"] = np.where(known, 50.0, np.nan)
        frame[f"mean_lap_time_s/{name}"] = np.where(known, 12.0, np.nan)
    figure = learning_curves(frame)
    driving, _, laps, _ = figure.axes
    assert [len(line.get_xdata()) for line in driving.lines] == [20, 10, 20, 20]
    assert driving.lines[0].get_linewidth() < driving.lines[2].get_linewidth()
    assert [len(line.get_xdata()) for line in laps.lines] == [20, 10]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]
    png(figure)


def test_drawing_needs_no_pyplot_and_so_no_screen() -> None:
    module = "deepracer_exp.reports.charts.run_pictures"
    code = f"import sys, {module}; sys.exit('matplotlib.pyplot' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
