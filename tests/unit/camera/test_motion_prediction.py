"""Agreement of the simulated camera's prediction until the next tick with the motion."""

import random
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fishd.camera.simulated import Tail
from fishd.camera.sources.simulated import FishDescription, MotionPrediction, TickTruth
from fishd.virtual.fish import SimulatedFish
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

TICK = 0.05


class Swim:
    """Simulated fish under random commands, and the ticks that a camera receives."""

    def __init__(self, plant: PlantParameters, seed: int) -> None:
        self._fish = SimulatedFish(plant, SimulationSettings(), TICK)
        self._random = random.Random(seed)
        self._slot = self._seq = 0
        self.command = 0.0

    def tick(self, slots: int = 1, *, released: bool = False) -> TickTruth:
        """slots: periods since the previous tick"""
        self._slot += slots
        self._seq += 1
        now = self._slot * TICK
        self._fish.read(now)
        truth = self._fish.truth()
        self.command = self._random.uniform(-0.42, 0.42)
        if released:
            self._fish.release()
        else:
            self._fish.write(self.command)
        state = {"alpha": truth.alpha, "alpha_rate": truth.alpha_rate, "phi": truth.phi}
        return TickTruth(self._seq, self.command, not released, now, **state)


def predict(plant: PlantParameters, **options: Any) -> MotionPrediction:
    return MotionPrediction(FishDescription(TICK, plant, 200.0, options.get("lockstep", True)))


@settings(max_examples=20)
@given(
    seed=st.integers(0, 1000),
    delay=st.sampled_from([0.0, 0.03, 0.12]),
    backlash=st.sampled_from([0.0, 0.05]),
    slack=st.sampled_from([0.0, 0.03]),
)
def test_the_next_tick_is_known_to_the_last_bit(
    seed: int, delay: float, backlash: float, slack: float
) -> None:
    plant = PlantParameters(servo_delay=delay, backlash=backlash, cable_slack=slack)
    swim, ahead = Swim(plant, seed), predict(plant)
    believed = Tail(0.0, 0.0, 0.0)
    for number in range(40):
        tick = swim.tick(released=number in (20, 21))
        # By then, the commands sent before the first tick have arrived, and the wheel has moved the
        # tail to both sides: its first place within the play was unknown.
        if number > 12:
            assert believed == (tick.time, tick.alpha, tick.alpha_rate)
        ((_, believed),) = ahead.follow(tick)
    assert ahead.end == believed.time


def test_slots_that_fishd_skips_leave_no_hole() -> None:
    swim, ahead = Swim(PlantParameters(), 1), predict(PlantParameters(), lockstep=False)
    course = []
    for slots in (1, 1, 3, 1, 2, 1):
        course += ahead.follow(swim.tick(slots))
    for (_, left), (right, _) in pairwise(course):
        assert right.time == pytest.approx(left.time)
        assert right.alpha == pytest.approx(left.alpha, abs=1e-6)


def test_after_ticks_that_nobody_heard_it_begins_anew_from_the_true_state() -> None:
    plant = PlantParameters(servo_delay=0.08)
    swim, ahead = Swim(plant, 2), predict(plant)
    ahead.follow(swim.tick())
    for _ in range(5):
        swim.tick()
    tick = swim.tick()
    ((begin, _),) = ahead.follow(tick)
    assert (begin.time, begin.alpha) == (tick.time, tick.alpha)
    for _ in range(4):  # until delayed commands have reached the servo
        ((_, believed),) = ahead.follow(swim.tick())
    assert swim.tick().alpha == pytest.approx(believed.alpha, abs=1e-9)
