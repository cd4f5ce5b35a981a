"""The loan that `fishctl calibrate servo` works with: renewed at prompts, ended on any way out."""

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

from fishd.client import Fish
from fishd.errors import FishError, NoDaemon, Refused
from fishd.hardware.calibration import ServoCalibration
from fishd.protocol import LOAN, Calibrations
from fishd.signals import Status

_EVERY = 1.0
"""Time between two renewals [s]."""
_PATIENCE = 15.0
"""How long the way to neutral may take [s]."""
_BRIEFLY = 2.0
"""How long anything may take that does not have to wait for the tail [s]."""


class _Renewal(threading.Thread):
    """Renews a loan until it is told to stop; `problem` says why it ended of itself."""

    def __init__(self, endpoint: str | None, loan: str) -> None:
        super().__init__(name="renewal", daemon=True)
        self.stopping = threading.Event()
        self.problem: FishError | None = None
        self._endpoint = endpoint
        self._loan = loan

    def run(self) -> None:
        """Renew, on a connection of its own: a socket belongs to one thread."""
        with Fish(self._endpoint, timeout=_EVERY) as fish:
            renewed = time.monotonic()
            while self.problem is None and not self.stopping.wait(_EVERY):
                try:
                    fish.renew_loan(self._loan)
                    renewed = time.monotonic()
                except Refused as refusal:
                    self.problem = refusal
                except NoDaemon as silence:
                    if time.monotonic() - renewed > LOAN:
                        self.problem = silence
        main = threading.main_thread().ident
        if self.problem and main and not self.stopping.is_set():
            signal.pthread_kill(main, signal.SIGUSR1)  # which ends a prompt, too


@contextlib.contextmanager
def renewed(endpoint: str | None, loan: str) -> Iterator[None]:
    """Renews a loan meanwhile; where it ends all the same, `FishError` is raised, at a prompt too.

    To be used by the main thread, which alone can be interrupted.
    """
    renewal = _Renewal(endpoint, loan)

    def interrupt(*_: Any) -> None:
        if renewal.problem and not renewal.stopping.is_set():
            raise renewal.problem

    handler = signal.signal(signal.SIGUSR1, interrupt)
    renewal.start()
    try:
        yield
    finally:
        renewal.stopping.set()
        renewal.join()
        signal.signal(signal.SIGUSR1, handler)


def end(endpoint: str | None, loan: str, before: ServoCalibration) -> str:
    """End a loan, wait until what was in force before is so again; one line on how things are then.

    On a connection of its own: no half-made request is on it.
    """
    try:
        with Fish(endpoint) as fish:
            with contextlib.suppress(Refused):  # it has ended already
                fish.end_loan(loan)
            found = _once_ended(fish, loan)
            return f"{_servo(_once_released(fish))}; {_in_force(found, loan, before)}"
    except FishError as error:
        return (
            f"where the servo is cannot be told: {error}; a fishd that still runs puts the "
            f"calibration of before back in force by itself within {LOAN:g} s"
        )


def _once_ended(fish: Fish, loan: str) -> Calibrations:
    begun = time.monotonic()
    while (found := fish.calibrations()).loan == loan:
        stopped = fish.status().mode == "estop"  # then the tail may stay where it is
        if time.monotonic() - begun > (_BRIEFLY if stopped else _PATIENCE):
            break
        time.sleep(_EVERY / 10)
    return found


def _once_released(fish: Fish) -> Status:
    """The state of things, in fault once the pulses have ended."""
    deadline = time.monotonic() + _BRIEFLY
    while (status := fish.status()).mode == "fault" and status.servo_on:
        if time.monotonic() > deadline:
            break
        time.sleep(_EVERY / 10)
    return status


def _servo(status: Status) -> str:
    if status.reason:
        pulses = "cannot be released and may have pulses" if status.servo_on else "is released"
        return f"fishd is in {status.mode}, the servo {pulses}"
    if status.mode == "running":
        return f"{status.controller} is in command of the servo"
    return "the servo is at neutral"


def _in_force(found: Calibrations, loan: str, before: ServoCalibration) -> str:
    if found.loan == loan:
        return "its calibration will be that of before as soon as the tail is at neutral"
    if found.servo == before:
        return "its calibration is as before"
    return f"its calibration is another one: {found.servo_file or 'a loan of another client'}"
