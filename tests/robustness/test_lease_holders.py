"""Programs that hold the lease, killed, stopped or busy, and the next holder."""

import asyncio
import signal
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest
from rigs.processes import EXPERIMENT, PATIENCE, Daemon, Process, Subscriber, wait_until

from fishd.client import AsyncFish, Fish, LeaseLost, NoDaemon
from fishd.client.lease import LeaseRenewal
from fishd.core.protocol import Grant

PROGRAM = """
import sys
from fishd.client import Fish, LeaseLost

with Fish(sys.argv[1], timeout=60.0) as fish:
    try:
        with fish.lease("my experiment", seconds=5.0):
            fish.set_controller("swing")
            for tick in fish.ticks():
                pass
    except LeaseLost as lost:
        sys.exit(f"lost: {lost}")
"""


def swimming(daemon: Daemon) -> Process:
    """Run a program that holds the lease of a swimming fish."""
    program = Process(sys.executable, "-c", PROGRAM, daemon.endpoint)
    wait_until(lambda: daemon.status().mode == "running")
    return program


def rests(daemon: Daemon) -> bool:
    status = daemon.status()
    return status.mode == "idle" and status.phi_c == 0.0


def test_a_program_that_is_killed_leaves_the_fish_at_rest(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"event").connected() as events, swimming(daemon) as program:
        assert "\nheld by     my experiment (pid " in daemon.fishctl("status").stdout
        program.process.kill()
        event = events.until(kind="lease-expired")
    assert event["data"]["pid"] == program.process.pid
    assert event["message"].endswith("for 5 s: the fish fades to neutral")
    wait_until(lambda: rests(daemon))
    assert "\nrests, as   my experiment" in daemon.fishctl("status").stdout


def test_a_program_that_was_stopped_ends_in_one_line_and_does_not_drive_on(daemon: Daemon) -> None:
    with swimming(daemon) as program:
        program.stop()
        wait_until(lambda: rests(daemon))
        program.process.send_signal(signal.SIGCONT)
        _, _, err = program.finish()
    assert err == "lost: this program no longer holds the fish: it was not renewed for 5 s\n"
    assert daemon.status().mode == "idle"


@pytest.mark.realtime
def test_a_fish_that_swims_keeps_its_program_while_that_computes(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        with fish.lease("a fit", seconds=0.6, idle_limit=0.3) as lease:
            fish.set_controller("swing")
            end = time.monotonic() + 2.0
            while time.monotonic() < end:
                pass
            assert lease.lost is None
            assert fish.status().mode == "running"
            wait_until(lambda: lease.lost is not None)
            with pytest.raises(LeaseLost, match=r"did nothing with the fish for 0\.3 s"):
                next(fish.ticks())
        assert fish.status().mode == "idle"


def test_a_second_verb_is_refused_unless_it_takes_the_fish(daemon: Daemon) -> None:
    second = ("measure", "sine", "--for", "21")
    with swimming(daemon) as program:
        refused = daemon.fishctl(*second)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert "by my experiment (pid " in refused.stderr
        assert daemon.status().controller == "swing"
        with Process(*EXPERIMENT, "--endpoint", daemon.endpoint, *second, "--take") as taker:
            _, _, err = program.finish()
            assert err.endswith(" no longer holds the fish: measure sine took the fish\n")
            taker.end(signal.SIGINT)
    wait_until(lambda: rests(daemon))


@pytest.mark.realtime
async def test_asyncio_programs_hold_the_fish_too(daemon: Daemon) -> None:
    async def lose(fish: AsyncFish) -> None:
        async with fish.lease("a page", seconds=0.5):
            async with AsyncFish(daemon.endpoint, timeout=PATIENCE) as intruder:
                await intruder.set_controller("sine")
            async for _ in fish.ticks():
                pass

    async with AsyncFish(daemon.endpoint, timeout=PATIENCE) as fish:
        async with fish.lease("a page", seconds=0.5):
            await fish.set_controller("swing")
            await asyncio.sleep(1.5)
            status = await fish.status()
            assert status.lease
            assert (status.mode, status.lease.name) == ("running", "a page")
        assert (await fish.status()).mode == "idle"
        with pytest.raises(LeaseLost, match="sine was set by hand"):
            await lose(fish)
        assert (await fish.status()).controller == "sine"


@pytest.mark.parametrize(("ended_by", "lines"), [(KeyboardInterrupt, 1), (NoDaemon, 0)])
def test_a_fish_that_could_not_be_given_back_is_spoken_of_once(
    daemon: Daemon,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    ended_by: type[BaseException],
    lines: int,
) -> None:
    def silent(self: Fish, lease: str) -> None:
        raise NoDaemon("no answer")

    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        monkeypatch.setattr(Fish, "end_lease", silent)
        with pytest.raises(ended_by), fish.lease("a test", take=True):
            raise ended_by
    message = "the fish could not be returned, and rests once its lease has expired: no answer"
    assert caplog.messages == [message] * lines


class Silent:
    """fishd that sometimes does not answer, and then reports the end of the lease."""

    def __init__(self, silences: int) -> None:
        self.asked = 0
        self._silences = silences

    def __enter__(self) -> "Silent":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def renew_lease(self, lease: str) -> Any:
        self.asked += 1
        if self.asked <= self._silences:
            raise NoDaemon("it hangs")
        if self.asked == self._silences + 1:
            return SimpleNamespace(mode="running")
        raise LeaseLost("no-lease", "over")


def test_a_renewal_goes_on_after_silences_until_fishd_says_that_the_lease_has_ended() -> None:
    fishd, ready, lost = Silent(5), threading.Event(), threading.Event()

    def connect(timeout: float) -> Any:
        assert ready.wait(PATIENCE)
        return fishd

    renewal = LeaseRenewal(connect, Grant("a lease", 0.05), None)
    renewal.when_lost = lost.set
    ready.set()
    assert lost.wait(PATIENCE)
    renewal.join(PATIENCE)
    assert (fishd.asked, str(renewal.lost)) == (7, "over")
