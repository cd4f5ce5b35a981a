"""The window's page in a true browser: a true fishd-window, and a true fishd."""

import gzip
import json
import os
import re
import signal
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from playwright.sync_api import APIResponse, Page, Route, expect
from rigs.browser import needs_browser, open_page, shared_browser
from rigs.camera_process import running_camera
from rigs.live_page import RESOLVED, go, live_page, name_device, swim
from rigs.processes import PATIENCE, Daemon, running, wait_until
from rigs.recordings import record_run, swum
from rigs.virtual_pi_process import Pi
from rigs.window_process import WindowProcess, running_window

from fishd.lab.experiment import Header, open_experiment

pytestmark = needs_browser

AXE = resources.files("axe_playwright_python").joinpath("axe.min.js")
"""The program that looks for barriers."""
MAX_ASSETS_BYTES = 120_000

# Runs in the page: `app` is its own module, with the state that it shows.
APP = "const app = await import('/app.js');"
FEED = """
const day = 24 * 3600 * 20;
let seq = app.state.tick.seq, { t, time } = app.state.tick;
globalThis.feed = (count, drawn) => {
  for (let i = 0; i < count; i++) {
    const phase = i / 12;
    app.receive.ticks([{
      t: t += 0.05, time: time += 0.05, seq: ++seq,
      mode: "running", controller: "swing", servo_on: true, samples: 2,
      fx: Math.sin(phase), fy: Math.cos(phase), fy_rate: 0, fin_velocity: phase % 1, phi_c: 0.4,
      thrust: 0.02, thrust_ci95: 0.001, frequency: 1.7, sample_age_ms: 2, lateness_us: 50,
      busy_time_us: 90, missed_slots: 0, alpha: 0.1, phi: 0.3,
      readings: { power: 0.6 }, quantities: { top_speed: phase % 2 },
    }]);
    if (i % drawn === 0) app.charts.draw(performance.now() + 1e7 + i * 100);
  }
};
"""
# Returns whether a column of pixels in the first chart shows the colour of its line.
LINE_AT = """([second]) => {
  const plot = charts.charts[0].plot, { left, top, height } = plot.bbox;
  const x = Math.round(plot.valToPos(second, "x", true));
  if (x < left) throw new Error("outside");
  const pixels = plot.ctx.getImageData(x, top, 1, height).data;
  for (let i = 0; i < pixels.length; i += 4) {
    const [red, green, blue] = pixels.slice(i, i + 3);
    if (blue - red > 40) return true;
  }
  return false;
}"""

# Looks again for barriers if values were greyed meanwhile, which a machine that stalls may cause.
FIND_BARRIERS = """async () => {
  const body = document.body, isGrey = () => body.classList.contains("stale");
  for (;;) {
    while (isGrey()) await new Promise(requestAnimationFrame);
    let wasGrey = false;
    const observer = new MutationObserver(() => { wasGrey ||= isGrey(); });
    observer.observe(body, { attributeFilter: ["class"] });
    const { violations } = await axe.run();
    observer.disconnect();
    if (!wasGrey) return violations;
  }
}"""


FIND_RED_ROW = """() => {
  const canvas = document.querySelector("#camera canvas"), { width, height } = canvas;
  const copy = new OffscreenCanvas(1, height).getContext("2d");
  copy.drawImage(canvas, -Math.floor(width / 2), 0);
  const data = copy.getImageData(0, 0, 1, height).data;
  const rows = [];
  for (let row = 0; row < height; row++)
    if (data[4 * row] > 200 && data[4 * row + 2] < 120) rows.push(row);
  return rows.length ? rows.reduce((sum, row) => sum + row, 0) / rows.length / height : null;
}"""
"""Returns the height of the axis in the middle column, as a fraction; null without."""


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """Open one browser for the pages of this module."""
    with shared_browser(RESOLVED):
        yield


@pytest.fixture
def window(free_window: WindowProcess) -> WindowProcess:
    """Return the window of the module, which no page drives, and whose fish is at rest."""
    return free_window


def test_a_chart_moves_and_nothing_leaves_this_machine(window: WindowProcess) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        latest = page.locator(".chart output").first
        for _ in range(3):
            expect(latest).not_to_have_text(latest.inner_text())
        pixels = "document.querySelector('.chart canvas').toDataURL()"
        before = page.evaluate(pixels)
        wait_until(lambda: page.evaluate(pixels) != before)
        expect(page.locator("#cards")).to_contain_text("swing")
        expect(page.locator("#cards")).to_contain_text(re.compile(r"Power.*W.*mean of 2 s"))
        expect(page.get_by_text("power [W]")).to_be_visible()  # the title of its chart
        assert complaints == []


