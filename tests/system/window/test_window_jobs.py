"""Experiments of the page: true verbs of fishctl, their progress, and their ends."""

import os
import shlex
import signal
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import Daemon, wait_until
from rigs.window_process import Browser, Page, WindowProcess, open_page, running_window


async def start(page: Page, kind: str, **options: Any) -> Any:
    """Start a job, and return it."""
    return await page.post("/api/jobs", {"fish": "fish", "kind": kind, "options": options})


async def end_of(page: Page, job: Any) -> Any:
    """Return a job that has ended."""
    return await page.until("job", lambda j: j["id"] == job["id"] and j["state"] != "running")


async def test_a_recording_is_made_listed_and_drawn(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        job = await start(page, "record", name="first", seconds=0.5, note="a; $(b) 'c'")
        assert job["command"][:3] == ["fishctl", "record", "first"]
        ended = await end_of(page, job)
        assert (ended["state"], ended["exit"]) == ("done", 0), ended["lines"]
        assert ended["result"]["ticks"] > 0
        run_ = next(entry for entry in await browser.get("/api/runs") if entry["name"] == "first")
        assert run_["about"]["note"] == "a; $(b) 'c'"
        async with browser.session.get("/api/runs/first/plot.png") as response:
            assert (response.status, response.content_type) == (200, "image/png")
            assert (await response.read()).startswith(b"\x89PNG")
        assert await browser.refusal("/api/runs/none/plot.png") == (409, "job")


async def test_the_duration_of_a_job_does_not_follow_the_unix_clock(
    daemon: Daemon, tmp_path: Path
) -> None:
    changes = "import time; begin = time.monotonic()\n"
    changes += "time.time = lambda: 1e9 - 100 * (time.monotonic() - begin)"  # set back all the time

    with running_window(tmp_path, changes=changes, fish=daemon.endpoint) as process:
        async with Browser(process.url) as browser, open_page(browser) as page:
            job = await start(page, "record", name="backwards", seconds=1.0)
            ended = await end_of(page, job)
            assert ended["elapsed"] >= 1.0
            assert ended["elapsed"] in [
                entry["elapsed"] for entry in await browser.get("/api/jobs")
            ]


async def test_a_recording_is_stopped_and_kept(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        job = await start(page, "record", name="endless")
        await page.until("job", lambda j: "recording to" in "".join(j["lines"]))
        await page.post(f"/api/jobs/{job['id']}/stop")
        ended = await end_of(page, job)
        assert (ended["state"], ended["exit"]) == ("stopped", 0)
        runs = [entry["name"] for entry in await browser.get("/api/runs")]
        assert "endless" in runs
        assert ended["id"] in [entry["id"] for entry in await browser.get("/api/jobs")]


async def test_an_experiment_takes_the_fish_from_the_page_and_lets_it_rest_when_stopped(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        options = {"controller": "square", "parameters": {"frequency": 2}}
        refused = {"fish": "fish", "kind": "measure", "options": options}
        await page.swim("sine")
        await page.post("release")
        assert await page.refusal("/api/jobs", refused) == (409, "not-driver")
        await page.swim("sine")
        job = await start(page, "measure", **options, seconds=60)
        status = await page.until(
            "status", lambda s: s["lease"] and s["lease"]["name"] == "measure square"
        )
        assert status["lease"]["name"] == "measure square"
        await page.until("ticks", lambda ticks: ticks[-1]["controller"] == "square")
        await page.post(f"/api/jobs/{job['id']}/stop")
        ended = await end_of(page, job)
        assert (ended["state"], ended["resumable"]) == ("stopped", True)
    assert daemon.status().lease is None


async def test_an_experiment_shows_what_a_person_would_type_and_leaves_a_thrust_among_the_runs(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        options = {"controller": "square", "parameters": {"frequency": 1.5}, "seconds": 21}
        job = await start(page, "measure", **options)
        shown = f"fishctl measure square --frequency 1.5 --for 21 --endpoint {daemon.endpoint}"
        assert shlex.join(job["command"]) == shown
        ended = await end_of(page, job)
        assert ended["state"] == "done", ended["lines"]
        (run_,) = [r for r in await browser.get("/api/runs") if r["name"] == job["run"]]
        result = ended["result"]
        for key in ("thrust", "thrust_ci95", "total_ci95"):
            assert run_[key] == result[key] > 0.0
        assert (run_["state"], ended["resumable"]) == ("finished", False)
        async with browser.session.get(f"/api/runs/{job['run']}/plot.png") as response:
            assert (await response.read()).startswith(b"\x89PNG")
        await page.drive()
        refused = {"fish": "fish", "kind": "resume", "options": {"run": "none"}}
        assert await page.refusal("/api/jobs", refused) == (409, "job")


async def test_a_simulated_fish_swims_first_and_its_curve_is_drawn(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        job = await start(page, "simulate", controller="swing", parameters={"C": 0.5}, seconds=12)
        result = (await end_of(page, job))["result"]
        assert result["parameters"]["C"] == 0.5
        curve = result["curve"]
        assert len(curve["time"]) == len(curve["fx"]) == len(curve["alpha"]) == result["ticks"]


@pytest.mark.parametrize(
    ("kind", "options", "code"),
    [
        ("fly", {}, "unknown-kind"),
        ("measure", {"controller": "--help"}, "bad-arguments"),
        ("measure", {"controller": "square", "parameters": {"--config": 1}}, "bad-arguments"),
        ("measure", {"controller": "square", "parameters": {"config": "a"}}, "bad-arguments"),
        (
            "measure",
            {"controller": "ppo", "parameters": {"policy": "/etc/passwd"}},
            "bad-arguments",
        ),
        ("measure", {"controller": "square", "seconds": 3}, "bad-arguments"),
        ("sweep", {"controller": "square", "seconds": 20}, "bad-arguments"),
        ("compare", {"contestants": ["swing"], "seconds": 4000}, "bad-arguments"),
        ("record", {"name": "../above"}, "bad-arguments"),
        ("record", {"name": "-x"}, "bad-arguments"),
        ("record", {"name": "line\n"}, "bad-arguments"),
        ("record", {"note": "bell\x07"}, "bad-arguments"),
        ("compare", {"contestants": ["--folder=/"]}, "bad-arguments"),
        ("measure", {"controller": "ppo", "parameters": {"policy": "-x.onnx"}}, "bad-arguments"),
        ("measure", {"controller": "square", "folder": "/tmp/x"}, "bad-arguments"),
        ("measure", {"controller": "square", "on": "moon"}, "bad-arguments"),
        ("sweep", {"controller": "square", "parameters": {"frequency": "1;2"}}, "bad-arguments"),
        ("sweep", {"controller": "square", "jobs": 99}, "bad-arguments"),
        ("sweep", {"controller": "square", "cluster": "tcp://example.org:1"}, "bad-arguments"),
        ("optimise", {"controller": "square"}, "bad-arguments"),
        ("optimise", {"controller": "square", "budget": -1}, "bad-arguments"),
        ("identify", {"recordings": ["../above"]}, "bad-arguments"),
        ("identify", {"fit": "line\n"}, "bad-arguments"),
        ("adapt", {"budget": 10}, "bad-arguments"),
        ("adapt", {"on": "simulation", "no_command": True}, "bad-arguments"),
        ("learn", {"seeds": 1000}, "bad-arguments"),
        ("learn", {"settings_file": "/etc/passwd"}, "bad-arguments"),
        ("rerun", {"run": "/etc/passwd"}, "bad-arguments"),
        ("resume", {"run": "../above"}, "bad-arguments"),
        ("simulate", {"controller": "square", "seconds": 1e9}, "bad-arguments"),
        ("simulate", {"controller": "square", "jobs": 9}, "bad-arguments"),
    ],
)
async def test_neither_words_of_a_command_line_nor_impossible_times_come_from_a_page(
    window: WindowProcess, kind: str, options: Any, code: str
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        body = {"fish": "fish", "kind": kind, "options": options}
        assert await page.refusal("/api/jobs", body) == (400, code)


async def test_a_job_that_fails_says_why_and_is_dismissed(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        ended = await end_of(page, await start(page, "rerun", run="none"))
        assert (ended["state"], ended["exit"]) == ("failed", 1)
        assert "none" in ended["lines"][-1]
        await page.post(f"/api/jobs/{ended['id']}/dismiss")
        await page.until("job", lambda job: job["state"] == "dismissed")
        assert ended["id"] not in [job["id"] for job in await browser.get("/api/jobs")]
        assert await page.refusal(f"/api/jobs/{ended['id']}/dismiss") == (409, "job")


async def test_a_job_that_runs_is_not_dismissed(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        job = await start(page, "record", name="kept")
        assert await page.refusal(f"/api/jobs/{job['id']}/dismiss") == (409, "job")
        await page.post(f"/api/jobs/{job['id']}/stop")
        await end_of(page, job)


async def test_a_job_is_checked_without_being_started(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        before = await browser.get("/api/jobs")
        body = {"fish": "fish", "kind": "measure", "options": {"controller": "square"}}
        words = ["fishctl", "measure", "square"]
        checked = await page.post("/api/jobs/check", body)
        plan = {"amount": 60.0, "unit": "s", "seconds": 60.0}
        assert checked == {"command": words, "problem": "", "plan": plan}
        body["options"] = {"controller": "square", "seconds": 20}
        refused = await page.post("/api/jobs/check", body)
        assert refused["command"] == []
        assert "20.25 to 3600 s are needed" in refused["problem"]
        body |= {"kind": "resume", "options": {"run": "none"}}
        assert (await page.post("/api/jobs/check", body))["command"] == ["fishctl", "resume"]
        assert await browser.get("/api/jobs") == before


async def test_each_experiment_is_planned_by_its_verb(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        varied = {"controller": "square", "parameters": {"frequency": "1:2:0.5"}}
        searched = {"controller": "square", "parameters": {"frequency": ":"}}
        for kind, options, words, plan in (
            ("sweep", varied, "square --frequency 1:2:0.5", (90.0, "s", 90.0)),
            ("compare", {"contestants": ["square", "swing"], "runs": 2}, None, (240.0, "s", 240.0)),
            ("optimise", {**searched, "budget": 100}, None, (100.0, "s", 100.0)),
            ("identify", {"seconds": 30}, "--experiment --for 30", (30.0, "s", 30.0)),
            ("adapt", {"budget": 200}, "--budget 200", (200.0, "s", 200.0)),
            ("sweep", {**varied, "on": "simulation"}, None, (3.0, "points", None)),
            ("learn", {"on": "simulation", "steps": 1}, None, (64.0, "steps", None)),
            ("simulate", {"controller": "square"}, "square", (60.0, "s of virtual time", None)),
            ("record", {}, "", None),
        ):
            body = {"fish": "fish", "kind": kind, "options": options}
            checked = await page.post("/api/jobs/check", body)
            assert checked["problem"] == ""
            expected = plan and dict(zip(("amount", "unit", "seconds"), plan, strict=True))
            assert checked["plan"] == expected, kind
            if words is not None:
                verb = kind if words == "" else f"{kind} {words}"
                assert shlex.join(checked["command"]) == f"fishctl {verb}"


async def test_an_experiment_on_a_simulated_fish_shows_its_curve_and_leaves_the_live_fish_alone(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        options = {"controller": "square", "parameters": {"frequency": "1:3"}, "budget": 100}
        job = await start(page, "optimise", **options, on="simulation")
        ended = await end_of(page, job)
        assert ended["state"] == "done", ended["lines"]
        assert ended["points"][0]["x_name"] == "frequency [Hz]"
        assert len(ended["points"]) == ended["result"]["trials"]
        best, thrust = ended["progress"]["estimates"]
        assert (best["name"], best["unit"]) == ("best frequency", "Hz")
        assert best["low"] <= best["value"] <= best["high"]
        assert thrust["low"] < ended["result"]["true_thrust"] < thrust["high"]
        assert not [line for line in ended["lines"] if "progress" in line]
        names = [entry["name"] for entry in await browser.get("/api/runs")]
        assert job["run"] in names
    assert daemon.status().mode == "idle"


async def test_the_interval_of_a_measurement_shrinks_while_it_runs(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        job = await start(page, "measure", controller="square", seconds=200, on="simulation")
        ended = await end_of(page, job)
        widths = [point["ci95"] for point in ended["points"]]
        assert len(widths) > 10
        assert widths[-1] < 0.5 * widths[0]
        assert ended["progress"]["fraction"] == 1.0


async def test_a_policy_from_a_file_is_measured_and_swept(
    window: WindowProcess, tmp_path: Path
) -> None:
    policy = tmp_path / "copy of it.onnx"
    policy.write_bytes(Path("config/policies/default-fish.onnx").read_bytes())
    async with Browser(window.url) as browser, open_page(browser) as page:
        options = {"controller": "ppo", "parameters": {"policy": str(policy)}, "on": "simulation"}
        ended = await end_of(page, await start(page, "measure", **options, seconds=30))
        assert ended["state"] == "done", ended["lines"]
        options["parameters"] = {"policy": f"default-fish,{policy}"}
        body = {"fish": "fish", "kind": "sweep", "options": options}
        checked = await page.post("/api/jobs/check", body)
        assert (checked["problem"], checked["plan"]["amount"]) == ("", 2.0)


async def test_no_other_job_is_stopped_by_a_wrong_number(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        assert await page.refusal("/api/jobs/99/stop") == (409, "job")


async def test_an_experiment_that_is_lost_with_its_window_is_an_unfinished_run_of_the_next_one(
    new_window: WindowProcess, daemon: Daemon, tmp_path: Path
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        await page.drive()
        await start(page, "measure", controller="square", seconds=21)
        await page.until("ticks", lambda ticks: ticks[-1]["controller"] == "square")
        os.kill(new_window.pid, signal.SIGKILL)
    wait_until(lambda: daemon.status().mode == "idle" and daemon.status().lease is None)
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            assert page.hello["jobs"] == []
            (lost,) = [run for run in await browser.get("/api/runs") if run["kind"] == "measure"]
            assert lost["state"] == "unfinished"
            await page.drive()
            job = await start(page, "resume", run=lost["name"])
            assert job["command"][:3] == ["fishctl", "measure", "--resume"]
            await page.until("ticks", lambda ticks: ticks[-1]["controller"] == "square")
            await page.post(f"/api/jobs/{job['id']}/stop")
            assert (await end_of(page, job))["state"] == "stopped"
        assert list(window.state.glob("window-*.json")) == [
            window.state / f"window-{window.pid}.json"
        ]
