"""The documentation site, by `make docs`: it builds strictly, and every link of it leads somewhere."""

import html
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.docs, pytest.mark.timeout(600)]
HOW_TO = ("effect", "method", "system")
LOADED = {"script": "src", "img": "src", "iframe": "src"}  # and stylesheets: what a page needs beside itself


class Page(HTMLParser):
    """What a page links to, what it loads, and the anchors that it has."""

    def __init__(self, text: str):
        super().__init__()
        self.links, self.loaded, self.anchors = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and given.get("rel") in ("stylesheet", "icon"):
            self.loaded.append(given["href"])
        if tag in LOADED and LOADED[tag] in given:
            self.loaded.append(given[LOADED[tag]])


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Every page of a strict build, by its path; the site stays in out/site."""
    site = ROOT / "out" / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean", "--site-dir", str(site)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return {
        path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html")) if path.name != "404.html"
    }


def test_every_source_is_a_page(pages):
    site = ROOT / "out" / "site"
    sources = {p.relative_to(ROOT / "docs").with_suffix(".html").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert sources == {path.relative_to(site).as_posix() for path in pages}
    menu = pages[site / "index.html"].links
    assert not {page for page in sources - {"index.html"} if page not in menu}


def test_internal_links_lead_somewhere(pages):
    lost = []
    for path, page in pages.items():
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.is_file():
                lost.append(f"{path.name}: {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                lost.append(f"{path.name}: {link}: no such anchor")
    assert not lost


def test_external_links_are_well_formed(pages):
    """None is followed: nothing of a test needs the network."""
    odd = re.compile(r"[\s<>\"{}|\\^`]")
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                assert parts.scheme == "https" and "." in parts.netloc and not odd.search(link), f"{path.name}: {link}"


def test_nothing_is_loaded_from_elsewhere(pages):
    assert not [link for page in pages.values() for link in page.loaded if urlsplit(link).netloc]


def test_formulas_are_mathml(pages):
    text = (ROOT / "out" / "site" / "statistics.html").read_text(encoding="utf-8")
    assert text.count("<math ") >= 8 and "arithmatex" not in text


def test_examples_are_shown_whole(pages):
    text = "".join((ROOT / "out" / "site" / "howto" / f"{name}.html").read_text("utf-8") for name in HOW_TO)
    shown = html.unescape(re.sub(r"<[^>]+>", "", text))
    for path in (ROOT / "docs" / "examples").iterdir():
        assert path.suffix not in (".py", ".xml") or path.read_text(encoding="utf-8").strip() in shown, path.name


def test_the_catalogue_is_there(pages):
    from det2stoc_bayes.mismatch.effects import CATALOGUE

    text = (ROOT / "out" / "site" / "effects.html").read_text(encoding="utf-8")
    assert all(f"<code>{name}</code>" in text for name in CATALOGUE)


def test_the_api_has_signatures_and_docstrings(pages):
    from det2stoc_bayes import _LAZY

    text = (ROOT / "out" / "site" / "api" / "index.html").read_text(encoding="utf-8")
    for place in _LAZY.values():
        assert f'id="{place.replace(":", ".")}"' in text, place
    assert "What the believed model leaves out" in text
