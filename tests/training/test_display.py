"""What always holds of the terminal view."""

import dataclasses
import io
import math
import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepracer_exp.aws.worlds.catalogue import worlds
from deepracer_exp.commands.output import plain_console
from deepracer_exp.training.display import (
    LINE_COLUMNS,
    LINE_S,
    NOTHING,
    SPARKS,
    ProgressDisplay,
    RunHeader,
    TrackTable,
    sparkline,
)
from tests.waiting import wait_until

HEADER = RunHeader(
    **{"name": "default", "track": "re:Invent 2018", "track_labels": (), "remembered": 20},
    **{
        "reward": "progress_delta",
        "network": "mlp_small",
        "actions": "[15] actions [/] :car:",
        "algorithm": "PPO",
    },
    **{"budget": "3,000,000 steps", "folder": "runs/default/20260101-120000-reinvent_base"},
)
ROW = {
    **{"iteration": 40, "env_steps": 655_360, "episodes": 2489, "mean_return": 82.58, "completion": 99.5},
    **{"lap_share": 0.96, "laps": 525, "best_lap_time_s": 9.33, "mean_lap_time_s": 10.65, "entropy": 1.538},
    **{"kl": 0.0123, "policy_loss": -0.01, "value_loss": 0.2, "lr": 3e-4, "env_steps_per_s": 15_096.4},
}
SHOWN = ["655,360", "99.5%", "96%", "of last 20", "525", "82.58", "1.538", "0.0003", "15,096", "2,489"]
LAPS = ["9.33 s", "10.65 s"]
TRACKS = tuple(f"track_{letter}" for letter in "abcdefghijklmnopqr")
SEVERAL = dataclasses.replace(HEADER, track="18 tracks", track_labels=TRACKS)
ROW_OF_TRACKS = {
    **ROW,
    **{"best_lap_time_s": None, "mean_lap_time_s": None},
    **{f"completion/{label}": 81.0 + number for number, label in enumerate(TRACKS)},
    **{f"best_lap_time_s/{label}": 20.25 + number for number, label in enumerate(TRACKS)},
}


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def screen(width: int, height: int, header: RunHeader, *updates: tuple) -> list[str]:
    """The lines of the last drawing on a terminal of this size."""
    file = io.StringIO()
    console = plain_console(
        file=file, force_terminal=True, width=width, height=height, color_system=None, legacy_windows=False
    )
    with ProgressDisplay(console, header, Clock()) as display:
        for update in updates:
            display.update(*update)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", file.getvalue()).replace("\r", "\n")
    lines = plain.split("\n")
    first = max(place for place, line in enumerate(lines) if line.startswith("╭"))
    last = max(place for place, line in enumerate(lines) if line.startswith("╰"))
    return lines[first : last + 1]


def lines(act: Callable[[ProgressDisplay, Clock], None], header: RunHeader = HEADER) -> list[str]:
    """What is written where there is no terminal."""
    file, clock = io.StringIO(), Clock()
    with ProgressDisplay(plain_console(file=file, width=80), header, clock) as display:
        act(display, clock)
    return file.getvalue().splitlines()


@pytest.mark.parametrize(("width", "height"), [(40, 16), (60, 20), (76, 24), (80, 20), (120, 24), (200, 60)])
@pytest.mark.parametrize(
    ("header", "row"), [(HEADER, ROW), (SEVERAL, ROW_OF_TRACKS)], ids=["one", "18 tracks"]
)
def test_the_panel_fits_the_terminal_and_shows_every_figure_that_has_room(width, height, header, row):
    panel = screen(width, height, header, *[(row, 0.67, 23.0)] * 100)
    text = "\n".join(panel)
    assert len(panel) < height
    assert {len(line) for line in panel} == {min(width, 100)}
    assert "67%" in text
    if width < 60:  # those that matter most
        for word in ["iteration      40", "completion     99.5%", "exploring laps 525"]:
            assert word in text, word
        return
    laps = LAPS if header is HEADER else []
    for word in [*SHOWN, *laps, "0:23 left", header.track, header.folder, "default"]:
        assert word in text, word


