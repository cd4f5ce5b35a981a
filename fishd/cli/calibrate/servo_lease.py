"""The lease of `fishctl calibrate servo`: held during prompts, ended however the verb ends."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from fishd.cli.options import verb_lease
from fishd.cli.output import echo
from fishd.client import Fish
from fishd.client.lease import LeaseRenewal
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import FishError, Refused
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status

_POLL_INTERVAL_S = 0.1
"""Time between two requests for the state of fishd [s]."""
_NEUTRAL_TIMEOUT_S = 15.0
"""Longest time for the tail to reach neutral [s]."""
_ESTOP_TIMEOUT_S = 2.0
"""Longest time for the end of a lease in mode estop, where the tail may stay in place [s]."""


@contextlib.contextmanager
def hold_lease(
    fish: Fish, before: ServoCalibration, begin: Callable[[], object]
) -> Iterator[LeaseRenewal]:
    """Hold the lease of the fish; after an error or a signal, end it and print the state.

    A lost lease raises `LeaseLost`, at a prompt too: set `when_lost` to a function that does
    nothing before the calibration is saved. For the main thread, which alone can be interrupted.
    begin: begins the trial of a calibration, or raises an error
    """
    with fish.lease(*verb_lease(), idle_limit=None) as lease:
        begin()

        def interrupt(number: int, _: Any) -> None:
            if number != signal.SIGUSR1:
                raise KeyboardInterrupt
            if lease.lost:
                raise lease.lost

        # A lost terminal (ssh) must not leave the tail deflected.
        numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1)
        handlers = {number: signal.signal(number, interrupt) for number in numbers}
        main = threading.get_ident()
        lease.when_lost = lambda: signal.pthread_kill(main, signal.SIGUSR1)  # ends a prompt, too
        try:
            yield lease
        except BaseException:
            for number in numbers:
                signal.signal(number, signal.SIG_IGN)
            lease.stop()
            lease.returned = True
            outcome = _end_lease(fish.endpoint, lease.token, before)
            with contextlib.suppress(OSError):  # the terminal may be lost
                echo(f"\n{outcome}", err=True)
            raise
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _end_lease(endpoint: str, lease: str, before: ServoCalibration) -> str:
    """End a lease, wait until `before` is used again; return the state then, in one line.

    It opens a new connection, without an unfinished request on it.
    """
    try:
        with Fish(endpoint) as fish:
            with contextlib.suppress(Refused):  # it has ended already
                fish.end_lease(lease)
            calibrations, status = _await_end_of_trial(fish)
    except FishError as error:
        return (
            f"the position of the servo is unknown: {error}; a fishd that still runs returns to "
            "the previous calibration by itself, within seconds"
        )
    return f"{_describe_servo(status)}; {_describe_calibration(calibrations, before)}"


def _await_end_of_trial(fish: Fish) -> tuple[Calibrations, Status]:
    """Wait until the trial has ended and, in fault, the pulses, too."""
    start = time.monotonic()
    while True:
        report, status = fish.calibrations(), fish.status()
        done = not report.on_trial and not (status.mode == "fault" and status.servo_on)
        is_estop = status.mode == "estop"  # the tail may stay in place, and the lease with it
        if done or time.monotonic() - start > (
            _ESTOP_TIMEOUT_S if is_estop else _NEUTRAL_TIMEOUT_S
        ):
            return report, status
        time.sleep(_POLL_INTERVAL_S)


def _describe_servo(status: Status) -> str:
    if status.reason:
        pulses = "cannot be released and may have pulses" if status.servo_on else "is released"
        return f"fishd is in {status.mode}, the servo {pulses}"
    if status.mode == "running":
        return f"{status.controller} is the active controller"
    return "the servo is at neutral"


def _describe_calibration(calibrations: Calibrations, before: ServoCalibration) -> str:
    if calibrations.on_trial:
        return "its calibration will be that of before as soon as the tail is at neutral"
    if calibrations.servo == before:
        return "its calibration is as before"
    return f"its calibration is another one: {calibrations.servo_file or 'on trial'}"
