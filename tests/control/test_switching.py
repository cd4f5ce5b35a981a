"""Switching controllers: ten thousand times, and never beyond the limits."""

import random

import pytest
from rigs.harness import Rig

SWITCHES = 10_000
CHOICES = {
    "hold": {"angle": (-0.42, 0.42)},
    "square": {"frequency": (0.2, 5.0), "amplitude": (0.02, 0.42)},
    "sine": {"frequency": (0.2, 5.0), "amplitude": (0.02, 0.42)},
    "triangle": {"frequency": (0.2, 5.0), "amplitude": (0.02, 0.42)},
    "swing": {"C": (0.0, 1.0), "amplitude": (0.02, 0.42)},
}


@pytest.mark.slow
@pytest.mark.parametrize("slew_limit", [None, 3.0])
def test_ten_thousand_switches_stay_within_amplitude_and_slew_limit(
    slew_limit: float | None,
) -> None:
    rig = Rig(f"slew_limit={'null' if slew_limit is None else slew_limit}")
    generator = random.Random(7)
    step = 0.84 if slew_limit is None else slew_limit * 0.05
    angle = 0.0
    for _ in range(SWITCHES):
        name = generator.choice(list(CHOICES))
        if generator.random() < 0.1:
            rig.loop.stop()
        else:
            rig.start(name, **{k: generator.uniform(*v) for k, v in CHOICES[name].items()})
        for tick in rig.run(generator.choice((1, 1, 2, 3, 7))):
            assert abs(tick.phi_c) <= 0.42
            assert abs(tick.phi_c - angle) <= step * (1 + 1e-8)
            angle = tick.phi_c
        rig.recorder.ticks.clear()
        rig.recorder.events.clear()
    assert rig.mode in ("idle", "running")


def test_sine_and_triangle_begin_from_the_angle_in_force_after_any_switch() -> None:
    rig = Rig()
    generator = random.Random(11)
    for _ in range(500):
        first = generator.choice(list(CHOICES))
        rig.start(first, **{k: generator.uniform(*v) for k, v in CHOICES[first].items()})
        before = rig.run(generator.randint(1, 9))[-1].phi_c
        rig.start(generator.choice(("sine", "triangle")), frequency=generator.uniform(0.2, 3.0))
        assert rig.run(1)[0].phi_c == pytest.approx(before, abs=1e-12)
