"""`fishctl calibrate servo`: trim, direction and limits, found by small steps while one watches.

What is tried is in force for a loan. Whatever ends it before the operator's yes (an error, Ctrl-C,
a lost terminal), the servo is sent to neutral and the calibration of before is in force again;
fishd does that by itself where this process is killed.
"""

import contextlib
import math
import signal
from collections.abc import Iterator
from typing import Any

import click

from fishd import text
from fishd.cli.options import endpoint_option
from fishd.cli.output import echo
from fishd.cli.servo_loan import end, renewed
from fishd.cli.servo_steps import Tail, orders
from fishd.client import Fish
from fishd.hardware.calibration import ServoCalibration

TRIM_STEP = 5.0
"""[µs]"""
TEST_ANGLE = 0.1
"""Angle by which the direction is judged [rad]."""
LIMIT_STEP = 0.02
"""[rad]"""
WIDEST = math.pi
"""A soft limit that does not limit; what pulses can reach still does [rad]."""


@click.command()
@endpoint_option
def servo(endpoint: str | None) -> int:
    """Find the servo's trim, direction and limits by small steps while you watch the tail.

    A positive angle moves the tail to the fish's left. The fish must be at rest. Nothing is saved
    before you say yes; on Ctrl-C or any error the calibration of before is in force again.
    """
    with Fish(endpoint) as fish:
        before = fish.calibrations().servo
        tail = Tail(fish, before)
        tail.borrow()
        with _ended_unless_saved(endpoint, tail.loan, before):
            with renewed(endpoint, tail.loan):
                echo("Keep hands and cables clear of the tail. Ctrl-C stops it at any prompt.")
                _find_trim(tail)
                _find_direction(tail)
                _find_limit(tail, +1)
                _find_limit(tail, -1)
                _show(before, tail.calibration)
                if not click.confirm("Save it?"):
                    raise click.ClickException("not saved")
            saved = fish.calibrate_servo(tail.calibration, save=True, loan=tail.loan)
    echo(text.line(f"in force, and saved in {saved.servo_file}"))
    return 0


def _find_trim(tail: Tail) -> None:
    echo(
        f"\nTrim: + and - turn the tail by {TRIM_STEP:g} µs, ++ and -- by {5 * TRIM_STEP:g} µs; "
        "ok when it is straight."
    )
    tail.neutral()
    for order in orders(lambda: f"trim {tail.calibration.trim:+g} µs"):
        if order == "ok":
            return
        tail.adjust(trim=tail.calibration.trim + TRIM_STEP * int(order))


def _find_direction(tail: Tail) -> None:
    echo(f"\nDirection: the tail moves by {TEST_ANGLE:g} rad, slowly, and stays there.")
    while True:
        tail.go(TEST_ANGLE)
        answer = click.prompt(
            "Did it move to the fish's left? y, n, or a for again",
            type=click.Choice(["y", "n", "a"]),
            show_choices=False,
        )
        tail.neutral()
        if answer == "y":
            return
        if answer == "n":
            was = tail.calibration
            # The stops of the mechanics stay where they are, on the other side of neutral.
            tail.adjust(
                direction=-was.direction, lowest=0.0 - was.highest, highest=0.0 - was.lowest
            )
            echo("The direction is turned round; once more, to be sure.")


def _find_limit(tail: Tail, side: int) -> None:
    """Find the limit to the fish's left (1) or right (-1)."""
    key, where = ("highest", "left") if side > 0 else ("lowest", "right")
    was = getattr(tail.calibration, key)
    echo(
        f"\nLimit to the fish's {where}: + goes {LIMIT_STEP:g} rad further and - back, ++ and -- "
        f"{5 * LIMIT_STEP:g} rad; ok where it may go no further, keep for {was:+g} rad as it was."
    )
    tail.adjust(**{key: side * WIDEST})
    end = abs(tail.reach[side > 0])
    limit = was
    for order in orders(lambda: f"{key} {tail.angle:+.2f} rad", "keep"):
        if isinstance(order, int):
            wanted = max(0.0, side * tail.angle + LIMIT_STEP * order)
            if not tail.go(side * wanted):
                echo("  no further: the pulses of a servo end here")
            elif wanted > tail.amplitude:
                echo("  no further: this is amplitude_limit")
        elif order == "ok" and tail.angle == 0.0:
            echo("  the tail could not go this way at all; go to its limit first, or keep")
        elif order == "ok" and side * tail.angle >= tail.amplitude and side * was > tail.amplitude:
            # No stop was found, so a limit that lies beyond is not to be lost.
            echo(f"  free as far as amplitude_limit; {key} stays at {was:+g} rad")
            break
        else:
            limit = round(tail.angle, 4) if order == "ok" else was
            break
    if end < tail.amplitude and abs(limit) > end:
        limit = side * math.floor(end * 1e4) / 1e4
        echo(f"  {key} is {limit:+g} rad now, where the pulses of a servo end")
    tail.neutral()
    tail.adjust(**{key: limit})


def _show(before: ServoCalibration, now: ServoCalibration) -> None:
    echo(f"\n{'':<16}{'before':>10}{'now':>10}")
    for name, unit in (
        ("trim", "µs"),
        ("direction", ""),
        ("scale", "µs/rad"),
        ("lowest", "rad"),
        ("highest", "rad"),
    ):
        echo(
            f"{name + ' [' + unit + ']' if unit else name:<16}"
            f"{getattr(before, name):>+10g}{getattr(now, name):>+10g}"
        )


@contextlib.contextmanager
def _ended_unless_saved(
    endpoint: str | None, loan: str, before: ServoCalibration
) -> Iterator[None]:
    """On any way out but the ordinary one: the fish at neutral, and `before` in force."""

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    # A terminal that is lost (ssh) must not leave the tail where it is.
    numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
    handlers = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    except BaseException:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        outcome = end(endpoint, loan, before)
        with contextlib.suppress(OSError):  # of the lost terminal
            echo(f"\n{outcome}", err=True)
        raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
