"""The list of results and two of them side by side, as a browser shows them."""

import threading
from collections.abc import Iterator

import pytest
from chromium import LAPTOP, NEEDS, PHONE, opened, started, until
from made_results import write_results
from playwright.sync_api import Browser

from det2stoc_bayes.server import Results

pytestmark = NEEDS
SHOWN = "[...document.querySelectorAll('tbody tr')].filter((row) => row.offsetParent)"
ROWS = f"{SHOWN}.map((row) => row.cells[1].innerText)"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started() as one:
        yield one


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with Results(write_results(tmp_path_factory.mktemp("results")), port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.url
        server.shutdown()


@pytest.mark.parametrize("size, scheme", [(LAPTOP, "light"), (PHONE, "dark")])
def test_the_list_filters_and_two_are_compared(browser, url, size, scheme) -> None:
    with opened(browser, url, size, scheme) as page:
        assert len(page.evaluate(ROWS)) == 7
        page.locator("#filter").fill("dry FRICTION wrist")
        assert sorted(page.evaluate(ROWS)) == ["first", "second"]
        assert "2 of 7 shown" in page.locator("#told").inner_text()
        page.locator("#filter").fill("")
        page.locator("#kind").select_option("calibration")
        assert page.evaluate(ROWS) == ["ranks"]
        page.locator("#kind").select_option("")
        assert page.locator("#compare").get_attribute("href") is None
        for name in ("first", "second"):
            page.get_by_label(f"Choose {name}").press("Space")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        links = page.locator("a.compare")
        assert links.count() == 2 and links.nth(1).get_attribute("href") == links.nth(0).get_attribute("href")
        page.locator("#compare").press("Enter")
        until(page, "document.getElementById('differing')?.checked === false")
        assert sorted(page.locator("h1").inner_text().split(" beside ")) == ["first", "second"]
        every = page.evaluate(f"{SHOWN}.length")
        page.locator("#differing").press("Space")
        assert 0 < page.evaluate(f"{SHOWN}.length") < every
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.get_by_role("link", name="first").click()
        until(page, "document.body.innerText === 'first'")


def test_enter_in_a_ticked_box_opens_the_comparison(browser, url) -> None:
    with opened(browser, url) as page:
        page.get_by_label("Choose first").press("Space")
        page.get_by_label("Choose first").press("Enter")  # one is no comparison
        page.get_by_label("Choose second").press("Space")
        assert "Enter compares them" in page.locator("#told").inner_text()
        page.get_by_label("Choose second").press("Enter")
        until(page, "document.getElementById('differing')?.checked === false")
