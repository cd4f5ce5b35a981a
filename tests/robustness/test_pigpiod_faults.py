"""What the true client meets when the emulated pigpiod is gone, frozen or restarted."""

import socket
from collections.abc import Iterator

import pigpio
import pytest
from rigs.pigpiod_client import GPIO, Bench, dispose, pigpiod_bench

from fishd.hardware.servo.pigpio_pulses import COUNTDOWN


@pytest.fixture
def bench() -> Iterator[Bench]:
    with pigpiod_bench() as bench:
        bench.pi.set_servo_pulsewidth(GPIO, 1600)
        bench.sleep(0.05)
        yield bench


def answers(bench: Bench) -> bool:
    """Whether a daemon listens."""
    try:
        socket.create_connection(("127.0.0.1", bench.daemon.port), 1.0).close()
    except ConnectionRefusedError:
        return False
    return True


def test_it_comes_back_on_the_same_port_without_scripts_and_pulses(bench: Bench) -> None:
    port = bench.daemon.port
    bench.stored(COUNTDOWN)
    bench.faults.inject("pigpiod-gone", 2.0)
    dispose(bench.pi)
    bench.sleep(1.9)
    assert bench.width == 0
    assert not answers(bench)
    bench.sleep(0.2)
    assert bench.width == 0
    assert bench.daemon.port == port
    bench.pi = bench.client()
    assert bench.pi.script_status(0) == (pigpio.PI_BAD_SCRIPT_ID, ())
    assert bench.result("get_servo_pulsewidth", GPIO) == pigpio.PI_NOT_SERVO_GPIO


def test_frozen_its_pulses_go_on_and_its_scripts_stand_still(bench: Bench) -> None:
    number = bench.stored(COUNTDOWN)
    bench.pi.run_script(number, [20, GPIO, 1500])
    bench.sleep(0.1)
    bench.faults.inject("pigpiod-frozen", 10.0)
    bench.sleep(9.99)
    assert bench.width == 1600
    # Half of the countdown is left when it goes on.
    bench.sleep(0.01 + 0.09)
    assert bench.width == 1600
    bench.sleep(0.04)
    assert bench.width == 1500
