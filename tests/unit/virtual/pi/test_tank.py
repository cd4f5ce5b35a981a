"""Fish between pulses and volts, checked against the plant itself."""

import math
import statistics
from typing import Any

import pytest

from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.pulse_train import PulseTrain
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import Tank
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

TICK = 0.05
X, Y = 0, 3
"""MUX codes of A0-A1 and A2-A3."""
ANGLE_LEFT, ANGLE_RIGHT = 0.4, -0.4


def width(angle: float) -> float:
    return 1500.0 + 600.0 * angle


class Rig:
    """Tank without noise, and a pin for its servo."""

    def __init__(self, *, noise: float = 0.0, start: float = 0.0, **settings: Any) -> None:
        self.pin = PulseTrain()
        self.tank = Tank(
            VirtualPiSettings(**settings),
            PlantParameters(),
            SimulationSettings(noise=noise),
            TICK,
            self.pin.width,
            start,
        )

    def beat(self, until: float, half_period: float = 0.25) -> None:
        """Alternate the pulses, from the frame at 0 on."""
        for k in range(round(until / half_period)):
            self.pin.set(k * half_period, width(ANGLE_LEFT if k % 2 == 0 else ANGLE_RIGHT))


def fish_at(*stretches: tuple[float | None, float]) -> TetheredFish:
    """Return the plant after (angle, seconds), (angle, seconds) ..."""
    fish = TetheredFish(PlantParameters())
    for angle, seconds in stretches:
        fish.advance(angle, seconds, 1)
    return fish


def test_a_fish_that_gets_no_pulses_rests_at_zero_volts() -> None:
    rig = Rig()
    assert rig.tank.volts(X, 0.5, 0.6) == 0.0
    assert rig.tank.volts(Y, 0.6, 0.7) == 0.0
    assert rig.tank.truth().alpha == 0.0


def test_a_conversion_is_the_mean_force_while_it_lasts() -> None:
    rig = Rig()
    rig.pin.set(0.0, width(ANGLE_LEFT))
    fish = fish_at((ANGLE_LEFT, 0.1))
    expected = fish.advance(ANGLE_LEFT, 0.0012, 1)
    assert rig.tank.volts(Y, 0.1, 0.1012) == pytest.approx(expected.lateral_force, rel=1e-6)
    assert abs(expected.lateral_force) > 0.05
    slow = fish.advance(ANGLE_LEFT, 0.1248, 1)
    assert rig.tank.volts(X, 0.1012, 0.226) == pytest.approx(slow.thrust, rel=1e-6)
    assert rig.tank.truth().alpha == pytest.approx(fish.state.alpha)


def test_pulses_that_change_during_a_conversion_count_from_their_frame_on() -> None:
    rig = Rig()
    rig.pin.set(0.0, width(ANGLE_LEFT))
    rig.pin.set(0.1034, width(ANGLE_RIGHT))  # from 0.12 on
    fish = fish_at((ANGLE_LEFT, 0.1))
    before, after = fish.advance(ANGLE_LEFT, 0.02, 1), fish.advance(ANGLE_RIGHT, 0.03, 1)
    impulse = 0.02 * before.lateral_force + 0.03 * after.lateral_force
    assert rig.tank.volts(Y, 0.1, 0.15) == pytest.approx(impulse / 0.05, rel=1e-6)


def test_without_pulses_the_wheel_stays_where_it_is() -> None:
    rig = Rig()
    rig.pin.set(0.0, width(ANGLE_LEFT))
    rig.pin.set(0.05, 0.0)  # off from 0.06
    rig.tank.catch_up(5.0)
    wheel = fish_at((ANGLE_LEFT, 0.06)).state.phi
    assert 0.1 < wheel < ANGLE_LEFT
    assert rig.tank.truth().phi == pytest.approx(wheel)
    assert rig.tank.instruction_angle(5.0) is None


def test_the_servo_may_be_mounted_the_other_way_round() -> None:
    there, back = Rig(), Rig(servo_centre=1480.0, servo_scale=-600.0)
    there.pin.set(0.0, width(ANGLE_LEFT))
    back.pin.set(0.0, 1480.0 - 600.0 * ANGLE_LEFT)
    assert back.tank.volts(Y, 0.05, 0.06) == pytest.approx(there.tank.volts(Y, 0.05, 0.06))


