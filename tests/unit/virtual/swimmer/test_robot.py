"""Free swimmer as a robot of the loop: its commands, its measurements, and its failure."""

import math
from typing import NoReturn

import numpy as np
import pytest
from rigs.coarse_swimmer import coarse, swimmer

from fishd.core.errors import ConfigError, FishLost
from fishd.lab.simulation import KeepingPublisher, VirtualRun, simulate
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish
from fishd.virtual.swimmer.fish import Diverged
from fishd.virtual.swimmer.robot import Swimmer

PHI = 0.42
TICK = 0.01


def swum(fish: Swimmer, ticks: int, first: int = 1) -> None:
    for index in range(first, first + ticks):
        fish.read(index * TICK)


def test_it_swims_until_the_time_at_which_it_is_read() -> None:
    fish = swimmer()
    assert fish.read(7.0).samples == 6
    assert fish.fish.time == pytest.approx(TICK)
    assert fish.read(7.03).samples == 18  # two slots were missed
    assert fish.fish.time == pytest.approx(4 * TICK)


@pytest.mark.parametrize(("angle", "activation"), [(PHI, 1.0), (-PHI / 2, -0.5), (2 * PHI, 1.0)])
def test_the_muscles_do_what_the_command_is_of_its_limit_and_relax_when_it_is_released(
    angle: float, activation: float
) -> None:
    fish = swimmer()
    fish.write(angle)
    fish.read(TICK)
    assert fish.fish.activation == pytest.approx(activation)
    assert fish.truth().phi == pytest.approx(activation * PHI)
    fish.release()
    fish.read(2 * TICK)
    assert fish.fish.activation == 0.0


def test_with_a_servo_the_muscles_follow_its_wheel() -> None:
    fish, tethered = swimmer("swimmer.muscle.servo=true"), TetheredFish(PlantParameters())
    half = fish.fish.dt / 2
    for index, angle in enumerate([PHI, PHI, PHI, -PHI, -PHI], 1):
        fish.write(angle)
        fish.read(index * TICK)
        tethered.advance(angle, TICK - half, 1)  # value in the middle of the last step
        assert fish.truth().phi == pytest.approx(tethered.state.phi, abs=1e-9)
        tethered.advance(angle, half, 1)


@pytest.mark.parametrize("kind", ["sensor", "tail"])
def test_a_positive_command_moves_the_tail_to_positive_angles(kind: str) -> None:
    fish = swimmer(f"estimator.kind={kind}")
    fish.write(PHI)
    swum(fish, 12)
    truth, fin_velocity = fish.truth(), fish.read(13 * TICK).fin_velocity
    assert truth.alpha > 0.01
    assert truth.alpha_rate > 0.5
    assert fin_velocity > 0.5


@pytest.mark.parametrize(("time", "passed"), [(0.0, 1.0), (0.02, 1.0 - math.exp(-1.0))])
@pytest.mark.parametrize(("kind", "rate"), [("sensor", 2.0), ("tail", 0.39 / 0.078)])
def test_the_fin_velocity_is_the_rate_or_the_lateral_velocity_of_the_tail_low_passed(
    time: float, passed: float, kind: str, rate: float
) -> None:
    fish = swimmer(f"swimmer.sensor_time={time}", f"estimator.kind={kind}")
    turning = fish.motion._replace(tail_rate=2.0, tail_speed=0.39)
    fish.fish.step = lambda activation: None  # type: ignore[method-assign]
    fish.fish.motion = lambda: turning  # type: ignore[method-assign]
    fish.read(TICK)
    assert fish.read(2 * TICK).fin_velocity == pytest.approx(rate * passed)
    assert fish.truth().alpha_rate == 2.0


def test_a_fish_goes_on_from_its_state_to_the_last_bit() -> None:
    fish, restored = swimmer(), swimmer()
    fish.write(PHI)
    swum(fish, 20)
    restored.restore(fish.state())
    swum(fish, 5, first=21)
    swum(restored, 5)  # its loop may restart its count
    assert restored.motion == fish.motion
    assert restored.work == fish.work
    for name, array in fish.state().items():
        assert np.array_equal(array, restored.state()[name], equal_nan=True), name


def diverges(_: float) -> NoReturn:
    raise Diverged("the swimmer cannot go on at 0.100 s: a test")


def test_a_fish_that_is_lost_stays_lost() -> None:
    fish = swimmer()
    fish.fish.step = diverges  # type: ignore[method-assign]
    for _ in range(2):
        with pytest.raises(FishLost, match=r"cannot go on at 0\.100 s"):
            fish.read(1.0)
    assert fish.limitations() == ("the swimmer cannot go on at 0.100 s: a test; restart fishd",)


def test_the_loop_swims_it_and_latches_a_fault_of_its_own_where_it_is_lost() -> None:
    publisher = KeepingPublisher()
    with VirtualRun(coarse(), publisher) as run:
        run.set_controller("swing", {})
        for _ in range(30):
            run.tick()
        run.fish.fish.step = diverges  # type: ignore[method-assign]
        run.tick()
        supervisor = run.loop.supervisor
        assert supervisor.mode.value == "fault"
        assert supervisor.reason.code == "fish-lost"
    tick = publisher.ticks[29]
    assert tick.mode == "running"
    sensed, true = zip(
        *((t.fin_velocity, t.alpha_rate) for t in publisher.ticks[5:30]), strict=True
    )
    assert np.corrcoef(sensed, true)[0, 1] > 0.9
    assert tick.speed == run.fish.motion.speed
    assert tick.x == run.fish.motion.x


def test_nothing_judges_a_swimmer_as_if_it_were_tethered() -> None:
    with pytest.raises(ConfigError, match="set robot: simulated"):
        simulate(coarse(), "swing", {}, 2.0, 1.0)
