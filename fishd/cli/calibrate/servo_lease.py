"""The lease of `fishctl calibrate servo`: renewed at prompts, ended on any way out."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

from fishd.cli.output import echo
from fishd.client import Fish
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import FishError, NoDaemon, Refused
from fishd.core.protocol import LEASE, Calibrations
from fishd.core.signals import Status

_EVERY = 1.0
"""Time between two renewals [s]."""
_HELD_UP = 3.0
"""No renewal takes so long, unless fishctl itself was held up [s]."""
_PATIENCE = 15.0
"""How long the way to neutral may take [s]."""
_BRIEFLY = 2.0
"""How long the end of a lease may take where the tail stays where it is [s]."""


class Renewal(threading.Thread):
    """Renews a lease until it is stopped; `problem` says why it ended of itself."""

    def __init__(self, endpoint: str | None, lease: str) -> None:
        super().__init__(name="renewal", daemon=True)
        self.problem: FishError | None = None
        self._stopping = threading.Event()
        self._endpoint = endpoint
        self._lease = lease

    def run(self) -> None:
        """Renew, on a connection of its own: a socket belongs to one thread."""
        with Fish(self._endpoint, timeout=_EVERY) as fish:
            renewed = time.monotonic()
            while self.problem is None and not self._stopping.wait(_EVERY):
                asked = time.monotonic()
                try:
                    fish.renew_lease(self._lease)
                    renewed = time.monotonic()
                except Refused as refusal:
                    self.problem = refusal
                except NoDaemon as silence:
                    now = time.monotonic()
                    held_up = now - asked > _HELD_UP  # then it says nothing of fishd: once more
                    if now - renewed > LEASE and not held_up:
                        self.problem = silence
        main = threading.main_thread().ident
        if self.problem and main and not self._stopping.is_set():
            signal.pthread_kill(main, signal.SIGUSR1)  # which ends a prompt, too

    def stop(self) -> None:
        """Renew no more, and wait for a renewal that is under way; may be called again."""
        self._stopping.set()
        self.join()

    def interrupt(self, number: int, _: Any) -> None:
        """Handler of signals: raises `problem` for SIGUSR1, `KeyboardInterrupt` for others."""
        if number != signal.SIGUSR1:
            raise KeyboardInterrupt
        if self.problem and not self._stopping.is_set():
            raise self.problem


@contextlib.contextmanager
def renewed(endpoint: str | None, lease: str, before: ServoCalibration) -> Iterator[Renewal]:
    """Renew a lease meanwhile; on an error or a signal end it, and say how things are then.

    A lease that ends of itself raises `FishError`, at a prompt too. Yields what is to be stopped
    before the calibration is saved. For the main thread, which alone can be interrupted.
    """
    renewal = Renewal(endpoint, lease)
    # A terminal that is lost (ssh) must not leave the tail where it is.
    numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1)
    handlers = {number: signal.signal(number, renewal.interrupt) for number in numbers}
    renewal.start()
    try:
        yield renewal
        renewal.stop()
    except BaseException:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        renewal.stop()
        outcome = _end(endpoint, lease, before)
        with contextlib.suppress(OSError):  # of the lost terminal
            echo(f"\n{outcome}", err=True)
        raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _end(endpoint: str | None, lease: str, before: ServoCalibration) -> str:
    """End a lease, wait until `before` is used again; one line on how things are then.

    On a connection of its own: no half-made request is on it.
    """
    try:
        with Fish(endpoint) as fish:
            with contextlib.suppress(Refused):  # it has ended already
                fish.end_lease(lease)
            found, status = _settled(fish, lease)
    except FishError as error:
        return (
            f"where the servo is cannot be told: {error}; a fishd that still runs goes back to "
            f"the previous calibration by itself within {LEASE:g} s"
        )
    return f"{_servo(status)}; {_calibration(found, lease, before)}"


def _settled(fish: Fish, lease: str) -> tuple[Calibrations, Status]:
    """Wait until the lease has ended and, in fault, the pulses, too."""
    begun = time.monotonic()
    while True:
        found, status = fish.calibrations(), fish.status()
        done = found.lease != lease and not (status.mode == "fault" and status.servo_on)
        stays = status.mode == "estop"  # the tail may stay where it is, and the lease with it
        if done or time.monotonic() - begun > (_BRIEFLY if stays else _PATIENCE):
            return found, status
        time.sleep(_EVERY / 10)


def _servo(status: Status) -> str:
    if status.reason:
        pulses = "cannot be released and may have pulses" if status.servo_on else "is released"
        return f"fishd is in {status.mode}, the servo {pulses}"
    if status.mode == "running":
        return f"{status.controller} is the active controller"
    return "the servo is at neutral"


def _calibration(found: Calibrations, lease: str, before: ServoCalibration) -> str:
    if found.lease == lease:
        return "its calibration will be that of before as soon as the tail is at neutral"
    if found.servo == before:
        return "its calibration is as before"
    return f"its calibration is another one: {found.servo_file or 'of the lease of another client'}"
