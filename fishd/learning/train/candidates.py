"""Evaluations in the tank: the policy that swims best, with as few short swims as possible.

The candidates are the arms of a bandit. Each swim gives one thrust, with an error of unknown size.
The policy of the next swim is chosen as in LUCB (Kalyanakrishnan et al., "PAC subset selection in
stochastic multi-armed bandits", ICML 2012): of the policy with the highest mean, and of the one
with the highest upper bound among the others, the one that has swum less often. The search ends
when no other policy may be better by more than `EQUAL_SHARE`.
"""

import copy
import math
from collections.abc import Callable
from typing import Any

from msgspec import Struct
from stable_baselines3 import PPO

from fishd.core.calibration import Z95
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.swims import Stopped, Swim, Swims
from fishd.learning.ppo import DeterministicPolicy

EQUAL_SHARE = 0.01
"""Difference of thrust below which policies are equally good, as a share of the best square
wave's."""
MAX_CANDIDATES = 8
"""Largest number of candidates."""
PRIOR_ERROR, PRIOR_DEGREES = 0.03, 3
"""Prior standard deviation of a swim, as a share of the best square wave's thrust, and its weight
as a number of comparisons of swims of the same policy."""


class Candidate(Struct, eq=False, kw_only=True):
    """A policy that may be the best, and the figures of its swims."""

    steps: int
    """Number of control steps that it has learned from."""
    updates: int
    """Number of passes over rollouts until then, as stable-baselines3 counts them."""
    rollouts: int
    """Number of updates until then."""
    parameters: dict[str, Any]
    """Parameters of networks and optimiser."""
    swims: int = 0
    """Number of measured swims."""
    thrust: float = 0.0
    """Mean thrust of the measured swims [N]."""
    swim_time: float = 0.0
    """Total time of all swims [s]."""
    frequency: float = 0.0
    """Tail beats per second in its latest swim [Hz]."""
    fullness: float = 0.0
    """Mean |φ_c|/Φ in the latest swim."""
    is_stalled: bool = False
    """Whether the policy stalls instead of swimming."""


class Candidates:
    """The policies that may be the best."""

    def __init__(self, best_thrust: float) -> None:
        """best_thrust: thrust of the best square wave [N]"""
        self.remaining: list[Candidate] = []
        self._equal = EQUAL_SHARE * best_thrust
        self._squares = PRIOR_DEGREES * (PRIOR_ERROR * best_thrust) ** 2
        self._degrees = PRIOR_DEGREES

    def add(self, candidate: Candidate) -> None:
        """Add a candidate, which may have swum before."""
        self.remaining.append(candidate)

    def add_swim(self, candidate: Candidate, swim: Swim) -> None:
        """Add a swim to the figures of a candidate; remove the candidate if it stalls."""
        candidate.frequency, candidate.fullness, candidate.is_stalled = (
            swim.frequency,
            swim.fullness,
            swim.is_stalled,
        )
        candidate.swim_time += swim.seconds
        if candidate.is_stalled:
            self.remaining.remove(candidate)
        elif swim.thrust is not None:
            if candidate.swims:
                self._squares += (
                    (swim.thrust - candidate.thrust) ** 2 * candidate.swims / (candidate.swims + 1)
                )
                self._degrees += 1
            candidate.swims += 1
            candidate.thrust += (swim.thrust - candidate.thrust) / candidate.swims

    def ci95(self, candidate: Candidate) -> float:
        """Return the half-width of the 95 % interval of its thrust, infinite before a swim [N].

        The errors of all swims are assumed to have the same standard deviation, which is estimated
        from all policies that have swum more than once.
        """
        if not candidate.swims:
            return math.inf
        variance = self._squares / (self._degrees - 2)  # as that of Student's t distribution
        return Z95 * math.sqrt(variance / candidate.swims)

    @property
    def best(self) -> Candidate | None:
        """Candidate with the highest lower bound of its thrust; None before the first swim."""
        return max(self._measured, key=self._lower, default=None)

    def next(self) -> Candidate | None:
        """Return the candidate of the next swim; None where the best is known well enough."""
        for candidate in reversed(self.remaining):
            if not candidate.swims:
                return candidate
        first = max(self.remaining, key=lambda candidate: candidate.thrust, default=None)
        others = [candidate for candidate in self.remaining if candidate is not first]
        if first is None or not others:
            return None
        rival = max(others, key=self._upper)
        if self._upper(rival) <= self._lower(first) + self._equal:
            return None
        return min(first, rival, key=lambda candidate: candidate.swims)

    def remove_unlikely(self) -> None:
        """Remove candidates that can no longer be the best; keep at most `MAX_CANDIDATES`."""
        bound = max(map(self._lower, self._measured), default=-math.inf)
        likely = sorted(self.remaining, key=self._upper, reverse=True)
        kept = [candidate for candidate in likely if self._upper(candidate) >= bound][
            :MAX_CANDIDATES
        ]
        best = self.best
        self.remaining = [
            candidate for candidate in self.remaining if candidate in kept or candidate is best
        ]

    @property
    def _measured(self) -> list[Candidate]:
        return [candidate for candidate in self.remaining if candidate.swims]

    def _lower(self, candidate: Candidate) -> float:
        return candidate.thrust - self.ci95(candidate)

    def _upper(self, candidate: Candidate) -> float:
        return candidate.thrust + self.ci95(candidate)


