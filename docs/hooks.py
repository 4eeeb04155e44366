"""What the site's build does besides: formulas as MathML, the table of effects, pages that the menu does not name."""

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

EFFECTS = "<!-- the catalogue of effects -->"
MORE = "More"
FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)


def on_config(config: Any) -> Any:
    """Pages of docs/ that the menu does not name are found under `More`."""
    named = re.findall(r"[\w/]+\.md", str(config["nav"]))
    folder = Path(config["docs_dir"])
    there = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.md"))
    if more := [page for page in there if page not in named]:
        config["nav"].append({MORE: more})
    return config


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The catalogue as a table, from the catalogue."""
    return markdown.replace(EFFECTS, effects_table()) if EFFECTS in markdown else markdown


def on_page_content(content: str, **_: Any) -> str:
    """Formulas as MathML, which browsers show without a script."""
    return FORMULA.sub(_formula, content)


def _formula(found: re.Match[str]) -> str:
    text = html.unescape(found[2]).strip()
    display = "block" if found[1] == "div" else "inline"
    return convert(
        text.removeprefix(r"\(").removeprefix(r"\[").removesuffix(r"\)").removesuffix(r"\]"), display=display
    )


def effects_table() -> str:
    """One line an effect: name, where it sits, law, parameters, what its docstring says."""
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    lines = ["| name | on | law | parameters | |", "|---|---|---|---|---|"]
    for effect in CATALOGUE.values():
        units = [
            (p.name, p.unit if isinstance(p.unit, str) else ", ".join(dict.fromkeys(p.unit))) for p in effect.parameters
        ]
        parameters = ", ".join(f"{name} [{unit}]" for name, unit in units)
        said = (effect.__doc__ or "").splitlines()[0]
        cells = (f"`{effect.name}`", effect.kind, f"`{effect.law_text}`", parameters, said)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)
