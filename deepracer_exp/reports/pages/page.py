"""HTML pages in a single file: text, tables, and figures that stay packed until they are scrolled into view."""

import base64
import gzip
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from deepracer_exp.reports.charts.style import DARK, NARROW_WIDTH, Figure
from deepracer_exp.streams import without_accounts

if TYPE_CHECKING:
    from deepracer_exp.reports.charts.figure import Chart


@dataclass(frozen=True)
class Plot:
    """A figure as a page holds it."""

    name: str
    """Letters, digits, - and _."""
    title: str
    height: int
    """Pixels it takes, kept free until it is drawn."""
    phone_height: int
    """Height on a narrow screen."""
    least_width: int
    """Pixels below which it scrolls sideways; 0: it gets as narrow as the page."""
    packed: str
    """The figure's JSON, gzip in base64."""


@dataclass(frozen=True)
class Glimpse:
    """A policy's view in one step of a drive; both pictures as `png_uri` returns them."""

    seen: str
    looked: str
    """The picture under its saliency; empty where the policy is not known."""
    where: str
    decision: str


def png_uri(png: bytes) -> str:
    """Return a picture as a data URI."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def plot(figure: Figure, name: str, title: str, narrow: Figure, least_width: int = 0) -> Plot:
    """Pack a figure, whose layout has a height; `narrow` holds the same traces, laid out for a narrow screen."""
    desk, phone = figure["layout"], narrow["layout"]
    changed = {key: value for key, value in phone.items() if value != desk.get(key)}
    text = figure_json(figure | {"narrow": changed})
    packed = gzip_base64(text.encode())
    return Plot(name, title, int(desk["height"]), int(phone["height"]), least_width, packed)


def figure_json(figure: Figure) -> str:
    """Return a figure as JSON, with arrays of numbers as plotly.js reads them fastest: their bytes in base64.

    Raises:
        ValueError: a number outside an array is not finite.
    """
    return without_accounts(json.dumps(figure, default=_array, allow_nan=False, separators=(",", ":")))


def _array(values: NDArray[np.float32]) -> dict[str, str] | list[float]:
    # plotly.js does not draw an empty array of bytes.
    if not values.size:
        return values.tolist()
    data = base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")
    return {"dtype": "f4", "bdata": data, "shape": ",".join(map(str, values.shape))}


def plot_of(chart: "Chart") -> Plot:
    """Draw a chart for desk and phone, and pack it."""
    # Imported here: a chart needs pandas, and the figures of a sweep are no charts.
    from deepracer_exp.reports.charts.layout import draw

    return plot(draw(chart), chart.name, chart.title, draw(chart, NARROW_WIDTH))


def gzip_base64(text: bytes) -> str:
    """Return a text as gzip in base64, the same for the same text."""
    # Half the time of the usual level, for a page that is three per cent larger.
    return base64.b64encode(gzip.compress(text, 4, mtime=0)).decode("ascii")


def render(
    package: str,
    template: str,
    plots: Sequence[Plot],
    is_live: bool = False,
    scripts: Sequence[str] = (),
    **values: Any,
) -> str:
    """Return a page that extends `page.html.j2`; all values are escaped, and it can load nothing.

    A live page alone may ask its own server for `version`, and is loaded again when that has changed.

    Args:
        package: where the template is.
        template: its file; its sections are the macro `part`, which enters them into `contents`.
        plots: all figures of the page.
        is_live: it is served, with its version in the block `version`.
        scripts: files beside the template that the page runs after its own.
        values: for the template.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(package, "."), jinja2.PackageLoader(__package__, ".")]
        ),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: without_accounts(value) if type(value) is str else value,
    )
    # The colour of a figure for CSS.
    environment.filters["themed"] = lambda color: f"light-dark({color}, {DARK.get(color.lower(), color)})"
    sources = [(__package__, "page.js"), *((package, name) for name in scripts)]
    texts = [(files(place) / name).read_text(encoding="utf-8") for place, name in sources]
    return environment.get_template(template).render(
        policy=_policy(*map(str.encode, texts), _plotly()) + ("; connect-src 'self'" if is_live else ""),
        contents=[],
        plots=plots,
        dark=Markup(json.dumps(DARK)),  # our own colours
        plotly=_packed_plotly() if plots else "",
        scripts=[Markup(text) for text in texts],  # our own files
        **values,
    )


def _policy(*scripts: bytes) -> str:
    """Return the content security policy: these scripts only, and no network.

    Plotly compiles functions from text to draw with WebGL.
    """
    digests = (base64.b64encode(hashlib.sha256(script).digest()).decode() for script in scripts)
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {hashes} 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )


@cache
def _plotly() -> bytes:
    """Return plotly.js from its Python package."""
    return (files("plotly") / "package_data" / "plotly.min.js").read_bytes()


@cache
def _packed_plotly() -> str:
    return gzip_base64(_plotly())