class TankEvaluations:
    """Evaluations that determine which policy of a training swims best, a few swims at a time."""

    def __init__(
        self, model: PPO, env: SwimEnv, former: Candidate | None, stop: Callable[[], bool]
    ) -> None:
        """
        former: best policy of a training that is resumed
        stop: called before each tick; True ends an evaluation there
        """
        self._model, self._env, self._stop = model, env, stop
        self._candidates = Candidates(env.best_thrust)
        if former:
            self._candidates.add(former)
        self.best = former
        """Best policy that swims, according to the latest evaluation."""
        self._swum: list[Candidate] = []

    def add(self, steps: int, rollouts: int) -> None:
        """Add the current policy of the model as a candidate.

        steps, rollouts: numbers of those that it has learned from
        """
        self._candidates.add(
            Candidate(
                steps=steps,
                updates=self._model._n_updates,
                rollouts=rollouts,
                parameters=copy.deepcopy(self._model.get_parameters()),
            )
        )

    def swim(self, seconds: float) -> None:
        """Let candidates swim until it is clear which is the best, the newest one first.

        seconds: how long this may take; one swim is made in any case

        The fish is paused before and afterwards. Raises `LinkLost`; earlier measurements are kept.
        """
        policy, self._swum = self._model.policy, []
        own = copy.deepcopy(policy.state_dict())
        self._env.resume()
        swims = Swims(self._env, self._stop)
        try:
            while (candidate := self._candidates.next()) and (
                not self._swum or swims.fits(seconds)
            ):
                policy.load_state_dict(candidate.parameters["policy"])
                swim = swims.swim(self._policy())
                self._swum.append(candidate)
                self._candidates.add_swim(candidate, swim)
        except Stopped:
            pass
        finally:
            policy.load_state_dict(own)
        self._env.pause()

    def results(self, steps: int) -> list[Evaluation]:
        """Return an evaluation of each policy that swam in the latest evaluation.

        The best policy is included, too, where it has changed.
        steps: number of steps that the training has learned from
        """
        best = self._candidates.best
        reported = {
            candidate.steps: candidate
            for candidate in self._swum
            if candidate.is_stalled or candidate.swims
        }
        if best and best is not self.best:
            reported[best.steps] = best
        rows = [self._row(candidate, steps, candidate is best) for candidate in reported.values()]
        self.best = best or self.best
        self._candidates.remove_unlikely()
        return rows

    def _policy(self) -> DeterministicPolicy:
        env = self._env
        return DeterministicPolicy(self._model.policy, env.perception, env.link.amplitude)

    def _row(self, candidate: Candidate, steps: int, best: bool) -> Evaluation:
        thrust = 0.0 if candidate.is_stalled else candidate.thrust
        return Evaluation(
            steps=steps,
            policy=candidate.steps,
            tank_time=self._env.tank_time,
            swim_time=candidate.swim_time,
            thrust=thrust,
            thrust_ci95=None if candidate.is_stalled else self._candidates.ci95(candidate),
            relative_thrust=thrust / self._env.best_thrust,
            frequency=candidate.frequency,
            fullness=candidate.fullness,
            is_stalled=candidate.is_stalled,
            best=best,
        )
