"""The charts of the page in a true browser: view, order, cursor, marks and picture."""

import math
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from rigs.browser import needs_browser, open_page, shared_browser
from rigs.live_page import PHONE, RESOLVED, live_page, name_device, swim
from rigs.processes import Daemon, wait_until
from rigs.window_process import WindowProcess, run_apart, running_window, wait_until_live

pytestmark = needs_browser

TEN_MINUTES_S = 600.0
# Runs in the page, instead of its stream: ticks with one extreme of F_x each 100 s.
FEED = """async ([count, period]) => {
  const app = await import("/app.js"), { Ring } = await import("/ring.js");
  app.stream.socket.onmessage = null;
  const ring = new Ring(period);
  for (let seq = 1; seq <= count; seq++) {
    const time = 1000 + seq * period, isExtreme = seq % Math.round(100 / period) === 7;
    ring.push({
      t: 1.7e9 + time, time, seq, servo_on: true, thrust: 0.02, thrust_ci95: 0.001, fy: 0,
      fx: isExtreme ? 0.9 : 0.01 * Math.sin(seq), phi_c: 0.4, fin_velocity: 0.1,
      readings: { power: seq % 3 },
    });
  }
  globalThis.charts = app.charts;
  app.charts.setRing(ring);
  app.charts.draw(performance.now() + 1e7);
}"""
# Returns whether something is drawn in the head of the picture, and as title and lines of a chart.
FIND_INK = """async () => {
  const { drawPicture } = await import("/chart_picture.js");
  const canvas = drawPicture(charts, "fish");
  const copy = new OffscreenCanvas(canvas.width, canvas.height);
  const context = copy.getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const frame = charts.parent.getBoundingClientRect();
  const hasInk = (left, top, width, height) => {
    const pixels = new Uint32Array(context.getImageData(left, top, width, height).data.buffer);
    return pixels.some((pixel) => pixel !== pixels[0]);
  };
  return [hasInk(0, 0, canvas.width, 50), ...charts.shown.flatMap(({ root }) => {
    const box = root.getBoundingClientRect();
    const left = Math.round(box.left - frame.left) + 14, top = Math.round(box.top - frame.top) + 58;
    return [hasInk(left, top, box.width, 16), hasInk(left, top + 20, box.width, box.height - 24)];
  })];
}"""
IS_AT_REST = """() => {
  const before = scrollY;
  return new Promise((done) => setTimeout(() => done(scrollY === before), 200));
}"""
"""Returns whether the page no longer scrolls by the swing of a finger."""
SPAN = "(() => { const { min, max } = charts.charts[0].plot.scales.x; return [min, max]; })()"


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """Open one browser for the pages of this module."""
    with shared_browser(RESOLVED):
        yield


@pytest.fixture
def window(free_window: WindowProcess) -> WindowProcess:
    """Return the window of the module, which no page drives, and whose fish is at rest."""
    return free_window


@pytest.fixture
def page(window: WindowProcess) -> Iterator[Page]:
    """Yield a page with ten minutes of ticks, to which no further one comes."""
    with live_page(window.url) as (page, complaints):
        page.evaluate(FEED, [12_000, 0.05])
        yield page
        assert complaints == []


def span(page: Page) -> tuple[float, float]:
    """Return begin and end of the time that the charts show, once they are drawn [s]."""
    page.evaluate("charts.draw(performance.now() + 1e7, true)")
    low, high = page.evaluate(SPAN)
    return low, high


def area(page: Page) -> dict[str, float]:
    """Return the place of the first chart's lines in the window."""
    plot = page.locator(".chart .u-over").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert box
    return {**box}


def titles(page: Page) -> list[str]:
    """Return the titles of the charts that are shown, in the order of the page."""
    captions = page.locator(".chart:visible figcaption > :first-child")
    return [caption.replace("\n", "") for caption in captions.all_inner_texts()]