def test_eighteen_tracks_fit_a_terminal_of_80_by_24_with_completion_and_fastest_exploring_lap_of_each():
    panel = screen(80, 24, SEVERAL, (ROW_OF_TRACKS, 0.5, 23.0))
    for number, label in enumerate(TRACKS):
        assert re.search(rf"{label} +{81 + number} +{20.25 + number:.2f}\b", "\n".join(panel)), label


def test_the_lap_of_the_last_evaluation_stays_and_is_not_mixed_with_exploring_ones():
    evaluated = {"eval_lap_share": 0.875, "eval_lap_time_s": 8.76, "eval_laps": 7, "eval_laps_tried": 8}
    updates = [(ROW, 0.1, 1.0), (ROW | evaluated, 0.2, 1.0), (ROW | dict.fromkeys(evaluated), 0.3, 1.0)]
    for width in (50, 80):
        panel = " ".join("\n".join(screen(width, 40, HEADER, *updates)).split())
        assert "usual lap 8.76 s" in panel
        assert "complete 7 of 8" in panel
        assert "their fastest 9.33 s" in panel
    line = lines(lambda display, clock: [display.update(*one) for one in updates])[-1]
    assert "lap 8.76 s (7 of 8)" in line
    assert "exploring" not in line


@pytest.mark.parametrize("missing", [None, math.nan, math.inf])
@pytest.mark.parametrize("keys", [ROW, ()], ids=["no value", "no key"])
def test_a_figure_that_is_not_known_yet_is_a_dash(missing, keys):
    row = dict.fromkeys(keys, missing)
    panel = "\n".join(screen(80, 24, HEADER, (row, 0.0, None)))
    line = lines(lambda display, clock: display.update(row, 0.0, missing))[-1]
    assert f"iteration {NOTHING}" in line
    for text in (panel, line):
        assert f"{NOTHING} left" in text
        assert not any(word in text for word in ("nan", "inf", "None"))


def test_a_share_beyond_the_budget_is_shown_as_all_of_it():
    assert "100%" in "\n".join(screen(80, 24, HEADER, (ROW, 1.02, 0.0)))


def test_without_a_terminal_there_are_single_plain_lines():
    written = lines(lambda display, clock: display.update(ROW, 0.67, 23.0))
    assert len(written) == 3
    assert HEADER.actions in written[0]  # square brackets are text, not markup
    assert HEADER.folder in written[1]
    assert "\x1b" not in "".join(written)
    assert written[2] == (
        "iteration 40  655,360 steps  15,096/s  completion 100%  exploring laps 525  return 82.6  entropy 1.54  "
        "0:23 left"
    )


def test_the_time_on_a_terminal_moves_while_an_iteration_takes_long(monkeypatch):
    monkeypatch.setattr("deepracer_exp.training.display._MOVE_S", 0.01)
    clock, file = Clock(), io.StringIO()
    console = plain_console(file=file, force_terminal=True, width=100, height=30, legacy_windows=False)
    with ProgressDisplay(console, HEADER, clock) as display:
        display.update(ROW, 0.67, 23.0)
        assert "1:15" not in file.getvalue()
        clock.now_s += 75.0
        wait_until(lambda: "1:15" in file.getvalue(), "the time to move")


def test_a_terminal_that_cannot_draw_in_place_gets_plain_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    file = io.StringIO()
    with ProgressDisplay(plain_console(file=file, force_terminal=True), HEADER, Clock()) as display:
        display.update(ROW, 0.67, 23.0)
    assert "\x1b" not in file.getvalue()
    assert "iteration 40" in file.getvalue()


def test_plain_lines_come_at_a_limited_rate_and_the_last_row_is_never_lost():
    def act(display: ProgressDisplay, clock: Clock) -> None:
        for iteration in range(1, 104):
            display.update({"iteration": iteration}, 0.0, None)
            clock.now_s += LINE_S / 10

    def act_for_an_hour(display: ProgressDisplay, clock: Clock) -> None:
        for _ in range(3600):
            clock.now_s += 1.0
            display.update(ROW, 0.1, None)

    iterations = [int(line.split("iteration ")[1].split()[0]) for line in lines(act)[2:]]
    assert iterations == [1, 11, 21, 31, 41, 51, 61, 71, 81, 91, 101, 103]
    assert 60 < len(lines(act_for_an_hour)) < 130  # a line a minute


