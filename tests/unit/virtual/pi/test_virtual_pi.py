"""Pulses to forces and a button to a pin, with the real drivers on the virtual Pi."""

from collections.abc import Iterator
from contextlib import ExitStack

import gpiod
import pytest
from gpiod.line import Bias, Direction
from rigs.processes import PATIENCE

from fishd.assembly import open_in_virtual_time
from fishd.config import load
from fishd.core.clock import VirtualClock
from fishd.hardware.servo.pigpio_client import Client
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.gpiochip import EmulatedGpiod
from fishd.virtual.pi.i2c import Read
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

GPIO = 18
AMPLITUDE = 0.4  # 240 µs, a whole number of pigpiod's steps


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def pi(clock: VirtualClock) -> Iterator[VirtualPi]:
    settings, rig = VirtualPiSettings(pigpio_port=0), SimulationSettings(noise=0.0)
    pi = VirtualPi(settings, PlantParameters(), rig, 0.05, clock)
    pi.start()
    yield pi
    pi.close()


def steer(pi: VirtualPi) -> None:
    client = Client("127.0.0.1", pi.pigpiod.port, PATIENCE)
    client.set_servo_pulsewidth(GPIO, 1500 + 600 * AMPLITUDE)
    client.close()


def test_faults_reach_both_halves_of_the_pi(pi: VirtualPi, clock: VirtualClock) -> None:
    steer(pi)
    clock.now = 0.11  # between two pulses
    pi.faults.inject("unplugged", 1.0)
    with pytest.raises(OSError, match="Errno 121"):
        pi.bus.transfer(0x48, [Read(1)])
    pi.faults.inject("pigpiod-gone")
    assert set(pi.state().faults) == {"unplugged", "pigpiod-gone"}
    clock.now += 1.0
    assert pi.bus.transfer(0x48, [Read(1)])
    assert pi.state().pulse == 0.0
    assert pi.state().phi_c is None
    wheel = TetheredFish(PlantParameters())
    wheel.advance(AMPLITUDE, 0.09, 1)
    assert pi.tank.truth().phi == pytest.approx(wheel.state.phi, abs=0.05)  # it stopped soon
    assert abs(pi.tank.truth().phi) < AMPLITUDE - 0.02


def test_the_fish_swims_on_with_an_unread_sensor(pi: VirtualPi, clock: VirtualClock) -> None:
    steer(pi)
    assert pi.state().truth.alpha == 0.0
    clock.now += 10.0
    state = pi.state()
    assert (state.pulse, state.phi_c) == (1740.0, pytest.approx(AMPLITUDE))
    assert state.truth.phi == pytest.approx(AMPLITUDE)
    assert state.truth.alpha == pytest.approx(PlantParameters().coupling * AMPLITUDE)


def test_a_button_is_seen_by_the_true_gpio_library(pi: VirtualPi) -> None:
    pull_up = gpiod.LineSettings(direction=Direction.INPUT, bias=Bias.PULL_UP)
    with (
        EmulatedGpiod(pi.pins),
        gpiod.request_lines("/dev/gpiochip0", {17: pull_up}) as request,
    ):
        for level, read in ((None, True), (0, False), (None, True)):
            pi.set_level(17, level)
            assert bool(request.get_value(17)) is read
        pi.set_level(17, 0)
        assert pi.state().levels == {17: 0}
    with pytest.raises(ValueError, match="GPIO 40 is not valid: 0 to 27 is needed"):
        pi.set_level(40, 1)


@pytest.mark.parametrize("adc", ["ads1115", "ads1015"])
def test_the_real_driver_finds_out_which_adc_it_has(adc: str) -> None:
    config = load(None, ["robot=virtual-pi", f"virtual_pi.adc={adc}"])
    with ExitStack() as stack:
        robot, _ = open_in_virtual_time(config, stack)
        robot.sensor.read(config.tick)
        assert any("ADS1015" in line for line in robot.limitations()) == (adc == "ads1015")


def test_a_pigpiod_that_starts_again_never_gives_up_its_port(
    pi: VirtualPi, monkeypatch: pytest.MonkeyPatch
) -> None:
    def take(*_: object) -> None:
        raise AssertionError("another process could have taken the port before")

    with monkeypatch.context() as patch:
        patch.setattr("socket.socket.bind", take)
        pi.faults.inject("pigpiod-restart")
        steer(pi)
        pi.faults.inject("pigpiod-gone")
        with pytest.raises(OSError, match="refused"):
            steer(pi)
