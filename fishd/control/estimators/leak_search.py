"""Which leak restores the fin velocity of this fish? Found from F_x, which the fin makes, too.

With the leak T = K/K_d the leaky integral of F_y = −K (α̈ + α̇/T) is −K α̇, whatever the motion. Then
its own integral and its own rate give the ripple of F_x = −K α α̈; with another T they are early or
late against it (Fu et al., the two forces). So a bank of leaks runs beside one another, and the
one whose product goes best with F_x is that of the fish.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST, LONGEST, LEAKS = 0.02, 1.0, 12
"""The bank, evenly spaced in the logarithm [s]."""
ANGLE_LEAK = 5.0
"""The fin angle forgets with this time constant: far slower than a beat [s]."""
RIPPLE = 0.5
"""What changes more slowly than this is no ripple [s]."""
MEMORY = 10.0
"""So far back, about, the comparison looks [s]."""
EVERY = 2.0
"""Time between two looks at it [s]."""
GOOD = 0.88
"""No leak is believed whose ripple goes less well with that of F_x: a correlation."""
BETTER = 2.0
"""Nor one that does not leave so many times less of the ripple unexplained than the present one."""
AGREE = 1.25
"""Two looks must give the same one, within this factor."""


class LeakSearch:
    """A bank of leaky integrals of F_y, each compared with F_x."""

    def __init__(self, leak: float, bias_time: float) -> None:
        """
        leak: to begin with [s]
        bias_time: of the average that is taken off F_y beforehand [s]
        """
        self.leak = leak
        """The best that is known [s]."""
        self.leaks: Array = np.geomspace(SHORTEST, LONGEST, LEAKS)
        # What is taken off F_y, and what the angle forgets, makes the product early. The forces are
        # made as early: at twice the frequency, where the product is early by two of three factors.
        hasten = 1.0 / (4.0 / bias_time + 2.0 / ANGLE_LEAK)
        self._hastened, self._forces = _HighPass(hasten), _HighPass(RIPPLE)
        self._ripples = _HighPass(RIPPLE)
        zero = np.zeros(LEAKS)
        self._velocity, self._angle = zero, zero
        self._powers, self._products, self._across = zero, zero, zero
        self._power = self._mixed = self._lateral = 0.0
        self._dt = self._time = self._found = 0.0
        self._decay = self._gain = zero

    def update(self, fx: float, fy: float, bias: float, dt: float) -> None:
        """Take in a window: its mean forces and the offset of F_y [N], and its length [s]."""
        if dt != self._dt:
            self._dt = dt
            self._decay = np.exp(-dt / self.leaks)
            self._gain = self.leaks * (1.0 - self._decay)
        before, angle = self._velocity, self._angle
        self._velocity = velocity = before * self._decay - self._gain * (fy - bias)
        self._angle = angle * math.exp(-dt / ANGLE_LEAK) + (0.5 * dt) * (velocity + before)
        ripple = self._ripples.of((before - velocity) * (self._angle + angle), dt)
        forces = self._forces.of(self._hastened.of(np.array([fx, fy]), dt), dt)
        force, lateral = forces.tolist()
        kept = math.exp(-dt / MEMORY)
        self._powers = self._powers * kept + ripple * ripple
        self._products = self._products * kept + ripple * force
        self._across = self._across * kept + ripple * lateral
        self._power = self._power * kept + force * force
        self._mixed = self._mixed * kept + force * lateral
        self._lateral = self._lateral * kept + lateral * lateral
        self._time += dt
        if self._time >= EVERY:
            self._time = 0.0
            self._look()

    def reverse_fy(self) -> None:
        """Take F_y with the other sign from now on: what is odd in it changes its sign."""
        self._velocity, self._angle = -self._velocity, -self._angle
        self._across, self._mixed = -self._across, -self._mixed
        for filtered in (self._hastened, self._forces):
            filtered.scale(np.array([1.0, -1.0]))

    def _look(self) -> None:
        before, self._found = self._found, self._best()
        if self._found and 1.0 / AGREE < before / self._found < AGREE:
            self.leak = self._found

    def _best(self) -> float:
        """The leak that fits best [s]; 0 where it is not to be believed, or hardly better."""
        fit, logs = self.fit, np.log(self.leaks)
        best = int(fit.argmax())
        present = float(np.interp(math.log(self.leak), logs, fit))
        if fit[best] < GOOD or 1.0 - present**2 < BETTER * (1.0 - fit[best] ** 2):
            return 0.0
        middle = min(max(best, 1), LEAKS - 2)
        left, top, right = fit[middle - 1 : middle + 2].tolist()
        bend = left - 2.0 * top + right
        aside = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        step = float(logs[1] - logs[0])
        return math.exp(float(logs[middle]) + step * max(-1.0, min(1.0, aside)))

    @property
    def fit(self) -> Array:
        """Correlation of the ripple of F_x with that of each leak.

        Of what neither has in common with F_y: a turned sensor shows some of that as F_x.
        """
        lateral = max(self._lateral, 1e-300)
        power = self._power - self._mixed**2 / lateral
        powers = self._powers - self._across**2 / lateral
        products = self._products - self._across * (self._mixed / lateral)
        return products / np.sqrt(np.maximum(powers * power, 1e-300))


class _HighPass:
    """Takes off what changes slowly."""

    def __init__(self, time: float) -> None:
        """time: slower than that [s]"""
        self._time = time
        self._slow: Array | None = None

    def scale(self, factors: Array) -> None:
        """Multiply what is known of each value."""
        if self._slow is not None:
            self._slow = self._slow * factors

    def of(self, values: Array, dt: float) -> Array:
        """What is left of these values, `dt` s after those before."""
        slow = values if self._slow is None else self._slow
        self._slow = slow + (1.0 - math.exp(-dt / self._time)) * (values - slow)
        return values - self._slow