def test_charts_stand_still_while_ticks_come_until_they_follow_again(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        page.evaluate("import('/app.js').then((app) => { globalThis.charts = app.charts; })")
        page.click("#pause")
        before, ticks = span(page), page.evaluate("charts.ring.latest.seq")
        ends = "charts.shown.map(({ plot }) => plot.axes[0]._values.at(-1))"
        wait_until(lambda: "latest" not in page.evaluate(ends))
        pixels = "document.querySelector('.chart canvas').toDataURL()"
        drawn = page.evaluate(pixels)
        wait_until(lambda: page.evaluate("charts.ring.latest.seq") > ticks + 40)
        assert (page.evaluate(SPAN), page.evaluate(pixels)) == ([*before], drawn)
        expect(page.locator("#chart-time")).to_contain_text("s ago")
        page.get_by_role("button", name="Follow").click()
        wait_until(lambda: page.evaluate(SPAN)[1] > before[1])
        expect(page.locator("#pause")).to_have_text("Pause")
        assert complaints == []


def test_a_view_that_stands_still_does_so_while_a_lost_connection_is_opened_again(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, complaints):
        page.evaluate("import('/app.js').then((app) => { globalThis.app = app; })")
        page.locator(".plot").first.press("Space")
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("Shift+ArrowLeft")
        before = page.evaluate("(globalThis.charts = app.charts).view.span(0)")
        ring = page.evaluate_handle("charts.ring")
        page.evaluate("app.stream.socket.close()")
        page.locator(".plot").first.hover()
        wait_until(lambda: page.evaluate("(ring) => charts.ring !== ring", ring))
        wait_until(lambda: page.evaluate("charts.ring.rows > 0"))
        assert page.evaluate("charts.view.span(0)") == before
        page.keyboard.press("End")
        wait_until(lambda: page.evaluate(SPAN)[1] > before[1])
        assert complaints == []


def test_a_pointer_pans_by_dragging_and_zooms_around_itself_with_ctrl_and_the_wheel(
    page: Page,
) -> None:
    box = area(page)
    x, y = box["x"] + 0.75 * box["width"], box["y"] + 40
    _, end = span(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 0.4 * box["width"], y, steps=8)
    page.mouse.up()
    low, high = span(page)
    assert high - low == pytest.approx(15.0)
    assert high == pytest.approx(end - 0.4 * 15.0, abs=0.3)
    expect(page.locator("#pause")).to_have_text("Follow")
    assert page.evaluate("charts.cursor") is None  # a drag is not a tap
    box = area(page)  # it may have another width, such as by a scroll bar
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 40)
    page.keyboard.down("Control")
    page.mouse.wheel(0, 200)
    wait_until(lambda: span(page)[1] - span(page)[0] > 20.0)
    page.keyboard.up("Control")
    wider_low, wider_high = span(page)
    at = 0.75  # the time below the pointer has not moved
    assert wider_low + at * (wider_high - wider_low) == pytest.approx(
        low + at * (high - low), abs=0.3
    )


def test_fingers_zoom_pan_and_scroll_and_a_tap_saves_a_picture(window: WindowProcess) -> None:
    with live_page(window.url, **PHONE) as (page, complaints):
        page.evaluate(FEED, [12_000, 0.05])
        with page.expect_download() as download:
            page.get_by_role("button", name="Picture").tap()
        assert download.value.path().read_bytes().startswith(b"\x89PNG")
        box, session = area(page), page.context.new_cdp_session(page)
        middle, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]

        def touch(*paths: tuple[int, int, int, int]) -> None:
            """Move fingers from one place to another, in steps [px, from the middle]."""
            for step in range(11):
                done, kind = step / 10, "touchMove" if step else "touchStart"
                points = [
                    {
                        "x": middle + x + (to_x - x) * done,
                        "y": y + up + (to_up - up) * done,
                        "id": finger,
                    }
                    for finger, (x, up, to_x, to_up) in enumerate(paths)
                ]
                session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
            session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

        scrolled = page.evaluate("scrollY")
        touch((0, 30, 20, -120))
        wait_until(lambda: page.evaluate("scrollY") > scrolled + 50)
        wait_until(lambda: page.evaluate(IS_AT_REST))
        expect(page.locator("#pause")).to_have_text("Pause")  # the charts have not moved
        page.tap("#pause")
        y = area(page)["y"] + 0.5 * box["height"]
        for fingers in (
            ((-20, 0, -60, 0), (20, 0, 60, 0)),  # side by side
            ((0, -12, 0, -36), (0, 12, 0, 36)),  # one above the other
        ):
            low, high = span(page)
            touch(*fingers)
            wait_until(lambda: span(page)[1] - span(page)[0] < 0.5 * (high - low))  # noqa: B023
            near, far = span(page)
            assert near + far == pytest.approx(low + high, abs=2.0)  # around the fingers
        touch((0, 0, 100, 0))
        wait_until(lambda: span(page)[1] < far - 0.2 * (far - near))
        assert span(page)[1] - span(page)[0] == pytest.approx(far - near)
        assert complaints == []


