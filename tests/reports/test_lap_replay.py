"""Two laps that drive beside each other on one page."""

from pathlib import Path

import numpy as np
import pytest

from deepracer_exp.reports.pages.lap_replay import laps_of_log, write_replay
from deepracer_exp.reports.tables.log_view import LogView, prepare
from tests.browser import needs_chromium
from tests.conftest import refused
from tests.page_html import Html
from tests.reports.tables.made_up import Drive, made_up_course, made_up_recording

FAST, SLOW = Drive(speed_mps=2.0, offset_m=0.1), Drive(speed_mps=1.6, offset_m=-0.1)


def view(*drives: Drive, name: str, course: str = "reinvent_base") -> LogView:
    return prepare(made_up_recording(drives, course=course, name=name))


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    laps = laps_of_log(view(FAST, name="fast"), view(SLOW, name="slow"))
    return write_replay(tmp_path_factory.mktemp("replay") / "laps.html", laps)


def test_a_lap_is_replayed_by_the_clock_of_its_lap_time():
    one = view(FAST, SLOW, SLOW, name="log")
    laps = laps_of_log(one, None)
    assert [lap.words.partition(" (")[0] for lap in laps] == ["the fastest", "an ordinary lap"]
    for lap, drive in zip(laps, (FAST, SLOW), strict=True):
        assert lap.lap_time_s in set(one.episodes["lap_time_s"])
        assert lap.time_s[-1] == lap.lap_time_s
        assert np.median(lap.speed_mps) == pytest.approx(drive.speed_mps, rel=0.1)


def test_the_rival_of_a_lap_began_where_it_did():
    rival = view(Drive(speed_mps=2.2, start=0.5), SLOW, name="rival")
    first, second = laps_of_log(view(FAST, name="mine"), rival)
    assert (second.driven[0] - first.driven[0] + 0.5) % 1 == pytest.approx(0.5, abs=0.02)
    assert second.lap_time_s > first.lap_time_s


def test_laps_of_two_tracks_or_of_two_directions_or_none_are_refused(tmp_path):
    mine = view(FAST, name="mine")
    other = laps_of_log(mine, view(FAST, name="oval", course="Oval_track"))
    message = refused(write_replay, tmp_path / "laps.html", other)
    assert "oval: drove on Oval" in message
    assert "accepted: two laps on the same track" in message
    assert "no complete lap" in refused(laps_of_log, mine, view(Drive(until=0.5), name="half"))
    assert "one complete lap only" in refused(laps_of_log, mine, None)
    assert not (tmp_path / "laps.html").exists()


def test_the_page_names_both_laps_and_loads_nothing(page):
    read = Html(page.read_text(encoding="utf-8"))
    assert read.loads == []
    for words in ("Lap replay", "A fast", "B slow", "the fastest (iteration 0, episode 0)"):
        assert words in read.text


SHOWN = """
(() => {
  const box = document.querySelector("[data-plot]");
  const row = (at) => [...document.querySelectorAll("tr[data-lap]")[at].cells].slice(1).map((one) => one.textContent);
  const car = (lap) => box.data.find((one) => one.meta?.lap === lap && one.meta.x === "x");
  return [0, 1].map((lap) => ({ row: row(lap), x: car(lap).x.at(-1), y: car(lap).y.at(-1) }));
})()
"""


@needs_chromium
def test_the_slider_puts_both_cars_where_they_were_at_its_time(page, tab):
    tab.open(page)
    tab.evaluate("document.querySelector('[data-plot]').scrollIntoView()")
    tab.wait_for("document.querySelector('[data-plot]').dataset.state === 'drawn'")
    tab.evaluate(
        "(() => { const slider = document.querySelector('#time'); slider.value = 5;"
        " slider.dispatchEvent(new Event('input')) })()"
    )
    shown, course = tab.evaluate(SHOWN), made_up_course()
    for drive, car in zip((FAST, SLOW), shown, strict=True):
        driven = 5.0 * drive.speed_mps / course.length_m
        found = course.project(np.array([[car["x"], car["y"]]]))
        assert found.ndist[0] == pytest.approx(driven, abs=0.02)
        assert found.offset_m[0] == pytest.approx(drive.offset_m, abs=0.03)
        assert float(car["row"][0]) == pytest.approx(100 * driven, abs=2)
        assert float(car["row"][1]) == pytest.approx(drive.speed_mps, abs=0.2)
    # Where the slow car is after 5 s, the fast one was after 4.
    assert shown[0]["row"][3] == ""
    assert float(shown[1]["row"][3]) == pytest.approx(1.0, abs=0.15)
    tab.evaluate("document.querySelector('#play').click()")
    tab.wait_for("Number(document.querySelector('#time').value) > 5.1")
    assert tab.complaints == []
    assert tab.asked_for <= {"file", "data", "blob"}