NUMBERS = {
    "iteration": st.integers(1, 99_999),
    "env_steps": st.integers(1, 10**10),
    "env_steps_per_s": st.floats(0.1, 1e6),
    "completion": st.floats(0, 100),
    "laps": st.integers(0, 10**7),
    "mean_return": st.floats(-1e6, 1e6),
    "entropy": st.floats(-99, 99),
    "lr": st.floats(1e-9, 1),
    "eval_lap_share": st.sampled_from([None, 1.0]),
    "eval_lap_time_s": st.floats(1, 1000),
    "eval_laps": st.integers(0, 1000),
    "eval_laps_tried": st.integers(0, 1000),
}
LONGEST = sorted((world.title for world in worlds().values()), key=len)[-3:]


def test_a_plain_line_of_a_long_training_names_all_that_a_racer_follows():
    row = {"iteration": 183, "env_steps": 2_998_272, "env_steps_per_s": 58_400.0, "completion": 100.0}
    row |= {"eval_lap_share": 1.0, "eval_lap_time_s": 12.34, "eval_laps": 8, "eval_laps_tried": 8}
    row |= {"mean_return": 182.58, "entropy": -1.538}
    line = lines(lambda display, clock: display.update(row, 0.9, 61.0))[-1]
    assert line == (
        "iteration 183  2,998,272 steps  58,400/s  completion 100%  lap 12.34 s (8 of 8)  return 182.6  "
        "entropy -1.54  1:01 left"
    )


@given(
    st.fixed_dictionaries(NUMBERS),
    st.floats(0, 1e6),
    st.sampled_from(["PPO, compiled", "SAC, torch"]),
    st.sampled_from([LONGEST[-1], " + ".join(LONGEST), "82 tracks"]),
)
def test_no_plain_line_is_wider_than_120_columns(row, left_s, algorithm, track):
    header = dataclasses.replace(HEADER, track=track, algorithm=algorithm, track_labels=("a", "b"))
    written = lines(lambda display, clock: display.update(row, 0.5, left_s), header)
    assert max(map(len, written)) <= LINE_COLUMNS == 120
    assert f"iteration {row['iteration']:,}" in written[-1]
    assert "left" in written[-1]


@given(st.lists(st.floats(-1e6, 1e6), max_size=300), st.integers(1, 40))
def test_a_sparkline_is_never_wider_than_asked_and_rises_with_its_values(values: list[float], width: int):
    drawn = sparkline(values, width)
    assert len(drawn) == min(width, len(values))
    assert set(drawn) <= set(SPARKS)
    assert list(rising := sparkline(sorted(values), width)) == sorted(rising)


def test_fixed_bounds_make_a_small_value_a_low_bar():
    assert sparkline([2.0, 3.0], 5, (0.0, 100.0)) == "▁▁"
    assert sparkline([0.0, 100.0, 250.0], 5, (0.0, 100.0)) == "▁██"


@given(
    st.lists(st.text("abcdef_", min_size=1, max_size=40), min_size=1, max_size=60, unique=True),
    st.integers(24, 120),
    st.integers(2, 40),
)
def test_a_table_of_tracks_keeps_within_its_width_and_room_and_leaves_no_track_uncounted(labels, width, room):
    table = [line.plain for line in TrackTable(labels).lines(width, room)]
    assert len(table) <= room
    assert all(len(line) <= width for line in table)
    # Each track has two dashes, since nothing is known of it yet.
    shown = sum(line.count(NOTHING) for line in table) // 2
    left_out = [line.split("and ")[1].split(" more")[0] for line in table if " more" in line]
    assert shown + sum(map(int, left_out)) == len(labels)


def test_names_that_are_too_long_keep_both_ends():
    text = "\n".join(
        line.plain for line in TrackTable(["reInvent2019_track", "reInvent2019_wide"]).lines(24, 9)
    )
    assert all(word in text for word in ("reIn", "track ", "wide "))
