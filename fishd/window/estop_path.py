"""Path of an emergency stop from the window to fishd, which waits for no other work.

It has threads and connections of its own. A probe tests it periodically, so that a page can warn
before it is needed.
"""

import asyncio
import logging
import time
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from fishd.client import Fish
from fishd.core import text
from fishd.core.errors import FishError, NoDaemon, Refused
from fishd.core.process.safe_path import python_command

if TYPE_CHECKING:
    from fishd.core.keys import Access

log = logging.getLogger(__name__)

ESTOP_THREADS = 4
ESTOP_TIMEOUT_S = 0.5
"""Time to wait for the answer of one socket of fishd [s]."""
LAST_RESORT_DELAY_S = 0.3
"""Time from a press to the start of `fishctl estop`, if fishd has not answered by then [s]."""
ANSWER_TIMEOUT_S = 2.0
"""Longest wait for fishd, beside the last resort and whatever the threads wait for [s]."""
LAST_RESORT_TIMEOUT_S = 10.0
"""Time to wait for the end of the last resort [s]."""
PROBE_PERIOD_S = 0.5
"""Time between two probes of the path [s]."""
PROBE_TIMEOUT_S = 1.0
"""Longest wait for the answer to a probe [s]."""
MAX_SILENCE_S = 2.0
"""Time without an answer after which pages warn [s]."""


Outcome = tuple[str, str]
"""Way that stopped the pulses, a socket of fishd or the last resort, and the state since."""


class _Request(Struct, eq=False):
    """Request for an emergency stop, for all presses before it is sent."""

    answer: asyncio.Task[Outcome] | None = None
    is_sent: bool = False


class EstopPath:
    """Path of an emergency stop to one fish; use it in one event loop."""

    def __init__(self, name: str, endpoint: str | None, access: "Access | None") -> None:
        """
        name: name of the fish
        endpoint: its control socket; None for that of this machine
        access: keys for it; None without
        """
        self._endpoint, self._access = endpoint, access
        self._threads = ThreadPoolExecutor(ESTOP_THREADS, thread_name_prefix=f"estop {name}")
        self._prober = ThreadPoolExecutor(1, thread_name_prefix=f"probe {name}")
        self._request = _Request(is_sent=True)
        self._last_resort: asyncio.Task[Outcome] | None = None
        self._answered = time.monotonic()

    def close(self) -> None:
        """End the threads, without waiting for their requests."""
        for threads in (self._threads, self._prober):
            threads.shutdown(wait=False, cancel_futures=True)

    async def stop(self, message: str) -> dict[str, Any]:
        """Stop the pulses; raise `FishError` if neither fishd nor the last resort does so."""
        start = time.monotonic()
        way, outcome = await self._stop(message)
        milliseconds = round((time.monotonic() - start) * 1e3, 1)
        return {"server_ms": milliseconds, "way": way, "outcome": outcome}

    async def _stop(self, message: str) -> Outcome:
        """Return the first outcome: fishd goes on being asked while the last resort runs."""
        if self._request.is_sent:
            self._request = _Request()
            self._request.answer = _start(self._ask(self._request, message))
        answer = self._request.answer
        assert answer
        is_last_resort_running = self._last_resort and not self._last_resort.done()
        try:
            async with asyncio.timeout(0.0 if is_last_resort_running else LAST_RESORT_DELAY_S):
                return await asyncio.shield(answer)
        except Refused:
            raise
        except TimeoutError:
            problem = f"no answer within {LAST_RESORT_DELAY_S:g} s"
        except Exception as error:
            problem = text.error_message(error)
        if not self._last_resort or self._last_resort.done():  # while it runs, presses share it
            self._last_resort = _start(_run_last_resort(self._endpoint, problem))
        return await _first_result(self._last_resort, answer)

    async def _ask(self, request: _Request, message: str) -> Outcome:
        """Return the answer of fishd."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                outcome = await loop.run_in_executor(self._threads, self._send, request, message)
        finally:
            request.is_sent = True
        self._answered = time.monotonic()
        return outcome

    def _send(self, request: _Request, message: str) -> Outcome:
        request.is_sent = True  # a later press needs another request
        # The disk of the keys may stall, so the probe has read them.
        with Fish(self._endpoint, timeout=ESTOP_TIMEOUT_S, access=self._access) as fish:
            state = fish.estop(message)
            return fish.estop_taken_by, f"mode {state.mode}"

    async def watch(self) -> None:
        """Probe the path periodically, until this task is cancelled."""
        loop, problem = asyncio.get_running_loop(), ""
        while True:
            try:
                await loop.run_in_executor(self._prober, self._probe)
                self._answered, problem = time.monotonic(), ""
            except Exception as error:
                is_expected = isinstance(error, FishError | OSError)
                before, problem = problem, "" if is_expected else text.describe_error(error)
                if problem and problem != before:
                    log.error("the path of the emergency stop cannot be probed: %s", problem)
            await asyncio.sleep(PROBE_PERIOD_S)

    def _probe(self) -> None:
        with Fish(self._endpoint, timeout=PROBE_TIMEOUT_S) as fish:
            self._access = fish.access
            fish.probe_estop()

    @property
    def warning(self) -> str:
        """Why an emergency stop may not reach fishd; empty if the path has answered lately."""
        silence = time.monotonic() - self._answered
        if silence < MAX_SILENCE_S:
            return ""
        return f"fishd has not answered at any of its sockets for {silence:.0f} s"


def _start(attempt: Coroutine[Any, Any, Outcome]) -> asyncio.Task[Outcome]:
    """Start an attempt; asyncio does not log its failure if no press waits for it any more."""
    task = asyncio.create_task(attempt)
    task.add_done_callback(lambda task: task.cancelled() or task.exception())
    return task


async def _first_result(*attempts: asyncio.Task[Outcome]) -> Outcome:
    """Return the first outcome of attempts; raise the error of the first one if all fail."""
    pending = set(attempts)
    while pending:
        done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
        for attempt in done:
            if not attempt.exception():
                return attempt.result()
    return attempts[0].result()


async def _run_last_resort(endpoint: str | None, problem: str) -> Outcome:
    """Run `fishctl estop`, which can end the pulses without fishd; return what it did.

    It asks fishd again, because this process may be at fault.

    problem: why fishd has not answered
    """
    options = [] if endpoint is None else ["--endpoint", endpoint]
    process = await asyncio.create_subprocess_exec(
        *fishctl_command(*options, "estop", "--json"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(LAST_RESORT_TIMEOUT_S):
            output, errors = await process.communicate()
    except TimeoutError:
        process.kill()
        raise NoDaemon(problem) from None
    if process.returncode:
        raise NoDaemon(text.line(errors.decode("utf-8", "replace")))
    try:
        answer = msgspec.json.decode(output, type=dict[str, Any])
    except msgspec.DecodeError:
        raise NoDaemon("it is not known whether fishctl has ended the pulses") from None
    if "pulses" in answer:
        return "last resort", str(answer["pulses"])
    return "fishctl", f"mode {answer.get('mode')}"


def fishctl_command(*arguments: str) -> list[str]:
    """Return the command that runs fishctl with the Python of this process."""
    code = "from fishd.__main__ import fishctl; fishctl()"
    return python_command("-c", code, *arguments)
