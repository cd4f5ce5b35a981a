"""The queue of experiments in the window: the same as that of the terminal, and safe to leave."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import FISHCTL, Daemon, call, wait_until
from rigs.window_process import Browser, Page, WindowProcess, open_page, running_window

QUEUE = "/api/fish/fish/queue"
MEASURE = {"op": "add", "kind": "measure", "options": {"controller": "square", "seconds": 60}}


async def add(page: Page, **changes: Any) -> Any:
    """Add a measurement, and return the queue."""
    return await page.post("queue", {**MEASURE, **changes})


async def start(page: Page) -> None:
    """Start the queue, and wait until the fish swims."""
    await page.drive()
    await page.post("/api/jobs", {"fish": "fish", "kind": "queue"})
    await page.until("ticks", lambda ticks: ticks[-1]["mode"] == "running")


async def end_of_job(page: Page) -> Any:
    """Return the job of the queue when it has ended."""
    return await page.until("job", lambda job: job["kind"] == "queue" and job["state"] != "running")


def terminal(window: WindowProcess, daemon: Daemon, *words: str) -> Any:
    """Return the JSON of a verb of the queue in a terminal of the same fish and runs."""
    runs = window.state.parent / "runs"
    command = ("--endpoint", daemon.endpoint, "queue", *words, "--json")
    done = call(FISHCTL, *command, env={**os.environ, "FISHD_RUNS": str(runs)})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


async def test_a_page_and_a_terminal_change_the_same_queue(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        assert (await browser.get(QUEUE))["state"] == "empty"
        view = await add(page, repeat=3)
        assert view["items"][0]["words"] == ["measure", "square", "--on=live"]
        assert (view["state"], view["left"]) == ("paused", 180.0)
        terminal(new_window, daemon, "add", "sweep", "sine", "frequency=1,2")
        view = await page.post("queue", {"op": "move", "number": 2, "position": 1})
        assert [item["id"] for item in view["items"]] == [2, 1]
        view = await page.post("queue", {"op": "repeat", "number": 1, "repeat": 5})
        assert [item["repeat"] for item in view["items"]] == [1, 5]
        view = await page.post("queue", {"op": "pause", "at": 2e9})
        assert (view["pauses"], view["pause_at"]) == (False, 2e9)
        assert terminal(new_window, daemon, "list") == view
        view = await page.post("queue", {"op": "cancel-pause"})
        assert view["pause_at"] is None
        view = await page.post("queue", {"op": "remove", "number": 2})
        assert [item["id"] for item in view["items"]] == [1]
        terminal(new_window, daemon, "clear")
        assert (await browser.get(QUEUE))["items"] == []


async def test_each_experiment_of_a_form_waits_in_the_queue(new_window: WindowProcess) -> None:
    square = {"controller": "square"}
    options: dict[str, Any] = {
        "measure": square,
        "sweep": {**square, "parameters": {"frequency": "1,1.5,2"}},
        "compare": {"contestants": ["square", "swing:C=0.6"]},
        "optimise": {**square, "parameters": {"frequency": "1:3"}},
        "identify": {},
        "adapt": {},
        "learn": {"steps": 1000, "on": "simulation"},
    }
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        for kind, given in options.items():
            view = await page.post("queue", {"op": "add", "kind": kind, "options": given})
            assert view["items"][-1]["words"][0] == kind
        assert [item["seconds"] for item in view["items"][:5]] == [60, 90, 120, 300, 180]
        assert view["items"][-1]["words"][-2:] == ["--steps", "1000"]


async def test_a_queue_that_a_page_starts_goes_on_without_it_and_is_stopped_by_another(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as browser:
        async with open_page(browser) as page:
            await add(page)
            refused = {"fish": "fish", "kind": "queue"}
            assert await page.refusal("/api/jobs", refused) == (409, "not-driver")
            await start(page)
        async with open_page(browser) as other:
            view = await browser.get(QUEUE)
            assert (view["state"], view["current"]) == ("running", 1)
            lease = await other.until("status", lambda status: status["lease"])
            assert lease["lease"]["name"] == "measure square"
            await other.post("queue", {"op": "stop"})
            assert (await end_of_job(other))["exit"] == 0
            view = await browser.get(QUEUE)
            assert (view["state"], view["items"][0]["id"]) == ("paused", 1)
            assert view["reason"].startswith("it was to stop at ")
            names = [run["name"] for run in await browser.get("/api/runs")]
            assert view["items"][0]["run"] in names
    assert daemon.status().mode == "idle"


async def test_a_page_gets_progress_and_curve_of_the_experiment_that_runs_in_the_queue(
    new_window: WindowProcess,
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        for values in ("1,1.5", "2,2.5"):
            options = {"controller": "square", "parameters": {"frequency": values}}
            options |= {"on": "simulation", "settle": 1, "periods": 2}
            await page.post("queue", {"op": "add", "kind": "sweep", "options": options})
        await page.drive()
        await page.post("/api/jobs", {"fish": "fish", "kind": "queue"})
        ended = await end_of_job(page)
        # The points of a sweep in simulation are computed side by side, and end in any order.
        assert sorted(point["x"] for point in ended["points"]) == [2.0, 2.5]
        assert ended["progress"]["fraction"] == 1.0


async def test_an_emergency_stop_of_a_page_pauses_the_queue(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        await add(page, repeat=2)
        await start(page)
        await page.post("estop")
        ended = await end_of_job(page)
        assert (ended["state"], ended["exit"]) == ("failed", 1)
        assert "the queue pauses: experiment 1 failed" in ended["lines"][-1]
        view = await browser.get(QUEUE)
        assert (view["state"], view["items"][0]["repeat"]) == ("paused", 2)
        await page.drive()
        await page.request("clear-fault")
    assert daemon.status().mode == "idle"


async def test_a_queue_whose_window_is_killed_waits_for_a_start_in_the_next_one(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            await add(page)
            await start(page)
            os.kill(window.pid, signal.SIGKILL)
            window.process.wait()
    wait_until(lambda: daemon.status().lease is None)
    assert daemon.status().mode == "idle"
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            while (view := await browser.get(QUEUE))["state"] == "running":
                pass  # its runner ends, too, after it has stopped the run
            assert (view["reason"], view["current"]) == ("it was stopped", None)
            assert view["items"][0]["run"]
            assert page.hello["jobs"] == []
    assert daemon.status().mode == "idle"


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"op": "fly"}, 400, "bad-arguments"),
        ({}, 400, "bad-arguments"),
        ({"op": "move", "number": 1, "position": 0}, 400, "bad-arguments"),
        ({"op": "move", "number": -1}, 400, "bad-arguments"),
        ({"op": "remove", "number": "../1"}, 400, "bad-arguments"),
        ({"op": "remove", "number": 99}, 409, "job"),
        ({"op": "repeat", "number": 1, "repeat": 10**6}, 400, "bad-arguments"),
        ({"op": "pause", "at": -1}, 400, "bad-arguments"),
        ({"op": "clear", "words": ["record"]}, 400, "bad-arguments"),
        ({"op": "add", "kind": "record"}, 400, "unknown-kind"),
        ({**MEASURE, "kind": "resume"}, 400, "unknown-kind"),
        ({**MEASURE, "kind": "queue"}, 400, "unknown-kind"),
        ({**MEASURE, "kind": "../above"}, 400, "unknown-kind"),
        ({**MEASURE, "repeat": 0}, 400, "bad-arguments"),
        ({**MEASURE, "options": {"controller": "--help"}}, 400, "bad-arguments"),
        ({**MEASURE, "options": {"controller": "square", "seconds": 3}}, 409, "job"),
        ({**MEASURE, "options": {"controller": "square", "take": True}}, 409, "job"),
        (
            {**MEASURE, "options": {"controller": "square", "parameters": {"frequency": 99}}},
            409,
            "job",
        ),
    ],
)
async def test_a_wrong_change_is_answered_with_its_mistake_and_changes_nothing(
    window: WindowProcess, body: Any, status: int, code: str
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        before = await browser.get(QUEUE)
        assert await page.refusal("queue", body) == (status, code)
        assert await browser.get(QUEUE) == before


async def test_a_damaged_queue_is_one_line_and_stays_as_it_is(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        await add(page)
        (file,) = (new_window.state.parent / "runs").glob("queue*.json")
        file.write_text("{")
        assert await browser.refusal(QUEUE) == (409, "job")
        assert await page.refusal("queue", MEASURE) == (409, "job")
        assert file.read_text() == "{"
