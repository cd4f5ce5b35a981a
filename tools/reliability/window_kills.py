"""Kills of `fishd-window` at random times while an experiment of its page runs.

Afterwards the fish must be at rest and returned, the child must have ended, the runs must be
readable, and the page of the next window must say what became of the experiment. One in five is
resumed to its end.
"""

import asyncio
import json
import os
import random
import signal
import tempfile
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiohttp
from msgspec import Struct

from common.daemon import TIMEOUT_S, Fishd
from common.processes import FISHCTL, call
from common.report import Options, Report, progress, quantile, table
from fishd.client import Fish
from reliability.window import Window

EXPERIMENTS: dict[str, dict[str, Any]] = {
    "measure": {"controller": "swing", "parameters": {}, "seconds": 21.0},
    "sweep": {"controller": "swing", "parameters": {"C": "0.5,0.6"}, "seconds": 21.0},
}
LONGEST_S = 26.0
"""Largest time from the start of an experiment to the kill [s]."""
RESUME_EVERY = 5
WATCH_S = 20.0
"""Time within which everything must have come to rest [s]."""
MAX_REST_S = 5.0
"""Largest time from a kill until the fish rests [s]: the lease ends after two."""


class Kill(Struct):
    """One kill, and what it left."""

    kind: str
    after: float
    """Time from the start of the experiment to the kill [s]."""
    swimming: bool
    rest: float | None
    """Time from the kill until the fish was at rest and returned [s]; None: it never was."""
    child: float | None
    """Time from the kill until the child had ended [s]; None: it never did."""
    readable: bool
    """Whether `fishctl runs` reads all runs."""
    outcome: str
    """State of the job in the page of the next window; `resumable` where it can be resumed."""
    resumed: str = ""
    """State after it was resumed; empty where it was not."""

    @property
    def is_broken(self) -> bool:
        """Whether a promise was not kept."""
        late = self.rest is None or self.rest > MAX_REST_S or self.child is None
        bad = not self.readable or self.outcome not in ("done", "lost", "resumable")
        return late or bad or self.resumed not in ("", "done")


class Page:
    """A page of a window that drives its fish; an asynchronous context manager."""

    def __init__(self, port: int) -> None:
        self._url = f"http://127.0.0.1:{port}"

    async def __aenter__(self) -> "Page":
        self._session = aiohttp.ClientSession(self._url, headers={"Origin": self._url})
        self._sock = await self._session.ws_connect("/live", max_msg_size=0)
        self.hello: Any = None
        while not (self.hello and self.hello["controllers"]):  # the window has not reached fishd
            kind, message = json.loads(await self._sock.receive_str())
            self.hello = message if kind == "hello" else self.hello
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._session.close()

    async def post(self, path: str, body: Any) -> Any:
        """Return the result of a request."""
        headers = {"X-Client": self.hello["client"]}
        async with self._session.post(path, json=body, headers=headers) as response:
            answer = json.loads(await response.read())
        assert answer["ok"], answer
        return answer["result"]

    async def start(self, kind: str, options: dict[str, Any]) -> Any:
        """Drive the fish, and start an experiment; return its job."""
        await self.post("/api/fish/fish/drive", {"take": True})
        return await self.post("/api/jobs", {"fish": "fish", "kind": kind, "options": options})

    async def end_of(self, job: Any) -> str:
        """Return the state of a job that has ended."""
        while True:
            kind, message = json.loads(await self._sock.receive_str())
            if kind == "job" and message["id"] == job["id"] and message["state"] != "running":
                return str(message["state"])
            await self._sock.send_str('["seen"]')


def list_children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in text.split()]


def is_alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended and is not yet reaped does not."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def wait_for(true: Callable[[], bool], begin: float) -> float | None:
    """Return the time from `begin` until a condition holds [s]; None if it does not in time."""
    while not true():
        if time.monotonic() > begin + WATCH_S:
            return None
        time.sleep(0.05)
    return time.monotonic() - begin


