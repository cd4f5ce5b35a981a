"""Evaluations in the tank: short swims of the newest policy and of other candidates."""

import copy
from collections.abc import Callable

from stable_baselines3 import PPO

from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.swims import Stopped, Swims
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.train.candidates import Candidate, Candidates


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
            if candidate.stalled or candidate.swims
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
        thrust = 0.0 if candidate.stalled else candidate.thrust
        return Evaluation(
            steps=steps,
            policy=candidate.steps,
            tank_time=self._env.tank_time,
            swam=candidate.swam,
            thrust=thrust,
            error=None if candidate.stalled else self._candidates.ci95(candidate),
            relative_thrust=thrust / self._env.best_thrust,
            frequency=candidate.frequency,
            fullness=candidate.fullness,
            stalled=candidate.stalled,
            best=best,
        )
