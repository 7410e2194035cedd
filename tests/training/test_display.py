"""Laws of the terminal view."""

import dataclasses
import io
import math
import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from deepracer_exp.training.display import LINE_S, SPARKS, ProgressDisplay, RunHeader, sparkline

HEADER = RunHeader(
    name="default",
    track="re:Invent 2018",
    track_labels=(),
    remembered=50,
    reward="progress_gain",
    network="mlp_small",
    actions="15 actions",
    budget="3,000,000 steps",
    folder="runs/default/20260101-120000-reinvent_base",
)
ROW = {
    "iteration": 40,
    "env_steps": 655_360,
    "episodes": 2489,
    "mean_return": 82.58,
    "completion": 99.5,
    "lap_share": 0.96,
    "laps": 525,
    "best_lap_time_s": 9.33,
    "mean_lap_time_s": 10.65,
    "entropy": 1.538,
    "kl": 0.0123,
    "policy_loss": -0.01,
    "value_loss": 0.2,
    "lr": 3e-4,
    "env_steps_per_s": 15_096.4,
}
SHOWN = [
    "655,360",
    "99.5 %",
    "96 %",
    "525",
    "9.33 s",
    "10.65 s",
    "82.58",
    "1.538",
    "0.0003",
    "15,096",
    "2,489",
]


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def screen(
    width: int, act: Callable[[ProgressDisplay], None], height: int = 24, header: RunHeader = HEADER
) -> list[str]:
    """The lines of the last drawing on a terminal of this size."""
    file = io.StringIO()
    console = Console(
        file=file, force_terminal=True, width=width, height=height, color_system=None, legacy_windows=False
    )
    with ProgressDisplay(console, header, Clock()) as display:
        act(display)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", file.getvalue()).replace("\r", "\n")
    lines = plain.split("\n")
    first = max(place for place, line in enumerate(lines) if line.startswith("╭"))
    last = max(place for place, line in enumerate(lines) if line.startswith("╰"))
    return lines[first : last + 1]


def lines(act: Callable[[ProgressDisplay, Clock], None], header: RunHeader = HEADER) -> list[str]:
    """What is written where there is no terminal."""
    file = io.StringIO()
    clock = Clock()
    with ProgressDisplay(Console(file=file, width=80), header, clock) as display:
        act(display, clock)
    return file.getvalue().splitlines()


@pytest.mark.parametrize(("width", "height"), [(60, 20), (76, 24), (80, 20), (120, 24), (200, 60)])
def test_the_panel_fits_the_terminal_and_shows_every_figure(width: int, height: int) -> None:
    def act(display: ProgressDisplay) -> None:
        for _ in range(100):
            display.update(ROW, 0.67, 23.0)

    panel = screen(width, act, height)
    text = "\n".join(panel)
    assert len(panel) < height
    assert {len(line) for line in panel} == {min(width, 100)}
    assert not any("…" in line for line in panel[3:])
    for word in [*SHOWN, "67 %", "0:23 left", "re:Invent 2018", HEADER.folder, "default"]:
        assert word in text, word


@pytest.mark.parametrize("missing", [None, math.nan, math.inf])
def test_a_figure_nobody_knows_yet_is_a_dash(missing: float | None) -> None:
    row = dict.fromkeys(ROW, missing)
    for text in (
        "\n".join(screen(80, lambda display: display.update(row, 0.0, None))),
        lines(lambda display, clock: display.update(row, 0.0, missing))[-1],
    ):
        assert "nan" not in text
        assert "inf" not in text
        assert "None" not in text
        assert "\N{EN DASH} left" in text


def test_an_empty_row_shows_as_well() -> None:
    assert len(screen(60, lambda display: display.update({}, 0.0, None))) > 10
    assert "iteration \N{EN DASH}" in lines(lambda display, clock: display.update({}, 0.0, None))[-1]


def test_a_share_beyond_the_budget_is_shown_as_all_of_it() -> None:
    assert "100 %" in "\n".join(screen(80, lambda display: display.update(ROW, 1.02, 0.0)))


def test_square_brackets_are_text_not_markup() -> None:
    text = lines(lambda display, clock: display.message("runs/[red]/a [/] :car:"))[-1]
    assert text == "runs/[red]/a [/] :car:"


def test_a_message_stands_above_the_panel() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=80, height=24, color_system=None)
    with ProgressDisplay(console, HEADER, Clock()) as display:
        display.message("first complete lap")
    text = file.getvalue()
    assert text.index("first complete lap") < text.rindex("╭")


def test_without_a_terminal_there_are_single_plain_lines() -> None:
    written = lines(lambda display, clock: display.update(ROW, 0.67, 23.0))
    assert HEADER.folder in written[1]
    assert len(written) == 3
    assert "\x1b" not in "".join(written)
    for word in [
        "67 %",
        "655,360 steps",
        "15,096/s",
        "82.58",
        "99.5 %",
        "525",
        "96 %",
        "9.33 s",
        "0:23 left",
    ]:
        assert word in written[2]


def test_a_terminal_too_small_for_every_figure_keeps_those_that_matter() -> None:
    panel = screen(40, lambda display: display.update(ROW, 0.67, 23.0), height=16)
    text = "\n".join(panel)
    assert len(panel) < 16
    for word in ["iteration   40", "completion  99.5 %", "laps        525", "best lap    9.33 s", "67 %"]:
        assert word in text, word