def kill_once(fishd: Fishd, folder: Path, kind: str, after: float, resume: bool) -> Kill:
    """Start a window and an experiment, kill the window, and look at what is left.

    after: time from the start of the experiment to the kill [s]
    """

    async def start_and_kill(window: Window) -> None:
        async with Page(window.port) as page:
            await page.start(kind, EXPERIMENTS[kind])
            await asyncio.sleep(after)

    async def read_outcome(window: Window) -> tuple[str, str]:
        async with Page(window.port) as page:
            job = page.hello["jobs"][-1]
            outcome = "resumable" if job["resumable"] else job["state"]
            if not resume or outcome != "resumable":
                return outcome, ""
            resumed = await page.start("resume", {"run": job["run"]})
            return outcome, await page.end_of(resumed)

    runs = str(folder / "runs")
    os.environ["FISHD_RUNS"] = runs
    with Fish(fishd.endpoint) as fish:
        with Window(fishd.endpoint, str(folder)) as window:
            asyncio.run(start_and_kill(window))
            children = list_children(window.pid)
            swimming = fish.status().mode == "running"
            os.kill(window.pid, signal.SIGKILL)
            begin = time.monotonic()
        child = wait_for(lambda: not any(map(is_alive, children)), begin)

        def rests() -> bool:
            status = fish.status()
            return status.mode == "idle" and status.lease is None

        rest = wait_for(rests, begin)
    readable = call(FISHCTL, "runs", "--folder", runs, "--json").returncode == 0
    with Window(fishd.endpoint, str(folder)) as window:
        outcome, resumed = asyncio.run(read_outcome(window))
    return Kill(kind, after, swimming, rest, child, readable, outcome, resumed)


OPTIONS: Options = {
    "--number": {"type": int, "default": 30, "help": "of kills; default 30"},
    "--seed": {"type": int, "default": 1, "help": "default 1"},
}


def measure(options: Namespace) -> Report:
    """Kill windows; ten minutes."""
    chance = random.Random(options.seed)
    kills = list[Kill]()
    with (
        tempfile.TemporaryDirectory() as name,
        Fishd("start.controller=hold", "realtime.priority=0") as fishd,
    ):
        fishd.next_tick(TIMEOUT_S)
        with Fish(fishd.endpoint) as fish:
            fish.stop()
        for number in range(options.number):
            kind, after = chance.choice(list(EXPERIMENTS)), chance.uniform(0.0, LONGEST_S)
            resume = number % RESUME_EVERY == 0
            kill = kill_once(fishd, Path(name), kind, after, resume)
            kills.append(kill)
            progress(f"{number + 1}", f"{kill}")
    rows = []
    for kind in EXPERIMENTS:
        own = [kill for kill in kills if kill.kind == kind]
        if not own:
            continue
        rests = [WATCH_S if kill.rest is None else kill.rest for kill in own]
        ends = [WATCH_S if kill.child is None else kill.child for kill in own]
        outcomes = Counter(kill.outcome for kill in own)
        resumed = Counter(kill.resumed for kill in own if kill.resumed)
        rows.append(
            [
                kind,
                f"{len(own)}, {sum(kill.swimming for kill in own)} of them swimming",
                f"{quantile(rests, 0.5):.1f} s, {max(rests):.1f} s",
                f"{max(ends):.1f} s",
                ", ".join(f"{count} {what}" for what, count in outcomes.items()),
                ", ".join(f"{count} {what}" for what, count in resumed.items()) or "–",
            ]
        )
    unreadable = sum(not kill.readable for kill in kills)
    head = (
        "experiment | kills | fish at rest: median, longest | child ended within | "
        "in the next page | resumed"
    )
    words = f"Runs that could not be read: {unreadable}. Seed {options.seed}."
    broken = any(kill.is_broken for kill in kills)
    text = f"{table(head, rows)}\n\n{words}"
    rests = [kill.rest for kill in kills if kill.rest is not None]
    result = (
        f"{sum(kill.is_broken for kill in kills)} promises broken in {len(kills)} kills; fish at "
        f"rest within {max(rests, default=WATCH_S):.1f} s; {unreadable} runs not readable"
    )
    return Report({"reliability window_kills": text}, kills, broken=broken, number=result)