def test_a_parameter_is_set_and_a_value_that_fishd_refuses_is_explained_and_not_shown_as_set(
    window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        page.get_by_label("C, slider").fill("0.45")
        wait_until(lambda: daemon.status().parameters["C"] == 0.45)
        expect(page.locator("#parameter-C")).to_have_value("0.45")
        page.locator("#parameter-C").fill("0.55")
        page.locator("#parameter-C").press("Enter")
        wait_until(lambda: daemon.status().parameters["C"] == 0.55)
        assert complaints == []
        page.locator("#parameter-C").fill("7")
        page.locator("#parameter-C").press("Enter")
        expect(page.locator(".notice.error")).to_contain_text("C")
        expect(page.locator("#parameter-C")).to_have_value("0.55")
        assert daemon.status().parameters["C"] == 0.55


def test_stop_lets_the_fish_rest_and_keeps_the_parameters_for_the_next_start(
    window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page, "square")
        page.locator("#parameter-frequency").fill("1.5")
        page.locator("#parameter-frequency").press("Enter")
        wait_until(lambda: daemon.status().parameters["frequency"] == 1.5)
        page.click("#stop")
        expect(page.locator("#mode")).to_have_text("idle")
        assert daemon.status().mode == "idle"
        expect(page.locator("#start")).to_have_text("Start square")
        expect(page.locator("#parameter-frequency")).to_have_value("1.5")
        page.click("#start")
        wait_until(lambda: daemon.status().parameters.get("frequency") == 1.5)
        assert complaints == []


def test_the_outcome_of_an_emergency_stop_is_in_sight_of_a_page_that_is_scrolled(
    window: WindowProcess,
) -> None:
    with live_page(window.url, viewport={"width": 390, "height": 844}) as (page, _):
        swim(page)
        page.evaluate("scrollTo(0, 1200)")
        page.click("#estop")
        expect(page.locator("#clear-fault")).to_be_in_viewport(ratio=1)
        expect(page.locator("#estop-ms")).to_be_in_viewport(ratio=1)
        page.click("#clear-fault")
        expect(page.locator("#mode")).to_have_text("idle")


def test_a_page_that_loses_the_fish_to_one_of_the_same_device_says_another_page(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, _):
        swim(page)
        assert page.context.browser
        other = page.context.browser.new_page()
        other.goto(window.url)
        expect(other.locator("#driver")).to_have_text("another page drives")
        other.click("#stop")
        expect(other.locator("#mode")).to_have_text("idle")
        expect(other.locator("#notices")).to_be_empty()
        other.get_by_role("button", name="Take over").click()
        expect(page.locator("#notices")).to_contain_text("Another page drives now.")


def test_a_late_answer_does_not_hide_that_another_page_has_taken_over(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, _):
        assert page.context.browser
        other = page.context.browser.new_page()
        other.goto(window.url)
        held: list[tuple[Route, APIResponse]] = []
        page.route("**/drive", lambda route: held.append((route, route.fetch())))
        page.get_by_role("button", name="Drive", exact=True).click()
        expect(page.locator("#driver")).to_have_text("you drive")
        other.get_by_role("button", name="Take over").dispatch_event("click")
        expect(page.locator("#driver")).to_have_text("another page drives")

        def has_answer() -> bool:
            page.wait_for_timeout(10)  # meanwhile, playwright receives it
            return bool(held)

        wait_until(has_answer)
        ((route, answer),) = held
        with page.expect_response("**/drive"):
            route.fulfill(response=answer)
        page.evaluate("new Promise((done) => setTimeout(() => requestAnimationFrame(done)))")
        expect(page.locator("#driver")).to_have_text("another page drives")
        expect(other.locator("#driver")).to_have_text("you drive")


def test_an_emergency_stop_ends_pulses_and_command_and_shows_its_time_and_the_way_out(
    pi: Pi, pi_window: WindowProcess
) -> None:
    with live_page(pi_window.url) as (page, complaints):
        swim(page)
        command = page.locator("figure", has_text="Command").locator("output")
        expect(command).not_to_have_text("–")
        wait_until(lambda: pi.pulse() > 0.0)
        page.click("#estop")
        pi.wait_until_released()
        expect(page.locator("#mode")).to_have_text("E-stop")
        expect(page.locator("#estop-ms")).to_contain_text("ms")
        expect(page.locator("#latched")).to_contain_text("Before you clear it")
        assert page.locator("#start").is_disabled()
        expect(command).to_have_text("–")
        page.click("#clear-fault")
        expect(page.locator("#mode")).to_have_text("idle")
        expect(page.locator("#latched")).to_have_count(0)
        wait_until(lambda: pi.pulse() > 0.0)
        assert complaints == []


def test_a_fault_of_a_true_sensor_marks_its_samples_and_shows_reason_and_remedy(
    pi: Pi, pi_window: WindowProcess
) -> None:
    with live_page(pi_window.url) as (page, complaints):
        swim(page)
        expect(page.locator("#view")).to_contain_text("tail, as commanded")
        pi.control("inject", "clipped")
        expect(page.locator("#mode")).to_have_text("fault")
        expect(page.locator("#latched")).to_contain_text("clipped")
        expect(page.locator("#latched")).to_contain_text("wire of the force sensor")
        marked = "app.charts.charts[0].data[5].filter((value) => value !== null).length"
        wait_until(lambda: page.evaluate(f"(async () => {{ {APP} return {marked} }})()") >= 3)
        assert complaints == []


def test_an_emergency_stop_works_when_the_stream_is_stale(
    window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(window.url) as (page, _):
        swim(page)
        box = page.locator("#estop").bounding_box()
        page.evaluate(f"(async () => {{ {APP} app.stream.socket.onmessage = null }})()")
        expect(page.locator("body.stale")).to_have_count(1)
        page.focus("#estop")
        page.keyboard.press("Enter")
        wait_until(lambda: daemon.status().mode == "estop")
        expect(page.locator("#estop-ms")).to_contain_text("ms")
        assert page.locator("#estop").bounding_box() == box


def test_a_killed_fishd_shows_at_once_and_a_new_one_is_said(
    own_daemon: Daemon, own_window: WindowProcess, tmp_path: Path
) -> None:
    with live_page(own_window.url) as (page, _):
        own_daemon.end(signal.SIGKILL)
        expect(page.locator("body.stale")).to_have_count(1)
        expect(page.locator("#connection")).to_contain_text("lost")
        age = page.locator("#connection .age")
        expect(age).not_to_have_text(age.inner_text())
        expect(page.locator("#banner")).to_contain_text("What is greyed is old")
        expect(page.locator("#mode")).to_have_text("was idle")
        with running(tmp_path):
            expect(page.locator("#connection")).to_contain_text("live")
            expect(page.locator("#notices")).to_contain_text("restarted")
            expect(page.locator("body.stale")).to_have_count(0)


def test_a_page_whose_server_hangs_says_so_by_its_own_clock_and_opens_another_connection(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, _):
        window.stop()
        try:
            with page.expect_websocket():
                expect(page.locator("#connection")).to_contain_text("stale")
        finally:
            window.process.send_signal(signal.SIGCONT)
        expect(page.locator("#connection")).to_contain_text("live")


def test_a_page_works_in_a_browser_that_keeps_nothing(new_window: WindowProcess) -> None:
    with live_page(new_window.url) as (page, complaints):
        page.add_init_script("""for (const name of ["localStorage", "sessionStorage"])
            Object.defineProperty(globalThis, name, { get() { throw new Error("forbidden"); } });
        """)
        page.reload()
        expect(page.locator("#connection")).to_contain_text("live")
        swim(page)
        go(page, "experiments")
        page.click("#tab-record")
        page.fill("#option-seconds", "0,5")
        page.click("#experiment button.primary")
        expect(page.locator(".job code")).to_contain_text("--for 0.5")
        assert complaints == []


@pytest.mark.realtime
def test_old_values_are_grey_within_a_second_and_the_page_is_painted_within_half(
    own_daemon: Daemon, own_window: WindowProcess
) -> None:
    with live_page(own_window.url) as (page, _):
        paint = page.evaluate("performance.getEntriesByType('paint')[0].startTime")
        page.evaluate(f"""(async () => {{ {APP}
            new MutationObserver(() => {{
                if (document.body.classList.contains("stale"))
                    globalThis.staleAfter ??= performance.now() - app.state.lastTick;
            }}).observe(document.body, {{ attributes: true }});
        }})()""")
        own_daemon.end(signal.SIGKILL)
        wait_until(lambda: page.evaluate("globalThis.staleAfter ?? 0"))
        assert page.evaluate("staleAfter") <= 1000
        assert paint <= 500


def test_a_reload_restores_what_the_fish_does_and_the_first_tab_leads_to_the_emergency_stop(
    window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        page.get_by_label("C, slider").fill("0.5")
        wait_until(lambda: daemon.status().parameters["C"] == 0.5)
        page.select_option("#seconds", "60")
        seq = page.evaluate(f"(async () => {{ {APP} return app.state.tick.seq }})()")
        page.reload()
        expect(page.locator("#mode")).to_have_text("running")
        expect(page.locator("#parameter-C")).to_have_value("0.5")
        expect(page.locator("#driver")).to_have_text("you drive")
        expect(page.locator("#seconds")).to_have_value("60")
        columns = f"(async () => {{ {APP} return [...app.charts.ring.columns.get('seq')] }})()"
        assert seq in page.evaluate(columns)
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "estop"
        page.keyboard.press("Enter")
        expect(page.locator("#estop-ms")).to_be_visible()
        go(page, "fish")
        expect(page.locator("#events")).to_contain_text("swing takes over")
        assert complaints == []


def test_the_tile_of_the_camera_draws_picture_and_axis_only_while_it_is_on_the_screen(
    daemon: Daemon, window: WindowProcess
) -> None:
    settings = (f"simulated.fishd={daemon.endpoint}", "simulated.rate=30", "simulated.off_axis=3.0")
    with (
        running_camera(window.state.parent, *settings),
        live_page(window.url) as (page, complaints),
    ):
        page.goto(f"{window.url}/#camera")
        swim(page)
        tile = page.locator("#camera")
        expect(tile).to_contain_text("Streaming: a simulated camera above the fish")
        page.get_by_label("show how it is aligned").check()
        expect(tile).to_contain_text("px below the middle row")
        wait_until(lambda: page.evaluate(FIND_RED_ROW) is not None)
        row = page.evaluate(FIND_RED_ROW)
        assert row == pytest.approx((83 / 2 + 3.0 + 0.5) / 84, abs=2 / 84)
        with page.expect_websocket() as opened:
            go(page, "fish")
            go(page, "live")
        expect(page.locator("#show-camera")).to_be_hidden()
        socket = opened.value
        tile.get_by_role("button", name="Close").click()
        wait_until(lambda: page.evaluate("0") == 0 and socket.is_closed())
        expect(tile).to_be_empty()
        expect(page.locator("#show-camera")).to_be_focused()
        assert complaints == []


def test_the_part_fish_shows_computer_settings_log_and_checks(window: WindowProcess) -> None:
    with live_page(window.url) as (page, complaints):
        go(page, "fish")
        expect(page.locator("#computer")).to_contain_text(re.compile(r"robot simulated.*GB free"))
        expect(page.locator("#calibrations")).to_contain_text("This robot has none")
        keys = page.locator("#configuration tbody tr")
        own = keys.count()
        expect(page.locator("#configuration")).to_contain_text("control.address")
        page.locator("#configuration input").check()
        expect(page.locator("#configuration")).to_contain_text("amplitude_limit")
        assert keys.count() > own
        expect(page.locator("#log")).to_contain_text("not the service of this computer")
        page.click("#checks button")
        expect(page.locator("#checks")).to_contain_text("daemon")
        assert complaints == []


def test_a_service_that_rests_is_restarted_from_the_page(service: Daemon, tmp_path: Path) -> None:
    is_service = "from fishd.window import inspection; inspection._is_service = lambda link: True"
    with (
        running_window(tmp_path, changes=is_service, fish=service.endpoint) as window,
        live_page(window.url) as (page, complaints),
    ):
        swim(page)
        go(page, "fish")
        restart = page.get_by_role("button", name="Restart fishd")
        expect(restart).to_be_disabled()
        go(page, "live")
        page.click("#stop")
        go(page, "fish")
        expect(restart).to_be_enabled()
        restart.click()
        assert service.process.wait(PATIENCE) == os.EX_TEMPFAIL
        expect(page.locator("#connection")).to_contain_text("lost")
        assert complaints == []


def test_a_change_by_another_client_is_said_and_shown(
    window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(window.url) as (page, complaints):
        swim(page)
        assert daemon.fishctl("set-parameter", "C=0.4").returncode == 0
        expect(page.locator("#notices")).to_contain_text("Another client set swing C=0.4")
        expect(page.locator("#parameter-C")).to_have_value("0.4")
        assert complaints == []


def test_a_device_of_the_network_pairs_with_a_link_that_leaves_its_address(
    window: WindowProcess, daemon: Daemon
) -> None:
    link = window.invite("watch")
    url = link.partition("#")[0]
    with open_page(url) as (page, complaints):
        expect(page.locator(".pairing")).to_contain_text("not paired")
        page.goto(link)
        name_device(page, "tablet 1")
        expect(page.locator("#connection")).to_contain_text("live")
        assert page.url == url
        assert page.locator("#start").is_disabled()
        page.click("#estop")
        wait_until(lambda: daemon.status().mode == "estop")
        expect(page.locator("#estop-ms")).to_contain_text("ms")
        assert page.locator("#clear-fault").is_disabled()
        go(page, "fish")
        expect(page.locator("#events")).to_contain_text("Paired as tablet 1")
        assert complaints == []


def test_a_device_that_is_revoked_says_so(new_window: WindowProcess) -> None:
    with open_page(new_window.invite()) as (page, _):
        name_device(page, "tablet")
        expect(page.locator("#connection")).to_contain_text("live")
        (device,) = json.loads(new_window.ask("devices", "--json"))
        new_window.ask("revoke", device["id"])
        expect(page.locator("#banner")).to_contain_text("This device is no longer paired")
        expect(page.locator(".pairing")).to_be_visible()


def test_a_run_in_simulation_is_drawn_over_its_own_time_and_dismissed(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url) as (page, complaints):
        go(page, "experiments")
        page.click("#tab-simulate")
        expect(page.locator("#preview")).to_have_text(
            re.compile("fishctl simulate swing.*60.s of virtual time")
        )
        page.click("#experiment .primary")
        expect(page.locator(".job.done")).to_contain_text("True thrust")
        expect(page.locator(".job code")).to_contain_text("fishctl simulate swing")
        expect(page.locator("figure.curve", has_text="Virtual force")).to_be_visible()
        drawn = f"(async () => {{ {APP} return app.charts.virtual }})()"
        wait_until(lambda: page.evaluate(drawn) > 0.02)
        page.get_by_role("button", name="Dismiss simulate").click()
        expect(page.locator(".job")).to_have_count(0)
        wait_until(lambda: page.evaluate(drawn) is None)
        assert complaints == []


def test_a_form_says_at_once_what_its_job_would_refuse(new_window: WindowProcess) -> None:
    with live_page(new_window.url) as (page, _):
        go(page, "experiments")
        start, seconds = page.locator("#experiment .primary"), page.locator("#option-seconds")
        seconds.fill("20")
        expect(page.locator("#preview")).to_contain_text("20.25 to 3600 s are needed")
        expect(start).to_be_disabled()
        seconds.fill("30 s")
        expect(page.locator("#preview")).to_contain_text("seconds: '30 s' is not valid: a number")
        seconds.fill("21")
        expect(page.locator("#preview")).to_contain_text("fishctl measure swing --for 21")
        expect(start).to_be_enabled()
        page.select_option("#controller", "thrust")
        expect(page.locator("#preview")).to_contain_text("Needed first")
        expect(start).to_be_disabled()
        page.select_option("#controller", "ppo")
        page.click("#tab-optimise")
        expect(page.locator("#preview")).to_contain_text("ppo has no number to search")
        expect(start).to_be_disabled()


def test_every_experiment_of_the_command_line_has_a_form_with_its_preview(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url) as (page, complaints):
        go(page, "experiments")
        page.select_option("#controller", "square")
        expect(page.get_by_role("tab")).to_have_count(9)
        for kind in ("measure", "compare", "optimise", "identify", "adapt", "learn", "record"):
            page.click(f"#tab-{kind}")
            expect(page.locator("#preview code")).to_contain_text(f"fishctl {kind}")
            expect(page.locator("#experiment .primary")).to_be_enabled()
        assert complaints == []


def test_a_search_on_a_simulated_fish_draws_its_curve_and_shows_the_best_with_its_interval(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url) as (page, complaints):
        go(page, "experiments")
        page.select_option("#controller", "square")
        page.click("#tab-optimise")
        page.get_by_label("Range").fill("1:3")
        page.select_option("#option-on", "simulation")
        expect(page.locator("#preview")).to_contain_text("--frequency 1:3 --on simulation")
        page.click("#experiment .primary")
        expect(page.locator(".job.done")).to_contain_text("best frequency")
        expect(page.locator(".job.done")).to_contain_text("thrust there")
        expect(page.get_by_role("img", name="Chart of thrust over frequency")).to_be_visible()
        assert complaints == []


def test_what_was_entered_is_kept_and_further_options_are_a_click_away(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url) as (page, _):
        go(page, "experiments")
        page.click("#tab-adapt")
        page.locator("#option-budget").fill("200")
        expect(page.locator("#option-no_command")).to_be_hidden()
        page.get_by_text("More options").click()
        expect(page.locator("#option-no_command")).to_be_checked()
        page.select_option("#option-on", "simulation")
        expect(page.locator("#option-no_command")).to_have_count(0)  # for a live fish only
        expect(page.locator("#preview")).to_contain_text("fishctl adapt --budget 200 --on")
        page.reload()
        expect(page.locator("#option-budget")).to_have_value("200")


def test_a_stored_run_is_opened_and_another_controller_is_run_on_it(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url) as (page, complaints):
        swim(page)
        go(page, "experiments")
        page.click("#tab-record")
        page.locator("#option-seconds").fill("1")
        page.locator("#option-note").fill("a; $(b) 'c'")
        page.click("#experiment .primary")
        expect(page.locator(".job.done")).to_be_visible()
        page.select_option("#controller", "sine")
        go(page, "runs")
        page.locator("#runs").get_by_role("button", name="Open").click()
        expect(page.locator("#runs")).to_contain_text("a; $(b) 'c'")
        expect(page.locator("#runs img")).to_be_visible()
        page.get_by_role("button", name="Rerun with sine").click()
        go(page, "experiments")
        expect(page.locator(".job code").first).to_contain_text(" sine")
        expect(page.locator(".job.done")).to_have_count(2)
        expect(page.locator(".job").first).to_contain_text("sine in place of swing")
        assert complaints == []


@pytest.fixture
def kept_runs(new_window: WindowProcess) -> WindowProcess:
    """Return a window whose folder has two recordings, and an experiment with rows."""
    folder = new_window.state.parent / "runs"
    folder.mkdir(exist_ok=True)
    for number in (1, 2):
        about = {"subject": f"fish {number}", "note": f"note {number}"}
        record_run(swum(2.0), folder / f"run {number}", **about)
    with open_experiment(folder / "swept", Header(kind="sweep", on="simulation")) as experiment:
        table = experiment.open_table(["controller", "frequency", "thrust", "thrust_ci95"])
        for number in range(6):
            row = {"frequency": 1.0 + 0.2 * number, "thrust": 0.02, "thrust_ci95": 0.001}
            table.add({"controller": ("square", "sine")[number % 2], **row})
    return new_window


def test_runs_are_found_compared_noted_renamed_and_deleted_with_undo(
    kept_runs: WindowProcess,
) -> None:
    with live_page(kept_runs.url) as (page, complaints):
        go(page, "runs")
        runs = page.locator("#runs")
        names = runs.locator("td.name")
        expect(names).to_have_count(3)
        page.get_by_label("Find").fill("FISH note 2")
        expect(names).to_have_text(["run 2note 2"])
        page.get_by_label("Find").fill("")
        page.get_by_label("Began").select_option("last day")
        expect(names).to_have_count(3)
        page.get_by_label("Find").fill("2999-01-01")
        expect(names).to_have_count(0)
        page.get_by_label("Find").fill("")
        page.locator(".filter").get_by_label("Controller").select_option("swing")
        page.get_by_label("Sort by").select_option("fish")
        expect(names).to_have_text(["run 1note 1", "run 2note 2"])
        for number in (1, 2):
            page.get_by_label(f"Compare run {number}").check()
        page.get_by_role("button", name="Compare 2").click()
        expect(page.locator(".comparison tbody tr")).to_have_count(2)
        expect(page.locator(".comparison img")).to_be_visible()
        page.get_by_role("button", name="Close comparison").click()

        page.get_by_role("button", name="Open run 2").click()
        page.get_by_label("Note", exact=True).fill("better")
        page.get_by_role("button", name="Save").click()
        expect(names.nth(1)).to_have_text("run 2better")
        page.get_by_label("Name", exact=True).fill("run 1")
        page.get_by_role("button", name="Rename").click()
        expect(page.locator("#notices")).to_contain_text("exists already")
        page.get_by_label("Name", exact=True).fill("third")
        page.get_by_role("button", name="Rename").click()
        expect(page.get_by_role("button", name="Close third")).to_be_visible()
        with page.expect_download() as download:
            page.get_by_role("link", name="CSV", exact=True).click()
        assert download.value.suggested_filename == "third.csv"
        page.get_by_role("button", name="Delete").click()
        page.get_by_role("button", name="Trash").click()
        expect(page.locator(".trash li")).to_contain_text("third")
        page.get_by_role("button", name="Undo").click()
        expect(names).to_have_text(["run 1note 1", "thirdbetter"])
        expect(page.locator(".trash li")).to_have_count(0)

        page.get_by_role("button", name="Open third").click()
        page.get_by_role("button", name="Delete").click()
        page.get_by_role("button", name="Empty trash").dblclick()  # does not remove anything
        expect(page.locator(".trash li")).to_contain_text("third")
        page.get_by_role("button", name="Empty trash").click()
        page.get_by_role("button", name="Remove this run permanently").click()
        expect(page.locator(".trash")).to_contain_text("It is empty")
        assert [line for line in complaints if "409" not in line] == []


def test_an_opened_run_a_comparison_and_the_trash_fit_each_screen_and_have_no_barrier(
    kept_runs: WindowProcess,
) -> None:
    with live_page(kept_runs.url, bypass_csp=True) as (page, _):
        page.evaluate(AXE.read_text(encoding="utf-8"))
        go(page, "runs")
        for run in ("run 1", "run 2", "swept"):
            page.get_by_label(f"Compare {run}").check()
        page.get_by_role("button", name="Compare 3").click()
        page.get_by_role("button", name="Open swept").click()
        page.get_by_role("button", name="Trash").click()
        expect(page.locator(".rows canvas")).to_have_count(2)  # of the comparison and of the run
        expect(page.locator(".comparison tbody tr")).to_have_count(2)
        expect(page.locator(".comparison img")).to_be_visible()
        expect(page.locator(".note")).to_have_count(1)  # the sweep has no recording to draw
        expect(page.locator(".trash .muted")).to_contain_text("empty")
        for width in (1280, 800, 390):
            page.set_viewport_size({"width": width, "height": 844})
            assert page.evaluate("document.documentElement.scrollWidth") == width
            table = page.locator("#runs table.runs")
            assert table.evaluate("node => node.scrollWidth <= node.parentNode.clientWidth")
            refuse_barriers(page)
        walk(page)


def test_a_value_has_the_digits_of_its_interval_and_at_most_five(window: WindowProcess) -> None:
    shown = {
        (25.74123, 0.1234): "25.74 ± 0.12",
        (671.31489, 0.0008): "671.31 ± 0.01",  # more digits than a value has
        (0.0234, 0.79): "0.02 ± 0.79",
        (-0.123456, 0.0032): "−0.1235 ± 0.0032",
        (12345.6, 140.0): "12346 ± 140",
        (1.5, None): "1.50 ± ?",
    }
    show = """async (pairs) => {
      const { interval } = await import("/common.js");
      return pairs.map(([value, half]) => interval(value, half ?? NaN).join(" "));
    }"""
    with live_page(window.url) as (page, _):
        texts = page.evaluate(show, [list(pair) for pair in shown])
    assert [text.replace("\N{NO-BREAK SPACE}", " ") for text in texts] == list(shown.values())


def test_lost_ticks_are_drawn_as_a_gap_and_suspect_samples_are_marked(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, _):
        lost, row, suspects = page.evaluate("""async () => {
            const { Ring } = await import("/ring.js");
            const ring = new Ring(0.05);
            const { charts } = await import("/app.js");
            globalThis.charts = charts;
            (await import("/app.js")).stream.socket.onmessage = null;
            for (let seq = 1; seq <= 300; seq++) {
                if (seq > 100 && seq <= 200) continue;
                const tick = { time: 1000 + seq * 0.05, seq, fx: 0.01, fy: 0, phi_c: 0 };
                tick.thrust = 0.01;
                if (seq === 250) tick.suspect = "clipped";
                ring.push(tick);
            }
            charts.setRing(ring);
            charts.draw(performance.now() + 1e7);
            const { data } = charts.charts[0], isLost = (value) => value === null;
            const suspects = data[5].filter((value) => !isLost(value));
            return [ring.lost, data[1].slice(-201).map(isLost), suspects];
        }""")
        assert lost == 100
        assert row == [False] * 100 + [True] + [False] * 100
        assert suspects == [10.0]
        assert page.evaluate(LINE_AT, [1003.0])
        assert not page.evaluate(LINE_AT, [1007.5])
        assert page.evaluate(LINE_AT, [1014.0])


def test_a_step_of_the_unix_clock_leaves_the_charts_as_they_are(window: WindowProcess) -> None:
    with live_page(window.url) as (page, _):
        rows, lost, times = page.evaluate("""async () => {
            const { Ring } = await import("/ring.js");
            const ring = new Ring(0.05), times = new Array(100);
            for (let seq = 1; seq <= 100; seq++) {
                ring.push({ t: 1e9 + seq * 0.05 - 30 * (seq > 50), time: seq * 0.05, seq });
            }
            ring.copyTimes(times);
            return [ring.rows, ring.lost, times];
        }""")
    assert (rows, lost) == (100, 0)
    assert times == [seq * 0.05 for seq in range(1, 101)]


def test_the_memory_of_the_page_is_the_same_after_a_day_of_ticks(window: WindowProcess) -> None:
    with live_page(window.url) as (page, _):
        page.evaluate(f"(async () => {{ {APP} app.stream.socket.onmessage = null; {FEED} }})()")
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")

        def heap() -> float:
            for _ in range(3):
                session.send("HeapProfiler.collectGarbage")
            metrics = session.send("Performance.getMetrics")["metrics"]
            return next(m["value"] for m in metrics if m["name"] == "JSHeapUsedSize") / 1e6

        page.select_option("#seconds", "600")
        page.evaluate("feed(72000, 1000)")
        before = heap()
        for hour in range(24):
            page.evaluate("feed(72000, 1000)")
            page.click("#pause")  # stands still, or follows again
            page.select_option("#seconds", ("15", "60", "600")[hour % 3])
        after = heap()
        print(f"JS heap before {before:.1f} MB, after a day {after:.1f} MB")
        assert abs(after - before) <= 5.0


def test_the_keyboard_reaches_everything_and_the_focus_is_visible(window: WindowProcess) -> None:
    with live_page(window.url) as (page, _):
        swim(page)
        page.click("#show-camera")
        complete = {"experiments": "#preview code", "runs": "#runs .complete", "fish": "#events ol"}
        for place in ("live", *complete):
            go(page, place)
            expect(page.locator(complete.get(place, "#mode"))).to_be_visible()
            walk(page)
        go(page, "live")
        show_chart_tools(page)
        walk(page)


def show_chart_tools(page: Page) -> None:
    """Let the charts stand still, show their list, and set a cursor."""
    page.click("#pause")
    page.get_by_role("button", name="Charts", exact=True).click()
    page.locator(".plot").first.press("Shift+ArrowLeft")
    expect(page.locator("#mark-here")).to_be_visible()


def walk(page: Page) -> None:
    """Reach everything that is shown with the Tab key, in reading order, the E-stop first."""
    reachable = page.evaluate("""() => {
        const kinds = "button, input, select, summary, a[href], [tabindex='0']";
        const isReachable = (node) => !node.disabled && node.checkVisibility();
        globalThis.wanted = [...document.querySelectorAll(kinds)].filter(isReachable);
        return wanted.length;
    }""")
    page.keyboard.press("Tab")
    while page.evaluate("document.activeElement.id") != "estop":
        page.keyboard.press("Tab")  # begins where the mouse was last
    focused = []
    for _ in range(reachable):
        focused.append(
            page.evaluate("""() => {
                const { outlineStyle, outlineWidth } = getComputedStyle(document.activeElement);
                if (outlineStyle === "none" || parseFloat(outlineWidth) < 2)
                    throw new Error(`no focus is seen: ${document.activeElement.id}`);
                return wanted.indexOf(document.activeElement);
            }""")
        )
        page.keyboard.press("Tab")
    assert focused == list(range(reachable))  # in reading order, and the E-stop first


def test_nothing_is_wider_than_the_screen_and_the_emergency_stop_keeps_its_place(
    window: WindowProcess,
) -> None:
    with live_page(window.url) as (page, _):
        for width in (1280, 800, 390):
            page.set_viewport_size({"width": width, "height": 844})
            box = page.locator("#estop").bounding_box()
            assert box
            assert box["x"] + box["width"] > width - 20
            swim(page)
            show_camera(page)
            for place in ("experiments", "runs", "fish", "live"):
                go(page, place)
                page.evaluate("scrollTo(0, 600)")
                assert page.locator("#estop").bounding_box() == box
                assert page.evaluate("document.documentElement.scrollWidth") == width
                for always in ("#mode", "#thrust"):
                    expect(page.locator(always)).to_be_in_viewport(ratio=1)
            page.click("#stop")
            expect(page.locator("#mode")).to_have_text("idle")


def test_no_barrier_is_serious(window: WindowProcess) -> None:
    with live_page(window.url, bypass_csp=True) as (page, _):
        page.evaluate(AXE.read_text(encoding="utf-8"))
        swim(page)
        show_camera(page)
        go(page, "fish")
        page.click("#checks button")
        expect(page.locator("#checks tbody tr").first).to_be_visible()
        for width in (1280, 800, 390):
            page.set_viewport_size({"width": width, "height": 844})
            for place in ("experiments", "runs", "fish", "live"):
                go(page, place)
                if place == "experiments":
                    page.click("#tab-optimise")
                    page.locator("#experiment details").evaluate("node => node.open = true")
                refuse_barriers(page)
        show_chart_tools(page)
        refuse_barriers(page)
        page.click("#estop")
        expect(page.locator("#latched")).to_be_visible()
        refuse_barriers(page)


def show_camera(page: Page) -> None:
    """Open the tile of the camera; no camera is there, and the tile says so."""
    if page.locator("#show-camera").is_visible():
        page.click("#show-camera")
    expect(page.locator("#camera .note")).to_contain_text("No camera at")


def refuse_barriers(page: Page) -> None:
    """Fail if the page has a serious barrier in light or dark colours."""
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        serious = [
            (violation["id"], [node["html"] for node in violation["nodes"]])
            for violation in page.evaluate(FIND_BARRIERS)
            if violation["impact"] in ("serious", "critical")
        ]
        assert serious == [], (page.url, page.viewport_size, scheme)


def test_a_queue_is_filled_ordered_started_and_stopped_without_a_mouse(
    new_window: WindowProcess,
) -> None:
    with live_page(new_window.url, bypass_csp=True) as (page, complaints):
        page.evaluate(AXE.read_text(encoding="utf-8"))
        go(page, "experiments")
        queue, queued = page.locator(".queue"), page.locator(".queued code")
        expect(queue).to_contain_text("Empty")
        for count, seconds in enumerate(("21", "50", "45")):
            page.fill("#option-seconds", seconds)
            add = page.get_by_role("button", name="Add to queue")
            expect(add).to_be_enabled()
            add.press("Enter")
            expect(queued).to_have_count(count + 1)
        page.get_by_role("button", name="Move up measure swing --for 45 --on=live").press("Enter")
        expect(queued.nth(1)).to_have_text("fishctl measure swing --for 45 --on=live")
        runs = page.get_by_label("Runs of measure swing --for 50 --on=live")
        runs.fill("3")
        runs.press("Tab")
        expect(queue).to_contain_text("3 in it, about 4\N{NO-BREAK SPACE}min")
        page.get_by_role("button", name="Remove measure swing --for 21 --on=live").press("Enter")
        expect(queued).to_have_count(2)
        stop_at = page.get_by_label("Stop at")
        stop_at.fill("6 pm")
        stop_at.press("Tab")
        expect(page.locator(".notice.warning")).to_contain_text("is not a time of day")
        stop_at.fill("1800")
        stop_at.press("Tab")
        expect(stop_at).to_have_value("18:00")
        expect(queue.get_by_role("button", name="Do not pause")).to_be_visible()
        walk(page)
        refuse_flaws(page)
        queue.get_by_role("button", name="Start queue").press("Enter")
        expect(queue.get_by_role("progressbar")).to_be_visible()
        expect(page.locator("#mode")).to_have_text("running")
        refuse_flaws(page)
        go(page, "live")
        line = page.locator("#queue-line")
        expect(line).to_contain_text("Queue: measure swing --for 45, then measure swing --for 50.")
        line.get_by_role("button", name="Pause after it").press("Enter")
        expect(line).to_contain_text("then it pauses")
        refuse_flaws(page)
        go(page, "experiments")
        queue.get_by_role("button", name="Do not pause").press("Enter")
        queue.get_by_role("button", name="Stop now").press("Enter")
        expect(queue).to_contain_text("It pauses: it was to stop at ")
        expect(queue).to_contain_text("interrupted, is resumed")
        queue.get_by_text("Latest runs").press("Enter")
        expect(queue).to_contain_text("interrupted, the fish rests")
        refuse_flaws(page)
        expect(page.locator("#mode")).to_have_text("idle")
        assert complaints == []


def refuse_flaws(page: Page) -> None:
    """Fail if the page has a serious barrier, or is wider than its screen, at any width."""
    for width in (1280, 800, 390):
        page.set_viewport_size({"width": width, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") == width
        refuse_barriers(page)


def test_the_files_of_the_page_are_small() -> None:
    folder = resources.files("fishd.window").joinpath("page")
    files = [*folder.iterdir(), *folder.joinpath("vendor").iterdir()]
    sizes = [
        len(gzip.compress(file.read_bytes()))
        for file in files
        if file.name.endswith((".html", ".js", ".css"))
    ]
    assert sum(sizes) <= MAX_ASSETS_BYTES
