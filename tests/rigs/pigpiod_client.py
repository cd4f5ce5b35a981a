"""Emulated pigpiod with the real client, for tests of the emulation."""

import contextlib
import time
from collections.abc import Callable, Iterator

import pigpio

from fishd.core.clock import Clock, VirtualClock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.daemon import Pigpiod
from rigs.processes import PATIENCE

GPIO = 18


class Bench:
    """Emulated pigpiod, by default in virtual time, and its client."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.clock = clock or VirtualClock()
        self.faults = Faults(self.clock)
        self.daemon = Pigpiod(self.clock, self.faults)
        self.daemon.start()
        self.pi = self.client()

    def client(self) -> pigpio.pi:
        return pigpio.pi("127.0.0.1", self.daemon.port, show_errors=False)

    def sleep(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    @property
    def width(self) -> float:
        """Return the current pulse [µs]."""
        return self.daemon.width(GPIO, self.clock.monotonic())

    @property
    def settled_width(self) -> float:
        """Return the pulse after the begin of the next frame [µs]."""
        self.sleep(0.02)
        return self.width

    def result(self, method: str, *arguments: object) -> int:
        """Return the result of a command, or its negative error number."""
        pigpio.exceptions = False
        try:
            return getattr(self.pi, method)(*arguments)
        finally:
            pigpio.exceptions = True

    def stored(self, script: str | bytes) -> int:
        """Store a script and wait until it is ready."""
        number: int = self.pi.store_script(script.encode() if isinstance(script, str) else script)
        self.sleep(0.002)
        return number


def dispose(pi: pigpio.pi) -> None:
    """Stop a client and wait for its thread, even if its daemon has ended and the thread loops."""
    thread = pi._notify
    with contextlib.suppress(OSError):
        pi.stop()
    if thread:
        thread.join(PATIENCE)
    pi.stop()


@contextlib.contextmanager
def pigpiod_bench(clock: Clock | None = None) -> Iterator[Bench]:
    bench = Bench(clock)
    try:
        yield bench
    finally:
        bench.faults.clear()
        dispose(bench.pi)
        bench.daemon.close()


def eventually(condition: Callable[[], bool]) -> bool:
    """Wait until another thread has made a condition true."""
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.001)
    return True
