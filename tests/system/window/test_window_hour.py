"""Test of what a physicist does at the page in an hour, without a terminal, in a true browser."""

import csv
import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, expect
from rigs.browser import needs_browser, open_page, shared_browser
from rigs.live_page import RESOLVED, go, name_device, swim
from rigs.processes import Daemon, wait_until
from rigs.window_process import WindowProcess

pytestmark = needs_browser


@pytest.fixture(autouse=True)
def browser() -> Iterator[None]:
    with shared_browser(RESOLVED):
        yield


def test_a_physicist_needs_no_terminal_after_the_link(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    link = new_window.invite()
    with open_page(link.partition("#")[0]) as (page, complaints):
        expect(page.locator(".pairing")).to_contain_text("not paired")
        page.goto(link)
        name_device(page, "tablet at the tank")
        expect(page.locator("#connection")).to_contain_text("live")
        swim(page, "square")
        expect(page.locator("#cards")).to_contain_text("square")
        page.click("#stop")
        expect(page.locator("#mode")).to_have_text("idle")

        go(page, "experiments")
        for number, values in enumerate(("1:2:0.5", "1.4:1.8:0.2"), 1):
            sweep_on_simulation(page, values)
            expect(page.locator(".job.done")).to_have_count(number)

        go(page, "runs")
        runs = page.locator("#runs")
        expect(runs.locator(".pick input")).to_have_count(2)
        for run in range(2):
            runs.locator(".pick input").nth(run).check()
        page.get_by_role("button", name="Compare 2").click()
        comparison = page.locator(".comparison")
        expect(comparison.locator("tbody tr")).to_have_count(2)
        expect(comparison.locator(".rows .keys > span")).to_have_count(2)
        expect(comparison.get_by_role("img")).to_have_accessible_name(
            "Chart of the rows of the runs: thrust over parameters.frequency"
        )
        expect(comparison.locator(".note")).to_have_count(0)

        go(page, "experiments")
        page.click("#tab-measure")
        for controller in ("square", "swing", "sine"):
            page.select_option("#controller", controller)
            expect(page.locator("#preview code")).to_contain_text(f"measure {controller}")
            page.get_by_role("button", name="Add to queue").click()
            expect(page.locator(".queued code").last).to_contain_text(f"measure {controller}")
        page.get_by_label("Runs of measure swing").fill("3")
        page.get_by_label("Runs of measure swing").press("Enter")
        page.get_by_role("button", name="Move up measure sine").click()
        expect(page.locator(".queued code").nth(1)).to_contain_text("measure sine")
        page.get_by_label("Stop at").fill("18:00")
        page.get_by_label("Stop at").press("Enter")
        expect(page.get_by_role("button", name="Do not pause")).to_be_enabled()
        page.get_by_role("button", name="Start queue").click()
        expect(page.locator("#mode")).to_have_text("running")
        expect(page.locator(".queued").first).to_contain_text("runs")
        expect(page.get_by_label("Progress of queue")).to_be_visible()
        page.get_by_role("button", name="Stop now").click()
        expect(page.locator(".queue")).to_contain_text("It pauses: it was to stop")

        go(page, "runs")
        page.get_by_label("Find").fill("sweep")
        runs.get_by_role("button", name=re.compile("^Open sweep")).first.click()
        page.get_by_role("textbox", name="Name").fill("fine sweep")
        page.get_by_role("button", name="Rename").click()
        expect(page.get_by_role("button", name="Close fine sweep")).to_be_visible()
        with page.expect_download() as download:
            page.get_by_role("link", name="Rows (CSV)").click()
        assert download.value.suggested_filename == "fine sweep-rows.csv"
        with download.value.path().open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["parameters.frequency"] for row in rows] == ["1.4", "1.6", "1.8"]

        go(page, "live")
        swim(page)
        page.click("#stop")
        wait_until(lambda: daemon.status().mode == "idle")
        # The picture under the old name may still be asked for when the run is renamed.
        assert [line for line in complaints if "409" not in line] == []


def sweep_on_simulation(page: Page, values: str) -> None:
    """Start a short sweep of square waves over these frequencies."""
    page.click("#tab-sweep")
    page.select_option("#controller", "square")
    page.get_by_role("textbox", name="Values").fill(values)
    page.select_option("#option-on", "simulation")
    if not page.locator("#option-periods").is_visible():
        page.get_by_text("More options").click()
    page.fill("#option-settle", "1")
    page.fill("#option-periods", "2")
    options = "--settle 1 --periods 2 --on simulation"
    expect(page.locator("#preview code")).to_contain_text(f"{values} {options}")
    page.click("#experiment .primary")
