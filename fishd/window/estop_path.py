"""Path of an emergency stop from the window to fishd, which waits for no other work.

It has threads and connections of its own. A probe tests it periodically, so that a page can warn
before it is needed.
"""

import asyncio
import logging
import time
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
ANSWER_TIMEOUT_S = 2.0
"""Longest time from a press to the last resort, whatever the threads wait for [s]."""
LAST_RESORT_TIMEOUT_S = 10.0
"""Time to wait for the end of the last resort [s]."""
PROBE_PERIOD_S = 0.5
"""Time between two probes of the path [s]."""
PROBE_TIMEOUT_S = 1.0
"""Longest wait for the answer to a probe [s]."""
MAX_SILENCE_S = 2.0
"""Time without an answer after which pages warn [s]."""


class _Attempt(Struct, eq=False):
    """Request for an emergency stop, for all presses before it is sent."""

    answer: asyncio.Future[tuple[str, str]] | None = None
    """Mode of fishd, and the socket that answered."""
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
        self._attempt = _Attempt(is_sent=True)
        self._last_resort: asyncio.Future[str] | None = None
        self._answered = time.monotonic()

    def close(self) -> None:
        """End the threads, without waiting for their requests."""
        for threads in (self._threads, self._prober):
            threads.shutdown(wait=False, cancel_futures=True)

    async def stop(self, message: str) -> dict[str, Any]:
        """Stop the pulses; raise `FishError` if neither fishd nor the last resort does so."""
        start = time.monotonic()
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                mode, way = await asyncio.shield(self._request(message))
            outcome = f"mode {mode}"
        except Refused:
            raise
        except TimeoutError:
            error = NoDaemon(f"no answer within {ANSWER_TIMEOUT_S:g} s")
            way, outcome = "last resort", await self._stop_without_daemon(error)
        except Exception as error:
            way, outcome = "last resort", await self._stop_without_daemon(error)
        milliseconds = round((time.monotonic() - start) * 1e3, 1)
        return {"server_ms": milliseconds, "way": way, "outcome": outcome}

    def _request(self, message: str) -> asyncio.Future[tuple[str, str]]:
        """Return the answer to a request that is not sent yet, which all presses share."""
        if self._attempt.is_sent:
            attempt = _Attempt()
            attempt.answer = asyncio.get_running_loop().run_in_executor(
                self._threads, self._send, attempt, message
            )
            self._attempt = attempt
        assert self._attempt.answer
        return self._attempt.answer

    def _send(self, attempt: _Attempt, message: str) -> tuple[str, str]:
        attempt.is_sent = True  # a later press needs another request
        # The disk of the keys may stall, so the probe has read them.
        with Fish(self._endpoint, timeout=ESTOP_TIMEOUT_S, access=self._access) as fish:
            return fish.estop(message).mode, fish.estop_taken_by

    async def _stop_without_daemon(self, error: Exception) -> str:
        """Return what the last resort has done; while it runs, all presses share it."""
        if self._last_resort is None or self._last_resort.done():
            self._last_resort = asyncio.ensure_future(_run_last_resort(self._endpoint, error))
        return await asyncio.shield(self._last_resort)

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
        with Fish(self._endpoint, timeout=PROBE_TIMEOUT_S) as fish:  # as an emergency stop connects
            self._access = fish.access
            fish.status()

    @property
    def warning(self) -> str:
        """Why an emergency stop may not reach fishd; empty if the path has answered lately."""
        silence = time.monotonic() - self._answered
        if silence < MAX_SILENCE_S:
            return ""
        return f"fishd has not answered at its control socket for {silence:.0f} s"


async def _run_last_resort(endpoint: str | None, error: Exception) -> str:
    """Run `fishctl estop`, which can end the pulses without fishd; return what it did."""
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
        raise NoDaemon(text.error_message(error)) from None
    if process.returncode:
        raise NoDaemon(text.line(errors.decode("utf-8", "replace"))) from error
    try:
        answer = msgspec.json.decode(output, type=dict[str, Any])
    except msgspec.DecodeError:
        raise NoDaemon("it is not known whether fishctl has ended the pulses") from error
    return str(answer.get("pulses", answer.get("mode", "")))


def fishctl_command(*arguments: str) -> list[str]:
    """Return the command that runs fishctl with the Python of this process."""
    code = "from fishd.__main__ import fishctl; fishctl()"
    return python_command("-c", code, *arguments)
