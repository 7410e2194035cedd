"""What always holds of the two pages, that of a training and that of a sweep, in a real browser."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from deepracer_exp.sweeps.report.page import write_study_page as write_sweep_report
from tests.browser import needs_chromium
from tests.page_html import Html
from tests.sweeps.studies import season as study

from .test_log_report import season as recording
from .test_log_report import write_report as write_log_report

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module", params=["training", "sweep"])
def page(request, folder) -> Path:
    path = folder / f"{request.param}.html"
    if request.param == "training":
        return write_log_report(recording(), path)
    return write_sweep_report(study(folder / "runs", 60), path)


def test_the_contents_lead_to_every_section_and_every_figure(page):
    read = Html(page.read_text(encoding="utf-8"))
    shown = {name for name in read.ids if not name.startswith("data-") and name not in ("plotly", "dark")}
    figures = {name for name in shown if name.startswith("figure-")}
    assert len(shown - figures) > 4
    assert len(figures) >= (4 if page.stem == "sweep" else 5)
    assert shown <= set(read.links) <= set(read.ids)


def test_the_contents_stay_in_sight_wherever_one_reads(page, tab):
    box = "document.querySelector('.contents').getBoundingClientRect()"
    head = "document.querySelector('.contents summary').getBoundingClientRect()"
    for width in (1400, 420):
        tab.open(page, width=width)
        tab.evaluate("scrollTo(0, document.body.scrollHeight)")
        assert tab.evaluate(f"{box}.top >= 0 && {head}.bottom <= innerHeight")
        assert tab.evaluate("document.querySelector('.contents > details').open") == (width == 1400)


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
    """A page with all its figures, as a reader sees it."""

    background: str
    contrasts: dict[str, float]
    """Of what is to be read, by element, its colour and what is behind it."""
    width: float
    wider: list[str]
    """Elements that reach beyond the window."""
    widest_figure: float
    """Of those that cannot be scrolled by themselves."""
    states: set[str]
    complaints: list[str]
    asked_for: set[str]


WIDER = (
    "[...document.querySelectorAll('main *')].filter(one => one.getBoundingClientRect().right > innerWidth"
    " && !one.closest('.wide')).map(one => one.outerHTML.slice(0, 200))"
)
NARROW = "[...document.querySelectorAll('[data-plot]')].filter(one => !one.style.minWidth)"


def draw(tab, page: Path, scheme: str, width: int) -> Drawn:
    tab.renew()
    tab.prefer(scheme)
    tab.open(page, width=width)
    tab.draw_all()
    return Drawn(
        background=tab.evaluate("getComputedStyle(document.body).backgroundColor"),
        contrasts=tab.evaluate(CONTRAST),
        width=tab.evaluate("document.documentElement.scrollWidth"),
        wider=tab.evaluate(WIDER),
        widest_figure=max(tab.evaluate(f"{NARROW}.map(one => one.layout.width)")),
        states=set(
            tab.evaluate("[...document.querySelectorAll('[data-plot]')].map(one => one.dataset.state)")
        ),
        complaints=tab.complaints,
        asked_for=tab.asked_for,
    )


@pytest.fixture(scope="module")
def on_phone(page, chromium) -> Drawn:
    """The page by day on a phone: drawing all figures takes seconds."""
    return draw(chromium, page, "light", 420)


@pytest.fixture(scope="module")
def on_screen(page, chromium) -> Drawn:
    """The page by night on a screen."""
    return draw(chromium, page, "dark", 1400)


def test_no_page_is_wider_than_a_phone(on_phone):
    assert on_phone.width <= 420
    assert on_phone.wider == []
    assert on_phone.widest_figure <= 420


def test_every_figure_is_drawn_without_a_complaint_and_nothing_is_asked_for(on_phone, on_screen):
    for seen in (on_phone, on_screen):
        assert seen.states == {"drawn"}
        assert seen.complaints == []
        assert seen.asked_for <= {"file", "data", "blob"}


def test_words_of_page_and_figures_can_be_read_in_light_and_in_the_dark(on_phone, on_screen):
    for seen, is_dark in ((on_phone, False), (on_screen, True)):
        assert (max(map(int, re.findall(r"\d+", seen.background))) < 60) == is_dark
        assert any(name.startswith("text ") for name in seen.contrasts)
        # WCAG 2.2, 1.4.3; it leaves out what is not text to read.
        assert {name: ratio for name, ratio in seen.contrasts.items() if ratio < 4.5} == {}


def test_figures_follow_when_the_reader_goes_from_light_to_dark(page, tab):
    tab.open(page, height=3000)
    paper = "document.querySelector('[data-state=drawn]').layout.paper_bgcolor"
    assert tab.evaluate(paper) == "#ffffff"
    tab.prefer("dark")
    tab.wait_for(f"{paper} !== '#ffffff'")


def test_a_printed_page_has_every_figure_and_what_was_folded_without_scrolling(page, tab):
    tab.prefer("dark")
    tab.open(page, height=300)
    drawn = "document.querySelectorAll('[data-state=drawn]').length"
    assert tab.evaluate(drawn) < tab.evaluate("document.querySelectorAll('[data-plot]').length")
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
    assert tab.complaints == []


def test_a_section_that_was_folded_stays_so_when_the_page_is_loaded_again(page, tab):
    tab.open(page)
    part = "document.querySelectorAll('details.part')[1]"
    tab.evaluate(f"{part}.open = true")
    height = f"{part}.getBoundingClientRect().height"
    before = tab.evaluate(height)
    tab.evaluate(f"{part}.querySelector('summary').click()")
    tab.wait_for(f"!{part}.open && history.state?.open?.includes(false)")
    assert tab.evaluate(height) < min(before, 60)
    tab.call("Page.reload")
    tab.wait_for(f"document.readyState === 'complete' && !{part}.open")
    tab.evaluate(f"{part}.open = true")


def test_the_button_beside_a_command_copies_it(tab, folder):
    page = write_sweep_report(study(folder / "copied", 12), folder / "copied.html")
    tab.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
    tab.open(page)
    tab.call("Page.bringToFront")
    lines = tab.evaluate("[...document.querySelectorAll('.command code')].map(one => one.textContent)")
    assert any(line.startswith("deepracer-exp train ") for line in lines)
    for at, line in enumerate(lines):
        tab.evaluate(f"document.querySelectorAll('.command button')[{at}].click()")
        tab.wait_for(f"document.querySelectorAll('.command button')[{at}].textContent === 'Copied'")
        assert tab.evaluate("navigator.clipboard.readText()") == line
