"""Real client with an emulated pigpiod that has ended, is frozen or restarts."""

from collections.abc import Iterator

import pytest
from rigs.pigpiod_client import GPIO, Bench, pigpiod_bench

from fishd.hardware.servo.pigpio_pulses import COUNTDOWN


@pytest.fixture
def bench() -> Iterator[Bench]:
    with pigpiod_bench() as bench:
        bench.pi.set_servo_pulsewidth(GPIO, 1600)
        bench.sleep(0.05)
        yield bench


def test_frozen_its_pulses_go_on_and_its_scripts_stand_still(bench: Bench) -> None:
    number = bench.stored(COUNTDOWN)
    bench.pi.run_script(number, [20, GPIO, 1500])
    bench.sleep(0.1)
    bench.faults.inject("pigpiod-frozen", 10.0)
    bench.sleep(9.99)
    assert bench.width == 1600
    # Half of the countdown remains when it continues.
    bench.sleep(0.01 + 0.09)
    assert bench.width == 1600
    bench.sleep(0.04)
    assert bench.width == 1500
