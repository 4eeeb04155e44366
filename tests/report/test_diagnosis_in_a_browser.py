"""The page of a diagnosis in a browser: figures, replay, one moment for all, keyboard, both themes."""

from collections.abc import Iterator

import pytest
from chromium import LAPTOP, NEEDS, PHONE, opened, started, until
from playwright.sync_api import Browser, Page

pytestmark = NEEDS
PAPER = {"light": "rgb(253, 253, 251)", "dark": "rgb(20, 23, 26)"}
FIRST = {
    "mismatch": ["Coulomb friction", "joint wrist", "97 %", "83 % less"],
    "no_mismatch": ["No physics is missing", "43 explanations tried"],
    "inconclusive": ["payload mass", "body hand", "55 %"],
}
CURSORS = """[...document.querySelectorAll('[data-time] > .cursor')].filter(line => line.offsetParent && !line.hidden)
    .map(line => Math.round(line.getBoundingClientRect().x - line.parentElement.getBoundingClientRect().x))"""
PLOTS = "[...page.drawn].filter((plot) => plot.matches('[data-time]') && page.visible(plot))"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started() as one:
        yield one


@pytest.fixture(scope="module")
def url(html: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(html, "utf-8")
    return path.as_uri()


@pytest.fixture(scope="module")
def loaded(browser: Browser, url: str) -> Iterator[Page]:
    """A laptop's, at the recordings."""
    with opened(browser, url) as shown:
        shown.evaluate("document.getElementById('recording').scrollIntoView()")
        until(shown, f"{PLOTS}.length >= 2 && document.getElementById('stage').dataset.drawn > 0")
        yield shown


@pytest.fixture
def page(loaded: Page) -> Page:
    """The same, at the recording's begin."""
    loaded.locator("#recording").select_option(index=0)
    loaded.evaluate("clock.set(clock.state.begin)")
    loaded.locator("#magnify").select_option("1")
    loaded.locator("#view").click()
    loaded.locator("#recording").focus()
    loaded.mouse.move(5, 5)
    return loaded


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_it_opens_where_most_is_to_be_seen(browser, url, fit) -> None:
    with opened(browser, url) as page:
        begin = float(page.locator(".recording").first.get_attribute("data-worst") or "nan")
        until(page, "document.getElementById('magnify').value === '3'")
        assert _now(page) == pytest.approx(begin, abs=0.02) and begin > 0
        assert not page.evaluate("clock.state.playing")
        assert page.locator("#stage-note").inner_text() == "Differences are drawn 3 times as large as they are."
        assert "+ and − to zoom, space to play, 0 to reset the view" in page.locator(".moment").inner_text()
        page.locator("#magnify").select_option("10")
        assert "10 times" in page.locator("#stage-note").inner_text()
        page.locator("#next").press("Enter")
        page.locator("#previous").press("Enter")
        assert page.locator("#magnify").input_value() == "10"  # the reader's choice stays
        page.locator("a[href='#word-psi']").click()
        until(page, "document.querySelector('details.words').open")


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_explanations_fit_on_a_phone_and_what_does_not_fades(browser, url) -> None:
    with opened(browser, url, PHONE, "dark") as page:
        table = page.locator("table.explanations").first
        assert table.evaluate("(one) => one.parentElement.scrollWidth <= one.parentElement.clientWidth")
        tall = table.evaluate("(one) => [...one.rows].map((row) => row.offsetHeight)")
        assert max(tall) < 130
        for place in ("nav ul", ".scroll"):
            assert "local" in page.locator(place).first.evaluate("(one) => getComputedStyle(one).backgroundAttachment")


def _now(page: Page) -> float:
    return float(page.locator("#time").input_value())


def _seen(page: Page) -> bytes:
    """The replay's pixels, once all that was asked for is drawn."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.locator("#stage").screenshot()


@pytest.mark.parametrize(
    "verdict, size, scheme",
    [
        ("mismatch", LAPTOP, "light"),
        ("mismatch", PHONE, "dark"),
        ("no_mismatch", PHONE, "light"),
        ("inconclusive", LAPTOP, "dark"),
    ],
    indirect=["verdict"],
)
def test_every_figure_is_drawn_and_the_first_screen_says_it_all(browser, url, verdict, size, scheme) -> None:
    with opened(browser, url, size, scheme) as page:
        for text in FIRST[verdict]:
            there = page.locator("header").get_by_text(text, exact=False).first.bounding_box()
            assert there is not None and there["y"] + there["height"] <= size["height"], text
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        until(page, "[...document.querySelectorAll('.figure')].every((one) => one.data || !page.visible(one))")
        page.evaluate("document.getElementById('stage').scrollIntoView()")
        until(page, "document.getElementById('stage').dataset.drawn > 0")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        paper = "getComputedStyle(document.body).backgroundColor"
        assert page.evaluate(paper) == PAPER[scheme]
        line = "document.querySelector('[data-time]').data.find((trace) => trace.meta === 'recorded').line.color"
        before = page.evaluate(line)
        page.locator("#theme").click()
        until(page, f"{line} !== '{before}'")
        assert page.evaluate(paper) == PAPER["dark" if scheme == "light" else "light"]
        colours = (
            "['before', 'after'].map((n) => getComputedStyle(document.documentElement).getPropertyValue(`--${n}`))"
        )
        assert len(set(page.evaluate(colours))) == (1 if verdict == "no_mismatch" else 2)  # one model, one colour


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_slider_plots_and_replay_share_one_moment(page) -> None:
    begin = _seen(page)
    page.locator("#time").focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    step = 20 * 8.99 / 300
    assert _now(page) == pytest.approx(step, abs=0.02)
    assert page.locator("#now").inner_text() == f"{_now(page):.2f} s"
    lines = page.evaluate(CURSORS)
    assert len(lines) == 2 and len(set(lines)) == 1
    assert _seen(page) != begin
    plot = page.locator("[data-time]").first.bounding_box()
    assert plot is not None
    page.mouse.move(plot["x"] + 0.6 * plot["width"], plot["y"] + 60)
    moved = _now(page)
    assert 4 < moved < 7
    after = page.evaluate(CURSORS)
    assert len(set(after)) == 1 and after[0] > lines[0]
    assert after[0] == pytest.approx(0.6 * plot["width"], abs=2)


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_it_plays_and_pauses_by_mouse_and_keyboard(page) -> None:
    page.locator("#play").click()
    until(page, "clock.state.now > 0.1")
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    page.locator("#play").click()
    held = _now(page)
    page.wait_for_timeout(120)
    assert _now(page) == held
    page.locator("#stage").focus()
    page.keyboard.press(" ")
    until(page, f"clock.state.now > {held} + 0.1")
    page.keyboard.press(" ")
    assert not page.evaluate("clock.state.playing")
    page.evaluate("clock.set(clock.state.end - 0.05)")
    page.locator("#play").press("Enter")
    until(page, "!clock.state.playing && clock.state.now === clock.state.end")


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_the_camera_turns_by_mouse_and_keyboard(page) -> None:
    home = _seen(page)
    page.locator("#stage").focus()
    for key in ("ArrowRight", "ArrowUp", "+"):
        page.keyboard.press(key)
    assert (turned := _seen(page)) != home
    page.keyboard.press("0")
    page.locator("#recording").focus()  # the ring about what has the focus would show
    assert _seen(page) == home
    box = page.locator("#stage").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 200, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + 120, steps=3)
    page.mouse.up()
    page.mouse.move(5, 5)
    assert _seen(page) not in (home, turned)


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_legend_entries_are_left_out_of_plots_and_replay(page) -> None:
    page.evaluate("clock.set(2.0)")
    page.locator("#magnify").select_option("10")
    page.locator("#recording").focus()
    whole = _seen(page)
    entry = page.locator("#rollouts .legend button[data-part=before]")
    entry.press("Enter")
    page.locator("#recording").focus()
    shown = f"{PLOTS}.map((plot) => plot.data.filter((t) => t.meta === 'before').map((t) => t.visible)).flat()"
    assert set(page.evaluate(shown)) == {False}
    assert {same.get_attribute("aria-pressed") for same in page.locator("button[data-part=before]").all()} == {"false"}
    assert _seen(page) != whole
    entry.press("Enter")
    page.locator("#recording").focus()
    assert set(page.evaluate(shown)) == {True} and _seen(page) == whole


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_plots_over_time_zoom_together(page) -> None:
    ranges = f"{PLOTS}.map((plot) => plot._fullLayout.xaxis.range.map((x) => Math.round(100 * x) / 100).join())"
    page.evaluate("clock.set(4.0)")
    whole = set(page.evaluate(ranges))
    page.locator("#zoom-in").press("Enter")
    until(page, f"new Set({ranges}).size === 1 && {ranges}[0] !== '{whole.pop()}'")
    low, high = map(float, page.evaluate(ranges)[0].split(","))
    assert high - low == pytest.approx(8.99 / 2, abs=0.02) and low < 4 < high
    plot = page.locator("[data-time]").first.bounding_box()
    assert plot is not None
    page.mouse.move(plot["x"] + 150, plot["y"] + 80)
    page.mouse.down()
    page.mouse.move(plot["x"] + 300, plot["y"] + 82, steps=4)
    page.mouse.up()
    until(page, f"new Set({ranges}).size === 1 && {ranges}[0] !== '{low},{high}'")
    narrow = [float(x) for x in page.evaluate(ranges)[0].split(",")]
    assert low <= narrow[0] < narrow[1] <= high
    page.locator("#zoom-all").click()
    until(page, f"new Set({ranges}).size === 1 && {ranges}[0].startsWith('0,')")


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_the_way_in_space_has_beads_where_the_condition_holds(page, fit) -> None:
    held = fit["rollouts/swing_00"]["condition"].values[::3]
    assert page.locator("#stage").get_attribute("data-beads") == str(2 * held.sum()) != "0"  # of two bodies
    page.locator("#next").press("Enter")
    assert int(page.locator("#stage").get_attribute("data-beads") or 0) > 0  # of the simulator's motion
    page.locator("#recording").select_option(index=2)
    assert page.locator("#stage").get_attribute("data-beads") == "0"
    assert "Beads mark where" in page.locator(".moment").inner_text()


@pytest.mark.parametrize("verdict", ["mismatch"], indirect=True)
def test_recordings_without_positions_or_replay_say_so(page) -> None:
    assert page.locator("#stage-note").inner_text() == ""
    page.locator("#next").press("Enter")
    assert "simulators alone" in page.locator("#stage-note").inner_text()
    assert page.locator("#magnify").is_disabled()
    page.locator("#recording").select_option(index=2)
    assert "no replay" in page.locator("#stage-note").inner_text()
    assert page.locator("#stage").is_hidden()
    until(page, f"{PLOTS}.length >= 2")
