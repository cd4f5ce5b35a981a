"""Force sensor of another package, whose driver may raise any exception in any method."""

import itertools
from typing import Any

import pytest

from fishd.core.calibration import ForceCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import SensorError
from fishd.hardware.driver import ForceSensorDriver, ForceSensorSettings, Pair
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor

TICK = 0.05
GRAMS_PER_NEWTON = 102.0


class Balance(ForceSensorDriver[ForceSensorSettings]):
    """Driver that weighs in grams, and raises `error` in the methods that `broken` lists."""

    Settings = ForceSensorSettings
    raw_unit = "g"
    place = "the balance"
    broken: tuple[str, ...] = ()
    error: BaseException = SystemExit(3)
    grams = 1.0

    def _fail_if_broken(self, method: str) -> None:
        if method in self.broken:
            raise self.error

    def open(self) -> None:
        self._fail_if_broken("open")

    def sample(self) -> Pair:
        self._fail_if_broken("sample")
        started = self.clock.monotonic()
        self.clock.sleep(0.002)
        self.grams = -self.grams  # so that the code does not count as frozen
        return Pair(started, self.clock.monotonic(), self.grams, 0.5 * self.grams)

    def close(self) -> None:
        self._fail_if_broken("close")

    def counters(self) -> dict[str, int]:
        self._fail_if_broken("counters")
        return {"balance_taps": 3}

    def explain(self, error: Exception) -> str:
        self._fail_if_broken("explain")
        return f"the balance says nothing: {error}"

    @classmethod
    def pair_rate(cls, settings: ForceSensorSettings) -> float:
        return 500.0


def open_balance(**settings: Any) -> tuple[Balance, SampledSensor]:
    clock = VirtualClock()
    balance = Balance(ForceSensorSettings(driver="balance", **settings), clock)
    sensor = SampledSensor(balance, ForceCalibration(), clock, threaded=False, tick=TICK)
    return balance, sensor


@pytest.mark.parametrize("error", [SystemExit(3), OSError(9, "closed")])
@pytest.mark.parametrize(
    "broken", [("open", "sample"), ("sample", "close"), ("sample", "explain", "close")]
)
def test_whatever_it_raises_is_told_and_samples_come_again(
    broken: tuple[str, ...], error: BaseException
) -> None:
    balance, sensor = open_balance()
    times = (TICK * number for number in itertools.count(1))
    assert sensor.read(next(times)).samples
    balance.broken, balance.error = broken, error
    messages = set()
    for _ in range(10):
        try:
            sensor.read(next(times))
        except SensorError as failure:
            messages.add(str(failure))
    expected = "the balance says nothing" if "explain" not in broken else type(error).__name__
    assert any(expected in line for line in messages), messages
    balance.broken = ()
    assert any(sensor.read(next(times)).samples for _ in range(20))
    assert sensor.counters()["balance_taps"] == 3
    balance.broken = ("close", "counters")
    assert "balance_taps" not in sensor.counters()
    sensor.close()


def test_until_it_is_calibrated_forces_are_in_its_own_unit() -> None:
    balance, sensor = open_balance(force_limit=5.0)
    balance.grams = 60.0
    assert sensor.unit == "g"
    suspect = sensor.read(TICK).suspect
    assert suspect.endswith("force_sensor.force_limit, 5 N (not calibrated: 1 g counts as 1 N)")
    newtons = 1.0 / GRAMS_PER_NEWTON
    sensor.recalibrate(ForceCalibration(xx=newtons, yy=newtons, loads=5))
    assert sensor.unit == "N"
    assert not sensor.read(2 * TICK).suspect
