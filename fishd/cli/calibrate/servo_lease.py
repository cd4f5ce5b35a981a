"""The lease of `fishctl calibrate servo`: kept at prompts, ended on any way out."""

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

_LOOK = 0.1
"""Time between two looks at what fishd does [s]."""
_PATIENCE = 15.0
"""How long the way to neutral may take [s]."""
_BRIEFLY = 2.0
"""How long the end of a lease may take where the tail stays where it is [s]."""


@contextlib.contextmanager
def leased(
    fish: Fish, before: ServoCalibration, begin: Callable[[], object]
) -> Iterator[LeaseRenewal]:
    """Hold the fish meanwhile; on an error or a signal end the lease, and print the state then.

    begin: begins the trial of a calibration, or raises why that cannot be
    A lease that is lost raises `LeaseLost`, at a prompt too: set `when_lost` to nothing before the
    calibration is saved. For the main thread, which alone can be interrupted.
    """
    with fish.lease(*verb_lease(), idle_limit=None) as lease:
        begin()

        def interrupt(number: int, _: Any) -> None:
            if number != signal.SIGUSR1:
                raise KeyboardInterrupt
            if lease.lost:
                raise lease.lost

        # A terminal that is lost (ssh) must not leave the tail where it is.
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
            outcome = _end(fish.endpoint, lease.token, before)
            with contextlib.suppress(OSError):  # of the lost terminal
                echo(f"\n{outcome}", err=True)
            raise
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _end(endpoint: str, lease: str, before: ServoCalibration) -> str:
    """End a lease, wait until `before` is used again; one line on how things are then.

    On a connection of its own: no half-made request is on it.
    """
    try:
        with Fish(endpoint) as fish:
            with contextlib.suppress(Refused):  # it has ended already
                fish.end_lease(lease)
            found, status = _settled(fish)
    except FishError as error:
        return (
            f"where the servo is cannot be told: {error}; a fishd that still runs goes back to "
            "the previous calibration by itself, within seconds"
        )
    return f"{_servo(status)}; {_calibration(found, before)}"


def _settled(fish: Fish) -> tuple[Calibrations, Status]:
    """Wait until the trial has ended and, in fault, the pulses, too."""
    begun = time.monotonic()
    while True:
        found, status = fish.calibrations(), fish.status()
        done = not found.on_trial and not (status.mode == "fault" and status.servo_on)
        stays = status.mode == "estop"  # the tail may stay where it is, and the lease with it
        if done or time.monotonic() - begun > (_BRIEFLY if stays else _PATIENCE):
            return found, status
        time.sleep(_LOOK)


def _servo(status: Status) -> str:
    if status.reason:
        pulses = "cannot be released and may have pulses" if status.servo_on else "is released"
        return f"fishd is in {status.mode}, the servo {pulses}"
    if status.mode == "running":
        return f"{status.controller} is the active controller"
    return "the servo is at neutral"


def _calibration(found: Calibrations, before: ServoCalibration) -> str:
    if found.on_trial:
        return "its calibration will be that of before as soon as the tail is at neutral"
    if found.servo == before:
        return "its calibration is as before"
    return f"its calibration is another one: {found.servo_file or 'on trial'}"