def test_keys_pause_pan_zoom_and_move_a_cursor_that_is_said(page: Page) -> None:
    plot = page.get_by_role("application", name="Chart of Force F_x [mN]")
    plot.focus()
    low, high = span(page)
    page.keyboard.press("Space")
    expect(page.locator("#pause")).to_have_text("Follow")
    page.keyboard.press("ArrowLeft")
    assert span(page) == pytest.approx((low - 3.0, high - 3.0))
    page.keyboard.press("+")
    assert span(page) == pytest.approx((low - 0.5, high - 5.5))
    page.keyboard.press("-")
    page.keyboard.press("ArrowRight")
    assert span(page) == pytest.approx((low, high))
    page.keyboard.press("Shift+ArrowLeft")
    page.keyboard.press("Shift+ArrowLeft")
    assert page.evaluate("charts.cursor") == pytest.approx(high - 0.1)
    expect(page.locator("#said")).to_contain_text("Force F_x [mN]: ")
    expect(page.locator("#said")).to_contain_text("0.10 s ago")
    page.keyboard.press("Escape")
    assert page.evaluate("charts.cursor") is None
    page.keyboard.press("End")
    expect(page.locator("#pause")).to_have_text("Pause")
    expect(plot).to_have_accessible_description(re.compile("Space pauses .* arrow: earlier"))


def test_a_cursor_shows_the_values_of_all_charts_at_one_time(page: Page) -> None:
    page.click("#pause")
    tick = page.evaluate("""() => {
        charts.setCursor(charts.ring.latest.time - 5);
        charts.draw(performance.now() + 1e7);
        return charts.cursorTick;
    }""")
    assert tick["seq"] == 12_000 - 100
    shown = {chart: page.locator("figure", has=page.get_by_text(chart)).locator("output")
             for chart in ("Force F", "power [W]", "Command")}  # fmt: skip
    expect(shown["Force F"].first).to_have_text(
        f"{10 * math.sin(tick['seq']):.1f}".replace("-", "−")
    )
    expect(shown["power [W]"]).to_contain_text(str(tick["seq"] % 3))
    expect(shown["Command"]).to_contain_text("0.4")


def test_the_extremes_of_ten_minutes_are_kept_and_recent_ticks_are_drawn_one_by_one(
    page: Page,
) -> None:
    page.select_option("#seconds", "600")
    low, high = span(page)
    assert high - low == TEN_MINUTES_S
    points, largest = page.evaluate("""() => {
        const values = charts.charts[0].data[1].filter((value) => value !== null);
        return [values.length, values.filter((value) => value === 900).length];
    }""")
    assert largest == 6  # each, though one tick of 2000
    assert 2300 <= points <= 2500  # of 12 000
    page.select_option("#seconds", "120")
    assert span(page)[1] == high
    assert page.evaluate("charts.charts[0].data[1].filter((value) => value !== null).length") > 2390


def test_a_fast_fish_needs_no_more_memory_than_a_slow_one(page: Page) -> None:
    page.evaluate(FEED, [100_000, 0.005])
    page.select_option("#seconds", "300")
    rows, bytes_ = page.evaluate("""() => {
        const { ring } = charts, all = [...ring.columns.values(), ...ring.past.columns.values()];
        return [ring.rows, all.reduce((sum, column) => sum + column.byteLength, 0)];
    }""")
    assert rows < 25_000
    assert bytes_ < 5e6
    low, high = span(page)
    assert high - low == 300.0
    first = page.evaluate("charts.charts[0].data[1].findIndex((value) => value !== null)")
    assert page.evaluate("charts.times")[max(first, 64)] <= low + 1.0


def test_a_page_that_opens_gets_what_the_window_has_seen_before_the_latest_ticks(
    daemon: Daemon, tmp_path: Path
) -> None:
    short = "import fishd.window.fish_link; fishd.window.fish_link.MAX_TICKS = 220"
    with running_window(tmp_path, changes=short, fish=daemon.endpoint) as window:
        run_apart(wait_until_live(window))
        with live_page(window.url) as (page, complaints):

            def is_older() -> bool:
                page.reload()
                expect(page.locator("#connection")).to_contain_text("live")
                return bool(
                    page.evaluate("""async () => {
                    const { ring } = (await import("/app.js")).charts;
                    return ring.past.oldest < ring.oldest - 5;
                }""")
                )

            wait_until(is_older)
            assert complaints == []


