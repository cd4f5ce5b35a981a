"""Wait of commands for a pulse of the servo, and widths of the pulses, estimated from forces.

A servo takes a new angle with its next pulse. Pulses come in a fixed period that usually does not
divide that of the loop: with 20 ms and a tick of 50 ms, two waits that differ by 10 ms alternate.
The mean wait is part of the delay of the servo. Which tick waits how long depends on the instant at
which fishd started, so the likeliest of all possibilities is used; likewise for the step to which
widths are rounded, which the programs that make the pulses do not tell.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from fishd.config import ServoSettings
from fishd.lab.identification.fit import Problem
from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import MAX_STEP_S, Array, Timing

_MAX_PHASES = 16
"""Largest number of phases of the pulses that are compared."""


def place_pulses(
    parts: Sequence[Passage], problem: Problem, values: dict[str, float], settle: float
) -> list[Passage]:
    """Return the passages with those waits and widths of pulses that agree best with the forces.

    problem: fit of these passages; its noise weights the forces
    settle: time at the start of a passage that is left out [s]
    """
    return [_place(part, problem, values, settle) if part.servo else part for part in parts]


def _place(part: Passage, problem: Problem, values: dict[str, float], settle: float) -> Passage:
    """Return the candidate with the best fit; each is fitted to first order."""
    own = Problem([part], problem.names, settle, problem.law)
    own.noise = problem.noise
    basis, _ = np.linalg.qr(own.jacobian(values).reshape(-1, len(problem.names)))

    def cost(candidate: Passage) -> float:
        residuals = Problem([candidate], problem.names, settle, problem.law).residuals(values)
        innovations = problem.whitened(residuals).ravel()
        explained = basis.T @ innovations
        return float(innovations @ innovations - explained @ explained)

    return min((part, *_candidates(part)), key=cost)


def _candidates(part: Passage) -> Iterator[Passage]:
    """Yield the passage with each timing and rounding that its pulses may have."""
    if part.servo:
        for timing in _timings(part, part.servo.pulse_period):
            for angles in _rounded(part.commands, part.servo):
                yield replace(part, timing=timing, angles=angles)


def _rounded(commands: Array, servo: ServoSettings) -> list[Array]:
    """Return the angles of the pulses for commands [rad], for each step of the servo's driver."""
    neutral, scale = servo.centre + servo.trim, servo.direction * servo.scale
    widths = np.rint(neutral + scale * commands)
    angles = [(np.floor(widths / step) * step - neutral) / scale for step in servo.pulse_steps]
    return angles or [commands]


def _timings(part: Passage, period: float) -> list[Timing]:
    """Return the timings of the commands of a passage for each phase of its pulses.

    period: that of the pulses [s]
    """
    tick = part.tick
    ratio = Fraction(tick / period).limit_denominator(_MAX_PHASES)
    slots = np.arange(len(part.commands))
    is_exact = abs(float(ratio) * period / tick - 1.0) * part.duration < 0.1 * period
    phases = ratio.denominator if is_exact else _MAX_PHASES
    unit = 2 * ratio.numerator
    steps = part.timing.steps
    if is_exact and unit * MAX_STEP_S <= 2.0 * tick:  # all waits are at points of the grid
        steps = unit * math.ceil(tick / (unit * MAX_STEP_S) - 1e-9)
    timings = []
    for phase in range(phases):
        waits: Array = np.mod((phase + 0.5) * period / phases - slots * tick, period)
        begins = slots * tick + waits - waits.mean()
        timings.append(replace(part.timing, begins=begins, steps=steps))
    return timings
