"""The force sensor in real time: its thread, which delays no tick, and its end."""

import contextlib
import threading
import time

import pytest
from rigs.force_rig import TICK, ForceRig
from rigs.processes import PATIENCE, wait_until

from fishd.core.calibration import ForceCalibration
from fishd.core.clock import SystemClock
from fishd.core.errors import SensorError
from fishd.core.signals import Measurement
from fishd.hardware.force_sensor.ads1115 import Ads1115, Ads1115Settings
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.hardware.sampler import CLOSE_TIMEOUT_S


def threaded() -> SampledSensor:
    clock = SystemClock()
    return SampledSensor(
        Ads1115(Ads1115Settings(), clock), ForceCalibration(), clock, threaded=True, tick=TICK
    )


def wait_for_pair(sensor: SampledSensor) -> Measurement:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            measured = sensor.read(time.monotonic())
        except SensorError:
            pass
        else:
            if measured.samples:
                return measured
        time.sleep(0.005)
    raise AssertionError("no pair came in")


def sampler_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "force-sampler"]


def test_a_thread_samples_in_real_time_until_closed() -> None:
    with ForceRig(clock=SystemClock()):
        begun = time.monotonic()  # the thread may have a pair before `threaded` returns
        with contextlib.closing(threaded()) as sensor:
            measured = wait_for_pair(sensor)
            assert begun <= measured.time <= time.monotonic()
            assert (measured.fx, measured.fy) == pytest.approx((0.5, -0.25), abs=1e-3)
            wait_for_pair(sensor)
            assert len(sampler_threads()) == 1
        wait_until(lambda: not sampler_threads())


@pytest.mark.realtime
def test_the_thread_stays_quiet_around_the_expected_read() -> None:
    with ForceRig(clock=SystemClock()) as rig:
        transfers: list[float] = []
        transfer = rig.device.transfer

        def recorded(address: int, messages: object) -> list[bytes]:
            transfers.append(time.monotonic())
            return transfer(address, messages)

        rig.device.transfer = recorded
        sensor = threaded()
        wait_for_pair(sensor)
        quiet = 0
        for _ in range(20):
            now = time.monotonic()
            try:
                sensor.read(now)
            except SensorError:
                continue
            time.sleep(1.2 * TICK)  # the next read is late; sampling continues
            expected = now + TICK
            near = [moment for moment in transfers if -1e-3 < moment - expected < 0.5e-3]
            later = [moment for moment in transfers if moment > expected + 2.4e-3]
            quiet += not near and bool(later)
        sensor.close()
    assert quiet >= 5  # 0 on an idle machine; on a busy one many conversions are late


def test_closing_does_not_wait_for_a_transfer_that_hangs() -> None:
    with ForceRig(clock=SystemClock()) as rig:
        released, entered = threading.Event(), threading.Event()

        def hanging(address: int, messages: object) -> list[bytes]:
            entered.set()
            released.wait(PATIENCE)
            raise TimeoutError(110, "Connection timed out")

        rig.device.transfer = hanging
        sensor = threaded()
        assert entered.wait(PATIENCE)
        with pytest.raises(SensorError, match="has not delivered a sample yet"):
            sensor.read(time.monotonic())
        begun = time.monotonic()
        sensor.close()
        assert CLOSE_TIMEOUT_S <= time.monotonic() - begun < 30.0
        (thread,) = sampler_threads()
        released.set()
        thread.join(PATIENCE)
        assert not thread.is_alive()