def test_charts_are_chosen_and_ordered_and_stay_so_in_this_browser(window: WindowProcess) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        expect(page.get_by_text("swing: top speed")).to_be_visible()
        page.get_by_role("button", name="Charts", exact=True).click()
        page.get_by_role("checkbox", name="Force F_y [mN]").uncheck()
        up = page.get_by_role("button", name="Move power [W] up")
        up.focus()
        while titles(page)[0] != "power [W]":
            page.keyboard.press("Enter")
        shown = titles(page)
        assert shown[0] == "power [W]"
        assert (
            {"Force Fx [mN]", "Fin velocity, estimated"} < {*shown} - {"Force Fy [mN]"} == {*shown}
        )
        page.reload()
        expect(page.get_by_text("swing: top speed")).to_be_visible()
        assert titles(page) == shown
        page.get_by_role("button", name="Charts", exact=True).click()
        expect(page.get_by_role("checkbox", name="Force F_y [mN]")).not_to_be_checked()
        page.get_by_role("checkbox", name="Force F_y [mN]").check()
        expect(page.get_by_role("application", name="Chart of Force F_y")).to_be_visible()
        assert complaints == []


def test_a_click_sets_a_mark_at_the_tick_of_that_time(window: WindowProcess) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        page.evaluate("import('/app.js').then((app) => { globalThis.app = app; })")
        wait_until(lambda: page.evaluate("app.charts.ring.rows") > 60)
        page.click("#pause")
        box = area(page)
        page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 40)
        expect(page.locator("#mark-here")).to_be_in_viewport(ratio=1)
        assert area(page) == box  # the charts have not moved below the pointer
        seq = page.evaluate("app.charts.cursorTick.seq")
        expect(page.locator("#mark-here")).to_contain_text(f"tick {seq}")
        page.get_by_label("Text of the mark at the cursor").fill("a wave")
        page.get_by_role("button", name="Mark here").click()
        expect(page.locator("#mark-here")).to_have_count(0)
        wait_until(lambda: page.evaluate("app.state.events.at(-1).kind") == "mark")
        assert page.evaluate("app.state.events.at(-1).message") == f"a wave (tick {seq})"

        def mark() -> Any:
            page.evaluate("app.charts.draw(performance.now() + 1e7, true)")
            return page.evaluate("app.charts.marks.at(-1)")

        wait_until(lambda: mark()["time"] is not None)
        assert (mark()["text"], mark()["seq"]) == ("a wave", seq)
        time = "app.charts.ring.value('time', app.charts.ring.newer(%s, 'seq'))"
        assert mark()["time"] == pytest.approx(page.evaluate(time % (seq - 0.5)))
        assert complaints == []


def test_a_device_that_may_only_watch_reads_values_at_a_cursor_and_sets_no_mark(
    window: WindowProcess,
) -> None:
    with open_page(window.invite("watch")) as (page, _):
        name_device(page, "tablet")
        expect(page.locator("#connection")).to_contain_text("live")
        box = area(page)
        page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 40)
        expect(page.locator("#mark-here")).to_contain_text("may only watch")
        expect(page.get_by_role("button", name="Mark here")).to_have_count(0)


def test_a_picture_has_all_charts_that_are_shown_with_their_lines(page: Page) -> None:
    plots = page.locator("#plots").bounding_box()
    assert plots
    with page.expect_download() as download:
        page.get_by_role("button", name="Picture").click()
    assert download.value.suggested_filename.endswith(".png")
    width, height = struct.unpack(">II", download.value.path().read_bytes()[16:24])
    assert width >= plots["width"]
    assert height >= plots["height"]
    assert page.evaluate(FIND_INK) == [True] + 2 * len(titles(page)) * [True]


def test_two_columns_fit_a_tablet_and_one_a_phone(page: Page) -> None:
    columns = "getComputedStyle(charts.parent).gridTemplateColumns.split(' ').length"
    for width, expected in ((1280, 2), (800, 2), (390, 1)):
        page.set_viewport_size({"width": width, "height": 844})
        assert page.evaluate(columns) == expected


def test_charts_move_once_a_second_where_less_motion_is_wanted(page: Page) -> None:
    def is_drawn_after(wait_ms: int) -> Any:
        return page.evaluate(f"""() => {{
            const start = charts.drawn = performance.now();
            charts.dirty = true;
            charts.draw(start + {wait_ms});
            return !charts.dirty;
        }}""")

    assert is_drawn_after(100)
    page.emulate_media(reduced_motion="reduce")
    assert not is_drawn_after(900)
    assert is_drawn_after(1000)