def test_sensitivity_crosstalk_and_zero_are_those_of_the_settings() -> None:
    plain, wired = Rig(), Rig(sensitivity=0.5, crosstalk=0.1, zero_x=0.2, zero_y=-0.3)
    for rig in (plain, wired):
        rig.pin.set(0.0, width(ANGLE_LEFT))
    forces = [plain.tank.volts(X, 0.1, 0.11), plain.tank.volts(Y, 0.11, 0.12)]
    # The first conversion is of F_x and the second of F_y: compare each with the plant.
    fish = fish_at((ANGLE_LEFT, 0.1))
    first, second = fish.advance(ANGLE_LEFT, 0.01, 1), fish.advance(ANGLE_LEFT, 0.01, 1)
    assert forces == pytest.approx([first.thrust, second.lateral_force])
    vx = 0.5 * (first.thrust + 0.1 * first.lateral_force) + 0.2
    vy = 0.5 * (second.lateral_force + 0.1 * second.thrust) - 0.3
    assert wired.tank.volts(X, 0.1, 0.11) == pytest.approx(vx)
    assert wired.tank.volts(Y, 0.11, 0.12) == pytest.approx(vy)


@pytest.mark.parametrize(
    ("channels", "volts"),
    [
        # by MUX code: A0-A1, A0-A3, A1-A3, A2-A3, A0, A1, A2, A3; F_x is 1 V and F_y 2 V
        (("A0-A1", "A2-A3"), [1, 1, 0, 2, 1, 0, 2, 0]),
        (("A2-A3", "A0-A1"), [2, 2, 0, 1, 2, 0, 1, 0]),
        (("A0", "A1"), [-1, 1, 2, 0, 1, 2, 0, 0]),
        (("A0-A3", "A1-A3"), [-1, 1, 2, 0, 1, 2, 0, 0]),
        (("A3", "A2"), [0, -1, -1, 1, 0, 0, 2, 1]),
    ],
)
def test_each_input_sees_its_wires(channels: tuple[str, str], volts: list[float]) -> None:
    rig = Rig(channel_x=channels[0], channel_y=channels[1], zero_x=1.0, zero_y=2.0)
    assert [rig.tank.volts(mux, mux, mux + 0.01) for mux in range(8)] == volts


def test_noise_is_white_a_short_conversion_has_more_of_it_than_a_tick() -> None:
    rig = Rig(noise=1e-3)
    short = [rig.tank.volts(X, k * 0.0013, k * 0.0013 + 0.00125) for k in range(4000)]
    assert statistics.fmean(short) == pytest.approx(0.0, abs=5e-4)
    assert statistics.stdev(short) == pytest.approx(1e-3 * math.sqrt(TICK / 0.00125), rel=0.05)
    long = [rig.tank.volts(X, 10 + k * TICK, 10 + (k + 1) * TICK) for k in range(1000)]
    assert statistics.stdev(long) == pytest.approx(1e-3, rel=0.1)


def test_the_window_is_what_the_fish_truly_did_since_the_previous_one() -> None:
    rig = Rig(noise=0.1, zero_x=3.0)
    rig.beat(until=0.96, half_period=0.24)
    fish = TetheredFish(PlantParameters())
    for angle in (ANGLE_LEFT, ANGLE_RIGHT):
        expected = fish.advance(angle, 0.24, 1)
        end = 0.24 if angle == ANGLE_LEFT else 0.48
        begin = end - 0.24
        for k in range(96):  # a conversion and a pause, again and again
            rig.tank.volts(k % 2, begin + k * 0.0025, begin + k * 0.0025 + 0.0012)
        rig.tank.catch_up(end)
        swum = rig.tank.take_window()
        assert swum.duration == pytest.approx(0.24)
        assert swum.thrust == pytest.approx(expected.thrust, rel=1e-6)
        assert swum.fin_peak == pytest.approx(expected.fin_peak, rel=1e-6)
    assert rig.tank.take_window().duration == 0.0
