"""The link to pigpiod in real time: a pigpiod that is gone, frozen or restarted."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from rigs.processes import PATIENCE

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import SystemClock, VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.pigpio import Pigpio, PigpioSettings
from fishd.hardware.servo.pigpio_client import opened
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.daemon import Pigpiod

pytestmark = pytest.mark.realtime

GPIO = 18
TICK = 0.05
BOUND = 0.05
"""No write may take longer, on a machine that is busy with other things [s]; the limit is 8 ms."""


class Bench:
    """An emulated pigpiod in real time and a servo on it."""

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.faults = Faults(self.clock)
        self.daemon = Pigpiod(self.clock, self.faults)
        self.daemon.start()
        self.servo = self.another()

    def another(self) -> CalibratedServo:
        # The longest limit that the settings allow: a busy machine is no fault.
        settings = PigpioSettings(gpio=GPIO, port=self.daemon.port, timeout=0.01)
        return CalibratedServo(
            Pigpio, settings, ServoCalibration(), self.clock, threaded=True, tick=TICK
        )

    def close(self) -> None:
        with contextlib.suppress(ServoError):
            self.servo.close()
        self.daemon.close()

    @property
    def width(self) -> float:
        """The pulse one frame from now [µs]."""
        return self.daemon.width(GPIO, self.clock.monotonic() + 0.02)

    def write(self, angle: float) -> str | None:
        """Write; the error if there is one."""
        try:
            self.servo.write(angle)
        except ServoError as error:
            return str(error)
        return None

    def write_until_it_works(self, angle: float) -> None:
        eventually(lambda: self.write(angle) is None)


def eventually(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def test_a_healthy_pigpiod_takes_the_first_write(bench: Bench) -> None:
    bench.write_until_it_works(0.5)
    assert bench.width == 1800


def test_one_thread_and_one_connection_are_all_it_needs(bench: Bench) -> None:
    kinds = [type(thread).__name__ for thread in threading.enumerate()]
    assert "_callback_thread" not in kinds
    names = [thread.name for thread in threading.enumerate()]
    assert names.count("pigpio-link") == 1
    bench.servo.close()
    assert "pigpio-link" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize(("fault", "forgiven"), [("pigpiod-gone", 0), ("pigpiod-frozen", 2)])
def test_no_write_is_held_up(bench: Bench, fault: str, forgiven: int) -> None:
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    errors, durations = [], []
    for _ in range(30):
        begun = time.monotonic()
        errors.append(bench.write(0.5))
        durations.append(time.monotonic() - begun)
        time.sleep(0.01)
    assert max(durations) < BOUND
    assert errors[:forgiven] == [None] * forgiven
    for error in errors[forgiven:]:
        assert error is not None
        assert error.startswith(f"pigpiod at 127.0.0.1:{bench.daemon.port}: ")
        assert error.endswith("; reconnecting")
        assert "\n" not in error


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen"])
def test_no_release_is_held_up_either(bench: Bench, fault: str) -> None:
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    for _ in range(3):
        begun = time.monotonic()
        with pytest.raises(ServoError):
            bench.servo.release()
        assert time.monotonic() - begun < BOUND


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen"])
def test_no_thread_spins_meanwhile(bench: Bench, fault: str) -> None:
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    bench.write(0.5)
    used, begun = time.process_time(), time.monotonic()
    time.sleep(1.5)
    assert time.process_time() - used < 0.3 * (time.monotonic() - begun)


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen", "pigpiod-restart"])
def test_pulses_come_back_only_with_a_write(bench: Bench, fault: str) -> None:
    bench.write_until_it_works(0.5)
    before = bench.servo.driver.counters()["servo_reconnects"]
    bench.faults.inject(fault)
    eventually(lambda: bench.write(0.5) is not None)
    bench.faults.clear()
    eventually(lambda: bench.servo.driver.counters()["servo_reconnects"] > before)
    time.sleep(0.3)  # time enough for any script to do harm
    assert bench.width == 0
    bench.write_until_it_works(-0.5)
    assert bench.width == 1200


@pytest.mark.parametrize("fault", ["pigpiod-frozen", "pigpiod-restart"])
def test_the_countdown_is_there_again_after_a_reconnection(bench: Bench, fault: str) -> None:
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    eventually(lambda: bench.write(0.5) is not None)
    bench.faults.clear()
    bench.write_until_it_works(0.5)
    eventually(lambda: bench.width == 1500, 2.0)
    eventually(lambda: bench.width == 0, 2.0)
    with opened("127.0.0.1", bench.daemon.port) as client:
        assert sum(bool(client.script_status(script)[1]) for script in range(32)) == 1


def test_without_a_pigpiod_it_starts_all_the_same_and_connects_later(bench: Bench) -> None:
    bench.servo.close()
    bench.faults.inject("pigpiod-gone")
    begun = time.monotonic()
    bench.servo = bench.another()
    assert time.monotonic() - begun < 4.0
    error = bench.write(0.1)
    assert error is not None
    assert "not connected: Connection refused" in error
    bench.faults.clear()
    bench.write_until_it_works(0.1)
    assert bench.width == 1560


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen"])
def test_closing_takes_a_bounded_time(bench: Bench, fault: str) -> None:
    bench.write_until_it_works(0.5)
    bench.faults.inject(fault)
    eventually(lambda: bench.write(0.5) is not None)
    begun = time.monotonic()
    with pytest.raises(ServoError):
        bench.servo.close()
    bench.servo.close()
    assert time.monotonic() - begun < 1.0
    assert "pigpio-link" not in [thread.name for thread in threading.enumerate()]


def test_an_emergency_release_from_another_thread_does_not_disturb_the_writes(
    bench: Bench,
) -> None:
    bench.write_until_it_works(0.5)
    stop = threading.Event()
    failures = []

    def press() -> None:
        while not stop.is_set():
            try:
                bench.servo.release()
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


def test_a_late_answer_never_meets_a_later_command() -> None:
    clock = VirtualClock()
    faults = Faults(clock)
    daemon = Pigpiod(clock, faults)
    daemon.start()
    settings = PigpioSettings(gpio=GPIO, port=daemon.port)
    servo = CalibratedServo(
        partial(Pigpio, standstill=daemon.stands_still),
        settings,
        ServoCalibration(),
        clock,
        threaded=False,
        tick=TICK,
    )
    try:
        for angle in (0.1, 0.2, 0.3):
            servo.write(angle)
            faults.inject("pigpiod-frozen")
            servo.write(-angle)
            faults.clear()
            clock.sleep(0.05)
            servo.write(angle)
            assert daemon.width(GPIO, clock.now + 0.02) == 1500 + 600 * angle
        assert servo.driver.counters() == {"servo_reconnects": 0, "servo_late_answers": 3}
    finally:
        servo.close()
        daemon.close()