def test_a_terminal_that_cannot_draw_in_place_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    file = io.StringIO()
    with ProgressDisplay(Console(file=file, force_terminal=True), HEADER, Clock()) as display:
        display.update(ROW, 0.67, 23.0)
    assert "\x1b" not in file.getvalue()
    assert "iteration 40" in file.getvalue()


def test_a_long_training_writes_a_line_a_minute_into_a_log() -> None:
    def act(display: ProgressDisplay, clock: Clock) -> None:
        for _ in range(3600):
            clock.now_s += 1.0
            display.update(ROW, 0.1, None)

    assert 60 < len(lines(act)) < 130


def test_plain_lines_come_at_a_limited_rate_and_the_last_row_is_never_lost() -> None:
    def act(display: ProgressDisplay, clock: Clock) -> None:
        for iteration in range(1, 104):
            display.update({"iteration": iteration}, 0.0, None)
            clock.now_s += LINE_S / 10

    iterations = [int(line.split("iteration ")[1].split()[0]) for line in lines(act)[2:]]
    assert iterations == [1, 11, 21, 31, 41, 51, 61, 71, 81, 91, 101, 103]


def test_the_last_row_is_drawn_when_the_training_raises() -> None:
    file = io.StringIO()

    def train() -> None:
        with ProgressDisplay(Console(file=file, width=80), HEADER, Clock()) as display:
            for iteration in (1, 2, 3):
                display.update({"iteration": iteration}, 0.0, None)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train()
    assert "iteration 3" in file.getvalue().splitlines()[-1]


TRACKS = tuple(f"track_{letter}" for letter in "abcdefghijklmnopqr")
SEVERAL = dataclasses.replace(HEADER, track="18 tracks", track_labels=TRACKS)
ROW_OF_TRACKS = {
    **ROW,
    "best_lap_time_s": None,
    "mean_lap_time_s": None,
    **{f"completion/{label}": 81.0 + number for number, label in enumerate(TRACKS)},
    **{f"best_lap_time_s/{label}": 20.25 + number for number, label in enumerate(TRACKS)},
}


def test_eighteen_tracks_fit_a_terminal_of_80_by_24_with_completion_and_best_lap_of_each() -> None:
    panel = screen(80, lambda display: display.update(ROW_OF_TRACKS, 0.5, 23.0), header=SEVERAL)
    text = "\n".join(panel)
    assert len(panel) < 24
    assert {len(line) for line in panel} == {80}
    for number, label in enumerate(TRACKS):
        assert re.search(rf"{label} +{81 + number} +{20.25 + number:.2f}\b", text), label
    for word in [
        "655,360",
        "99.5 %",
        "96 %",
        "525",
        "82.58",
        "1.538",
        "0.0003",
        "15,096",
        "2,489",
        "18 tracks",
    ]:
        assert word in text, word


@pytest.mark.parametrize(("width", "height"), [(40, 24), (60, 24), (60, 40), (80, 20), (200, 60)])
def test_the_panel_of_many_tracks_is_never_higher_or_wider_than_the_terminal(width: int, height: int) -> None:
    panel = screen(width, lambda display: display.update(ROW_OF_TRACKS, 0.5, 23.0), height, SEVERAL)
    assert len(panel) < height
    assert {len(line) for line in panel} == {min(width, 100)}


def test_a_plain_line_names_the_track_on_which_the_car_comes_least_far() -> None:
    def act(display: ProgressDisplay, clock: Clock) -> None:
        display.update({**ROW_OF_TRACKS, "completion/track_h": 12.34}, 0.5, 23.0)
        clock.now_s += 2 * LINE_S
        # Nothing ended there in this iteration: what was known of it holds.
        display.update({**ROW_OF_TRACKS, "completion/track_h": None}, 0.6, 20.0)

    assert "least 12.3 % on track_h" in lines(act, SEVERAL)[-1]
    assert "best lap" not in lines(act, SEVERAL)[-1]


@given(st.lists(st.floats(-1e6, 1e6), max_size=300), st.integers(1, 40))
def test_a_sparkline_is_never_wider_than_asked(values: list[float], width: int) -> None:
    drawn = sparkline(values, width)
    assert len(drawn) == min(width, len(values))
    assert set(drawn) <= set(SPARKS)


@given(st.lists(st.floats(0, 100), min_size=2, max_size=30))
def test_a_rising_curve_has_rising_bars(values: list[float]) -> None:
    drawn = sparkline(sorted(values), 30)
    assert list(drawn) == sorted(drawn)


def test_fixed_bounds_make_a_small_value_a_low_bar() -> None:
    assert sparkline([2.0, 3.0], 5, (0.0, 100.0)) == "▁▁"
    assert sparkline([0.0, 100.0, 250.0], 5, (0.0, 100.0)) == "▁██"


def test_the_view_says_how_many_episodes_the_share_of_laps_is_of() -> None:
    for width in (60, 120):
        file = io.StringIO()
        header = dataclasses.replace(HEADER, remembered=20)
        with ProgressDisplay(Console(file=file, width=width), header, lambda: 0.0) as display:
            display.update(ROW, 0.5, 10.0)
        assert "of last 20" in file.getvalue()
        assert "of last 50" not in file.getvalue()
