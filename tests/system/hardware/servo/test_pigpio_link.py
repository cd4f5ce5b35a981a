"""The link to pigpiod in real time: a pigpiod that is gone, frozen or restarted."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from msgspec.structs import replace
from rigs.pigpio_rig import Bench
from rigs.processes import PATIENCE

from fishd.core.clock import SystemClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio import PigpioSettings

pytestmark = pytest.mark.realtime

MAX_WRITE_S = 0.05
"""Longest permitted write on a busy machine [s]; fishd's own limit is 8 ms."""


class Swimming(Bench):
    """A pigpiod in real time, with a servo that swims."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__(stack, SystemClock())
        self.swimmer = self.servo()

    def settings(self) -> PigpioSettings:
        """Return the settings with the longest timeout, as a busy machine is not a fault."""
        return replace(super().settings(), timeout=0.01)

    def write(self, angle: float) -> str | None:
        """Write an angle; return the error message, or None."""
        try:
            self.swimmer.write(angle)
        except ServoError as error:
            return str(error)
        return None

    def write_until_it_works(self, angle: float) -> None:
        """Write until pigpiod answers in time; an angle whose answer is late may not be sent."""

        def is_taken() -> bool:
            late = self.swimmer.driver.counters()["servo_late_answers"]
            failed = self.write(angle)
            return not failed and self.swimmer.driver.counters()["servo_late_answers"] == late

        eventually(is_taken)


@pytest.fixture
def bench() -> Iterator[Swimming]:
    with contextlib.ExitStack() as stack:
        yield Swimming(stack)


def eventually(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_one_thread_and_one_connection_are_all_it_needs(bench: Swimming) -> None:
    kinds = [type(thread).__name__ for thread in threading.enumerate()]
    assert "_callback_thread" not in kinds
    assert count_link_threads() == 1
    bench.swimmer.close()
    assert count_link_threads() == 0


def count_link_threads() -> int:
    """Return the number of threads that keep a link."""
    return [thread.name for thread in threading.enumerate()].count("pigpio-link")


@pytest.mark.parametrize(("fault", "forgiven"), [("pigpiod-gone", 0), ("pigpiod-frozen", 2)])
def test_no_call_is_held_up_and_no_thread_spins(bench: Swimming, fault: str, forgiven: int) -> None:
    bench.swimmer.close()
    bench.swimmer = bench.servo(replace(bench.settings(), countdown=2.0))  # the longest tolerance
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    errors, durations = [], []
    for _ in range(30):
        begun = time.monotonic()
        errors.append(bench.write(0.5))
        durations.append(time.monotonic() - begun)
        time.sleep(0.01)
    for _ in range(3):
        begun = time.monotonic()
        with pytest.raises(ServoError):
            bench.swimmer.release()
        durations.append(time.monotonic() - begun)
    assert max(durations) < MAX_WRITE_S
    assert errors[:forgiven] == [None] * forgiven
    for error in errors[forgiven:]:
        assert error.startswith(f"pigpiod at 127.0.0.1:{bench.daemon.port}: ")
        assert error.endswith("; reconnecting")
        assert "\n" not in error
    used, begun = time.process_time(), time.monotonic()
    time.sleep(1.5)
    assert time.process_time() - used < 0.3 * (time.monotonic() - begun)
    begun = time.monotonic()
    with pytest.raises(ServoError):
        bench.swimmer.close()
    bench.swimmer.close()
    assert time.monotonic() - begun < 1.0
    assert count_link_threads() == 0


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen", "pigpiod-restart"])
def test_pulses_come_back_only_with_a_write_and_countdown(bench: Swimming, fault: str) -> None:
    bench.write_until_it_works(0.5)
    before = bench.swimmer.driver.counters()["servo_reconnects"]
    bench.faults.inject(fault)
    eventually(lambda: bench.write(0.5) is not None)
    bench.faults.clear()
    eventually(lambda: bench.swimmer.driver.counters()["servo_reconnects"] > before)
    time.sleep(0.3)  # time enough for any script to do harm
    assert bench.width == 0
    bench.write_until_it_works(-0.5)
    assert bench.width == 1200
    eventually(lambda: bench.width == 1500, 2.0)
    eventually(lambda: bench.width == 0, 2.0)
    assert bench.scripts() == 1


def test_without_a_pigpiod_it_starts_all_the_same_and_connects_later(bench: Swimming) -> None:
    bench.swimmer.close()
    bench.faults.inject("pigpiod-gone")
    begun = time.monotonic()
    bench.swimmer = bench.servo()
    assert time.monotonic() - begun < 4.0
    error = bench.write(0.1)
    assert "not connected: Connection refused" in error
    bench.faults.clear()
    bench.write_until_it_works(0.1)
    assert bench.width == 1560


def test_an_emergency_release_of_another_thread_does_not_disturb_writes(bench: Swimming) -> None:
    bench.write_until_it_works(0.5)
    stop = threading.Event()
    failures = []

    def press() -> None:
        while not stop.is_set():
            try:
                bench.swimmer.release()
            except ServoError as error:
                failures.append(str(error))
            time.sleep(0.002)

    thread = threading.Thread(target=press)
    thread.start()
    for _ in range(50):
        if error := bench.write(0.5):
            failures.append(error)
    stop.set()
    thread.join(PATIENCE)
    # Slowness of this machine is allowed; an answer to the wrong question is not.
    slow = "no answer within", "not connected", "busy for more than"
    assert [failure for failure in failures if not any(words in failure for words in slow)] == []
