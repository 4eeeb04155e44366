"""A headless Chromium for tests of pages; they are skipped, and that is told, where there is none."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from playwright.sync_api import Browser, Error, Page, sync_playwright

FOUND = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NEEDS = [pytest.mark.browser, pytest.mark.skipif(FOUND is None, reason="no Chromium here: make browser")]
LAPTOP, PHONE = {"width": 1366, "height": 768}, {"width": 390, "height": 844}
WEBGL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # drawn by the processor


@contextmanager
def started() -> Iterator[Browser]:
    """One browser for a module's tests."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=FOUND, args=["--no-sandbox", *WEBGL])
        yield browser
        browser.close()


def until(page: Page, condition: str, seconds: float = 30.0) -> None:
    """Wait until an expression holds; `wait_for_function` would need eval, which the pages forbid."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with suppress(Error):  # of a page that is being left
            if page.evaluate(condition):
                return
        page.wait_for_timeout(30)
    raise AssertionError(f"never: {condition}")


@contextmanager
def opened(browser: Browser, url: str, size: dict[str, int] = LAPTOP, scheme: Any = "light") -> Iterator[Page]:
    """A page that must neither say anything on the console nor ask for anything from elsewhere."""
    phone = size is PHONE
    context = browser.new_context(viewport=size, color_scheme=scheme, has_touch=phone, is_mobile=phone)  # pyright: ignore
    page, said, asked = context.new_page(), [], []
    page.set_default_timeout(20_000)
    page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: said.append(f"error: {error}"))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(url)
    yield page
    context.close()
    origin = "/".join(url.split("/")[:3])
    assert [text for text in said if "GPU stall" not in text] == []  # what the processor's WebGL says of screenshots
    assert [one for one in asked if not one.startswith((origin, "blob:", "data:"))] == []
