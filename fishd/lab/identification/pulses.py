"""Wait of commands for the next pulse of the servo, found from the forces.

A servo takes a new angle with its next pulse. Pulses come in a fixed period that usually does not
divide that of the loop: with 20 ms and a tick of 50 ms, two waits that differ by 10 ms alternate.
The mean wait is part of the delay of the servo. Which tick waits how long depends on the instant at
which fishd started, so the likeliest of all possibilities is used.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from fishd.lab.identification.fit import Problem
from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import MAX_STEP_S, Array, Timing

_MAX_PHASES = 16
"""Largest number of phases of the pulses that are compared."""


def place_pulses(
    parts: Sequence[Passage], problem: Problem, values: dict[str, float], settle: float
) -> list[Passage]:
    """Return the passages with those waits for pulses that agree best with the forces.

    problem: fit of these passages; its noise weights the forces
    settle: time at the start of a passage that is left out [s]
    """
    return [_place(part, problem, values, settle) for part in parts]


def _place(
    part: Passage, problem: Problem, values: dict[str, float], settle: float
) -> Passage:
    candidates = [part] + [replace(part, timing=timing) for timing in _timings(part)]

    def cost(candidate: Passage) -> float:
        residuals = Problem([candidate], problem.names, settle).residuals(values)
        return float((problem.whitened(residuals) ** 2).sum())

    return min(candidates, key=cost) if len(candidates) > 1 else part


def _timings(part: Passage) -> list[Timing]:
    """Return the timings of the commands of a passage for each phase of its pulses."""
    tick, period = part.tick, part.pulse_period
    if not period:
        return []
    ratio = Fraction(tick / period).limit_denominator(_MAX_PHASES)
    slots = np.arange(len(part.commands))
    is_exact = abs(float(ratio) * period / tick - 1.0) * part.duration < 0.1 * period
    phases = ratio.denominator if is_exact else _MAX_PHASES
    if phases == 1:
        return []  # all commands wait equally long
    steps = part.timing.steps
    if is_exact and 2 * ratio.numerator * MAX_STEP_S <= 2.0 * tick:
        unit = 2 * ratio.numerator
        steps = unit * math.ceil(tick / (unit * MAX_STEP_S) - 1e-9)
    timings = []
    for phase in range(phases):
        waits: Array = np.mod((phase + 0.5) * period / phases - slots * tick, period)
        begins = slots * tick + waits - waits.mean()
        timings.append(replace(part.timing, begins=begins, steps=steps))
    return timings
