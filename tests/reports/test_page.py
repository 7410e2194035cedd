"""What always holds of the two pages, that of a training and that of a sweep, in a real browser."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepracer_exp.reports.pages import log_report
from deepracer_exp.sweeps.report.page import write_study_page as write_sweep_report
from tests.browser import needs_chromium
from tests.page_html import Html
from tests.sweeps.studies import season as study

from .test_log_report import NASTY, nasty
from .test_log_report import season as recording
from .test_log_report import write_report as write_log_report

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def training(folder) -> Path:
    """The page of a training whose log holds scripts wherever a log has words."""
    return write_log_report(nasty(recording(), NASTY), folder / "training.html")


@pytest.fixture(scope="module")
def sweep(folder) -> Path:
    return write_sweep_report(study(folder / "runs", 60), folder / "sweep.html")


@pytest.fixture(scope="module", params=["training", "sweep"])
def page(request) -> Path:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def short(folder) -> Path:
    """The page of a training with four figures, two of them folded: all pages have one script."""
    few = ("lap_line", "training_progress", "waypoint_map")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(log_report, "MOST_FIRST", 2)
        patched.setattr(
            log_report,
            "SECTIONS",
            {
                title: [chart for chart in some if chart.__name__ in few]
                for title, some in log_report.SECTIONS.items()
            },
        )
        return write_log_report(recording(3), folder / "short.html")


def test_the_contents_lead_to_every_section_and_every_figure(page):
    read = Html(page.read_text(encoding="utf-8"))
    shown = {name for name in read.ids if not name.startswith("data-") and name not in ("plotly", "dark")}
    figures = {name for name in shown if name.startswith("figure-")}
    assert len(shown - figures) > 4
    assert len(figures) >= (4 if page.stem == "sweep" else 5)
    assert shown <= set(read.links) <= set(read.ids)


CONTRAST = """
(() => {
  const shine = (color) => {
    const [red, green, blue] = color.match(/[\\d.]+/g).map(Number)
      .map((one) => (one /= 255) <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4);
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const behind = (one) => {
    for (; one; one = one.parentElement) {
      const color = getComputedStyle(one).backgroundColor;
      if (!/, 0\\)|transparent/.test(color)) return color;
    }
  };
  const found = {};
  for (const one of document.querySelectorAll("h1, h2, p, dt, dd, a, td, th, summary, button, code, svg text")) {
    // Values in a heat map stand on its cells; the ranges of a parallel axis are transparent.
    if (!one.textContent.trim() || !one.checkVisibility() || one.closest(".heatmap-label")) continue;
    if (one instanceof SVGElement && getComputedStyle(one).fillOpacity === "0") continue;
    const color = one instanceof SVGElement ? getComputedStyle(one).fill : getComputedStyle(one).color;
    const paper = one.closest("[data-plot]")?.querySelector("svg.main-svg")?.style.background || behind(one);
    const [light, dim] = [shine(color), shine(paper)].sort((a, b) => b - a);
    found[`${one.tagName} ${color} on ${paper}`] = (light + 0.05) / (dim + 0.05);
  }
  return found;
})()
"""


@dataclass(frozen=True)
class Drawn:
    """A page with all its figures, as a reader sees it: drawing all of them takes seconds."""

    opened: dict[str, float]
    """What was seen before anything was scrolled or unfolded."""
    last_in_sight: list[str | None]
    """State of the last figure that is not folded, before it came into sight and then."""
    contents: dict[str, bool]
    """What the table of contents shows, read at the end of the page."""
    background: str
    contrasts: dict[str, float]
    """Of what is to be read, by element, its colour and what is behind it."""
    width: float
    wider: list[str]
    """Elements that reach beyond the window."""
    widest_figure: float
    """Of those that cannot be scrolled by themselves."""
    states: set[str]
    shares: bool
    """Whether a button would upload a figure."""
    complaints: list[str]
    asked_for: set[str]
    dialogs: int
    refused: list[bool]
    """Whether a script that is added and an address that is asked for are refused."""


VISIBLE = "[...document.querySelectorAll('[data-plot]')].filter(box => box.checkVisibility())"
OPENED = f"({{ figures: {VISIBLE}.length, height: document.documentElement.scrollHeight }})"
CONTENTS = """
(() => {
  const box = document.querySelector(".contents").getBoundingClientRect();
  const head = document.querySelector(".contents summary").getBoundingClientRect();
  const open = document.querySelector(".contents > details").open;
  return { inSight: box.top >= 0 && head.bottom <= innerHeight, open };
})()
"""
WIDER = (
    "[...document.querySelectorAll('main *')].filter(one => one.getBoundingClientRect().right > innerWidth"
    " && !one.closest('.wide')).map(one => one.outerHTML.slice(0, 200))"
)
NARROW = "[...document.querySelectorAll('[data-plot]')].filter(one => !one.style.minWidth)"
SHARES = "[...document.querySelectorAll('.modebar-btn')].some(b => /share/i.test(b.dataset.title))"
ADDED = (
    "(() => { const s = document.createElement('script'); s.textContent = 'window.got = 1';"
    " document.body.append(s); return window.got === undefined })()"
)
ASKED = "fetch('data:,x').then(() => false, () => true)"


def draw(tab, page: Path, scheme: str, width: int) -> Drawn:
    tab.renew()
    tab.prefer(scheme)
    tab.open(page, width=width)
    opened = tab.evaluate(OPENED)
    last = f"{VISIBLE}.at(-1)"
    before = tab.evaluate(f"{last}.dataset.state")
    tab.evaluate(f"{last}.scrollIntoView()")
    tab.wait_for(f"{last}.dataset.state")
    then = tab.evaluate(f"{last}.dataset.state")
    tab.evaluate("scrollTo(0, document.body.scrollHeight)")
    contents = tab.evaluate(CONTENTS)
    tab.draw_all()
    drawn = Drawn(
        opened=opened,
        last_in_sight=[before, then],
        contents=contents,
        background=tab.evaluate("getComputedStyle(document.body).backgroundColor"),
        contrasts=tab.evaluate(CONTRAST),
        width=tab.evaluate("document.documentElement.scrollWidth"),
        wider=tab.evaluate(WIDER),
        widest_figure=max(tab.evaluate(f"{NARROW}.map(one => one.layout.width)")),
        states=set(
            tab.evaluate("[...document.querySelectorAll('[data-plot]')].map(one => one.dataset.state)")
        ),
        shares=tab.evaluate(SHARES),
        complaints=list(tab.complaints),
        asked_for=tab.asked_for,
        dialogs=sum(event["method"] == "Page.javascriptDialogOpening" for event in tab.events),
        refused=[tab.evaluate(ADDED), tab.evaluate(ASKED)],
    )
    return drawn


@pytest.fixture(scope="module")
def on_phone(page, chromium) -> Drawn:
    """The page by day on a phone."""
    return draw(chromium, page, "light", 420)


@pytest.fixture(scope="module")
def on_screen(page, chromium) -> Drawn:
    """The page by night on a screen."""
    return draw(chromium, page, "dark", 1400)


def test_the_contents_stay_in_sight_wherever_one_reads(on_phone, on_screen):
    assert on_phone.contents == {"inSight": True, "open": False}
    assert on_screen.contents == {"inSight": True, "open": True}


def test_no_page_is_wider_than_a_phone_or_a_screen(on_phone, on_screen):
    for seen, width in ((on_phone, 420), (on_screen, 1400)):
        assert seen.width <= width
        assert seen.wider == []
        assert seen.widest_figure <= width


def test_every_figure_is_drawn_without_a_complaint_and_nothing_is_asked_for(on_phone, on_screen):
    for seen in (on_phone, on_screen):
        assert seen.states == {"drawn"}
        assert not seen.shares
        assert seen.complaints == []
        assert seen.asked_for <= {"file", "data", "blob"}
        assert seen.dialogs == 0


def test_the_policy_of_the_page_refuses_scripts_and_addresses(on_phone):
    assert on_phone.refused == [True, True]


def test_figures_are_drawn_when_they_come_into_sight(on_screen, page):
    before, then = on_screen.last_in_sight
    assert then == "drawn"
    assert before is None or page.stem == "sweep"  # some of its figures are in sight at once


def test_of_many_figures_six_are_open(training, on_screen, page):
    text = page.read_text(encoding="utf-8")
    assert text.count("data-plot=") == len(set(re.findall(r'data-plot="(\w+)"', text)))
    if page == training:
        assert text.count("data-plot=") > 20
        assert on_screen.opened["figures"] == 6
        assert on_screen.opened["height"] < 8_000


def test_words_of_page_and_figures_can_be_read_in_light_and_in_the_dark(on_phone, on_screen):
    for seen, is_dark in ((on_phone, False), (on_screen, True)):
        assert (max(map(int, re.findall(r"\d+", seen.background))) < 60) == is_dark
        assert any(name.startswith("text ") for name in seen.contrasts)
        # WCAG 2.2, 1.4.3; it leaves out what is not text to read.
        assert {name: ratio for name, ratio in seen.contrasts.items() if ratio < 4.5} == {}


def test_figures_follow_when_the_reader_goes_from_light_to_dark_prints_and_unfolds(short, tab):
    tab.open(short, height=300)
    figures, drawn = (f"document.querySelectorAll('[data-{one}]').length" for one in ("plot", "state=drawn"))
    assert 0 < tab.evaluate(drawn) < tab.evaluate(figures) == 4
    paper = "document.querySelector('[data-state=drawn]').layout.paper_bgcolor"
    assert tab.evaluate(paper) == "#ffffff"
    tab.prefer("dark")
    tab.wait_for(f"{paper} !== '#ffffff'")

    # A printed page has every figure and what was folded, in light, and then is as it was.
    tab.evaluate("document.querySelectorAll('main details').forEach(one => { one.open = false })")
    tab.evaluate(
        "addEventListener('beforeprint', () => {"
        " window.printed = [...document.querySelectorAll('[data-plot]')]"
        " .map(one => [one.dataset.state, one.layout.paper_bgcolor, one.getBoundingClientRect().height > 100]);"
        " window.closed = document.querySelectorAll('main details:not([open])').length })"
    )
    assert tab.print().startswith(b"%PDF")
    assert {tuple(one) for one in tab.evaluate("window.printed")} == {("drawn", "#ffffff", True)}
    assert tab.evaluate("window.closed") == 0
    assert tab.evaluate("document.querySelectorAll('main details[open]').length") == 0

    # What was drawn as wide as a sheet and is folded is drawn to size, and in the dark, when it is unfolded.
    box = "document.querySelector('[data-plot=waypoint_map]')"
    assert tab.evaluate(f"!{box}.checkVisibility()")
    tab.evaluate("document.querySelector('a[href=\"#figure-waypoint_map\"]').click()")
    tab.wait_for(f"{box}.checkVisibility() && {box}.layout.paper_bgcolor !== '#ffffff'")
    tab.wait_for(f"{box}.layout.width === {box}.clientWidth && {box}.clientHeight === {box}.layout.height")
    assert tab.complaints == []


def test_a_section_that_was_folded_stays_so_when_the_page_is_loaded_again(short, tab):
    tab.open(short)
    part = "document.querySelectorAll('details.part')[1]"
    tab.evaluate(f"{part}.open = true")
    height = f"{part}.getBoundingClientRect().height"
    before = tab.evaluate(height)
    tab.evaluate(f"{part}.querySelector('summary').click()")
    tab.wait_for(f"!{part}.open && history.state?.open?.includes(false)")
    assert tab.evaluate(height) < min(before, 60)
    tab.call("Page.reload")
    tab.wait_for(f"document.readyState === 'complete' && !{part}.open")


def test_the_button_beside_a_command_copies_it(sweep, tab):
    tab.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
    tab.open(sweep)
    tab.call("Page.bringToFront")
    lines = tab.evaluate("[...document.querySelectorAll('.command code')].map(one => one.textContent)")
    assert any(line.startswith("deepracer-exp train ") for line in lines)
    # The word stands for two seconds, which may all be between two looks.
    tab.evaluate(
        "for (const one of document.querySelectorAll('.command button')) new MutationObserver(() => one.said ="
        " [...(one.said ?? []), one.textContent]).observe(one, {childList: true, characterData: true, subtree: true})"
    )
    for at, line in enumerate(lines):
        tab.evaluate(f"document.querySelectorAll('.command button')[{at}].click()")
        tab.wait_for(f"document.querySelectorAll('.command button')[{at}].said?.includes('Copied')")
        assert tab.evaluate("navigator.clipboard.readText()") == line
