"""The pulses that a process has requested from pigpiod end after its death at any instant."""

import contextlib
from collections.abc import Callable

import pytest
from rigs.pigpio_rig import GPIO, Bench, connect, script_of

from fishd.core.errors import Escaped, ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.pigpio_client import TimedSocket

MAX_END_S = 2.0
"""Time until pulses end: neutral after 0.2 s and off 0.5 s later, or a longer countdown [s]."""


class Killed(BaseException):
    """Simulated kill -9 of the process."""


@pytest.fixture
def mortal(monkeypatch: pytest.MonkeyPatch) -> Callable[[int | None], None]:
    """Yield a function of n: the process dies instead of its n-th send; None revives it."""
    send = TimedSocket.sendall
    left: int | None = None

    def count_down(client: TimedSocket, data: bytes) -> None:
        nonlocal left
        if left is not None:
            if left <= 0:
                raise Killed
            left -= 1
        send(client, data)

    def kill_after(count: int | None) -> None:
        nonlocal left
        left = count

    monkeypatch.setattr(TimedSocket, "sendall", count_down)
    return kill_after


def lose_connection(bench: Bench, servo: CalibratedServo) -> None:
    bench.hang_up()
    with contextlib.suppress(OSError):
        servo.write(0.5)
    bench.wait(0.6)


def swim(bench: Bench) -> CalibratedServo:
    servo = bench.servo()
    servo.write(0.5)
    bench.wait(0.05)
    assert bench.width == 1800
    return servo


def write(bench: Bench) -> None:
    swim(bench).write(-0.5)


def first_write(bench: Bench) -> None:
    servo = swim(bench)
    servo.release()
    bench.wait(0.05)
    servo.write(0.5)


def release(bench: Bench) -> None:
    swim(bench).release()


def close(bench: Bench) -> None:
    swim(bench).close()


def start_after_a_kill(bench: Bench) -> None:
    swim(bench)
    connect(bench.servo())


def reconnect(bench: Bench) -> None:
    servo = swim(bench)
    with bench.client() as client:  # ends the countdowns, so that the pulses are still on
        for script in range(2):
            client.update_script(script, [100]) if client.script_status(script)[1] else None
    lose_connection(bench, servo)
    connect(servo)


def last_resort(bench: Bench) -> None:
    swim(bench)
    bench.last_resort()


def last_resort_on_pulses_of_others(bench: Bench) -> None:
    with bench.client() as client:
        client.set_servo_pulsewidth(GPIO, 1800)
    bench.last_resort()


DEEDS = (
    write,
    first_write,
    release,
    close,
    start_after_a_kill,
    reconnect,
    last_resort,
    last_resort_on_pulses_of_others,
)


def die_at(
    n: int, bench: Bench, deed: Callable[[Bench], None], kill_after: Callable[[int | None], None]
) -> bool:
    """Return whether the process died before it had finished."""
    kill_after(n)
    try:
        deed(bench)
    except (Killed, Escaped):
        return True
    except ServoError as error:  # in a release
        if not isinstance(error.__cause__, Escaped):
            raise
        return True
    finally:
        kill_after(None)
    return False


@pytest.mark.slow
@pytest.mark.parametrize("deed", DEEDS)
def test_a_kill_between_any_two_commands_leaves_no_pulses(
    deed: Callable[[Bench], None], mortal: Callable[[int | None], None]
) -> None:
    for n in range(150):
        with contextlib.ExitStack() as stack:
            bench = Bench(stack)
            died = die_at(n, bench, deed, mortal)
            bench.wait(MAX_END_S)
            # Pulses of others that were not changed remain theirs.
            others = deed is last_resort_on_pulses_of_others
            untouched = others and [width for _, width in bench.daemon.history(GPIO)] == [1800]
            assert bench.width == 0 or (died and untouched), f"died at command {n}"
        if not died:
            return
    pytest.fail("it never came to its end")


def swim_until_the_countdown_has_ended(bench: Bench) -> None:
    swim(bench)
    bench.wait(MAX_END_S)
    assert bench.width == 0


@pytest.mark.parametrize(
    "past", [start_after_a_kill, reconnect, swim_until_the_countdown_has_ended]
)
def test_bytes_of_a_dead_process_or_connection_that_pigpiod_reads_late_do_not_stay_in_force(
    bench: Bench, past: Callable[[Bench], None]
) -> None:
    past(bench)
    with bench.client() as late:
        late.set_servo_pulsewidth(GPIO, 1800)
    bench.wait(0.1 if past is swim_until_the_countdown_has_ended else MAX_END_S)
    assert bench.width == 0


def test_a_release_that_only_reaches_pigpiod_in_half_ends_the_pulses_at_once(
    bench: Bench, mortal: Callable[[int | None], None]
) -> None:
    servo = swim(bench)
    with bench.client() as client:
        # The first of its two commands, as if a cable broke in between.
        client.update_script(script_of(servo), [1, GPIO, 0])
    bench.wait(0.05)
    assert bench.width == 0
