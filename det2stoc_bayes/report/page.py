"""One self-contained html file: template, style, scripts, plotly.js and three.js; nothing is loaded from anywhere."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from det2stoc_bayes.report.canvas import Spec


def render(template: str, **context: Any) -> str:
    """The page as html text; what the context holds is escaped, since names come from users."""
    return _environment().get_template(template).render(asset=asset, plotly=lambda: Markup(get_plotlyjs()), **context)


def asset(name: str, folder: str = "templates") -> Markup:
    """A style or script of the package as it stands."""
    return Markup((files("det2stoc_bayes.report") / folder / name).read_text("utf-8"))


def embedded(figure: Spec) -> Markup:
    """A figure as JSON that can stand inside a script element."""
    text = json.dumps(figure, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("det2stoc_bayes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
