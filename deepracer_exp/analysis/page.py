"""HTML pages that need nothing beside them: words and tables as they are, figures packed until they are seen."""

import base64
import gzip
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup
from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs
from plotly.utils import PlotlyJSONEncoder

_DEFAULT_HEIGHT = 450


@dataclass(frozen=True)
class Plot:
    """A figure as a page holds it."""

    name: str
    """Letters, digits, - and _."""
    height: int
    """Pixels it takes, kept free until it is drawn."""
    packed: str
    """Its JSON, gzip in base64."""


def plot(figure: Figure, name: str) -> Plot:
    """Pack a figure.

    Args:
        figure: its layout may have a height.
        name: of the element and of the picture that a reader saves.
    """
    text = json.dumps(figure.to_plotly_json(), cls=PlotlyJSONEncoder, separators=(",", ":"))
    return Plot(name, int(figure.layout.height or _DEFAULT_HEIGHT), packed(text))


def packed(text: str) -> str:
    """Return a text as gzip in base64, the same for the same text."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode("ascii")


def render(package: str, template: str, plots: Sequence[Plot], **values: Any) -> str:
    """Return a page that extends `page.html.j2`; what it holds is escaped, and it can load nothing.

    Args:
        package: where the template is.
        template: its file; it includes `plot.html.j2` with `plot` where a figure stands.
        plots: all figures of the page.
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
    )
    script = _script()
    return environment.get_template(template).render(
        policy=_policy(script, get_plotlyjs()),
        plots=plots,
        plotly=_packed_plotly() if plots else "",
        script=Markup(script),  # our own file
        **values,
    )


def _policy(*scripts: str) -> str:
    """Return what the browser is to allow: these scripts, no others, and no address.

    Plotly makes functions of text to draw with WebGL.
    """
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts)
    return (
        f"default-src 'none'; script-src {hashes} 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def _script() -> str:
    return (files(__package__) / "page.js").read_text(encoding="utf-8")


@cache
def _packed_plotly() -> str:
    return packed(get_plotlyjs())
