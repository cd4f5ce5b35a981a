"""Search for steps of the zero, outlying blocks, and a zero that follows swimming.

`fishd.lab.drift` averages over kinds of drift. Each of these disturbances is a regressor beside
them, with a Gaussian prior of its size and a prior probability. Every quantity below is one array
for all drifts (axis 0); adding a disturbance is a rank-one update of each, so that all candidates
(axis 1) can be evaluated at once.
"""

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core import text

Array = NDArray[np.float64]

RESPONSE_TIMES_S = (3.0, 6.0, 12.0, 24.0, 48.0)
"""Time constants of a zero that follows swimming, as candidates [s]."""
RESPONSE_ODDS = 3.0
"""Prior odds of a zero that follows swimming, for all time constants together."""
STEP_ODDS_PER_SECOND = 1 / 60
"""Prior odds of a step of the zero between two blocks, for each second between their middles."""
OUTLIER_ODDS = 0.01
"""Prior odds that a block is an outlier."""
NAMED_ODDS = 10.0
"""Smallest posterior odds of a disturbance that is reported; others count in the average only."""
PRIOR_SIZE = 15.0
"""Prior standard deviation of the size of a disturbance, over the standard deviation of a block."""
MAX_DISTURBANCES = 12
"""Largest number of disturbances in one fit."""
MIN_BLOCKS, BLOCKS_PER_DISTURBANCE = 11, 3
"""Smallest number of blocks beside the disturbances, and per disturbance; one swim has too few."""


class Kind(IntEnum):
    """Kinds of disturbance."""

    STEP = 0
    OUTLIER = 1
    RESPONSE = 2


class Disturbance(Struct, frozen=True):
    """A disturbance of the zero that a fit contains."""

    kind: str
    """`step`, `outlier` (of one block), or `response` (of the zero to swimming)."""
    size: float
    """Change of the force [N]; for a response, its limit in endless swimming."""
    time: float | None = None
    """Time since the first tick [s]; null for a response."""
    time_constant: float | None = None
    """Time constant of a response [s]; null for a step or an outlier."""


def spell(disturbances: Sequence[Disturbance], unit: str) -> str:
    """Return a description of disturbances, forces in thousandths of their unit; else empty."""
    unit = f"m{text.quoted(unit)}"
    clauses = []
    steps = [disturbance for disturbance in disturbances if disturbance.kind == "step"]
    if len(steps) == 1:
        clauses.append(
            f"the zero stepped by {1e3 * steps[0].size:+.1f} {unit} at {steps[0].time:.1f} s"
        )
    elif steps:
        largest = max(abs(disturbance.size) for disturbance in steps)
        clauses.append(f"the zero stepped {len(steps)} times, by up to {1e3 * largest:.1f} {unit}")
    outliers = [
        abs(disturbance.size) for disturbance in disturbances if disturbance.kind == "outlier"
    ]
    if outliers:
        count = (
            "1 beat or piece of a rest"
            if len(outliers) == 1
            else f"{len(outliers)} beats or pieces of a rest"
        )
        clauses.append(f"{count} far off, by up to {1e3 * max(outliers):.1f} {unit}")
    clauses += [
        f"the zero follows swimming, by {1e3 * disturbance.size:+.1f} {unit} "
        f"with a time constant of about {disturbance.time_constant:g} s"
        for disturbance in disturbances
        if disturbance.kind == "response"
    ]
    return ", ".join(clauses)


class Candidates(NamedTuple):
    """All disturbances that a fit may contain; their number is c."""

    columns: Array
    """Force that each candidate adds for a size of 1; n×c."""
    kinds: Array
    """Kind of each candidate."""
    log_odds: Array
    """Logarithm of the prior odds of each candidate."""


def candidates(time: Array, responses: Array) -> Candidates:
    """Return a step at each boundary of blocks, an outlier at each block, and the responses.

    time: middle of each block [s]
    responses: n×k, for the last k of `RESPONSE_TIMES_S`
    """
    n, kinds = len(time), responses.shape[1]
    columns = np.concatenate((np.tri(n, n, -1)[:, :-1], np.eye(n), responses), axis=1)
    odds = (
        STEP_ODDS_PER_SECOND * np.diff(time),
        np.full(n, OUTLIER_ODDS),
        np.full(kinds, RESPONSE_ODDS / len(RESPONSE_TIMES_S)),
    )
    kind = np.repeat([Kind.STEP, Kind.OUTLIER, Kind.RESPONSE], [n - 1, n, kinds])
    return Candidates(columns, kind, np.log(np.concatenate(odds)))


class _State(NamedTuple):
    """The fit with a set of disturbances for m drifts, and the effect of each of c candidates."""

    chosen: tuple[int, ...]
    pull: Array
    """Product of each candidate with the weighted residuals; m×c."""
    weight: Array
    """Sum of the weights of each candidate beside all other regressors; m×c."""
    share: Array
    """Coefficient of swimming in a regression of each candidate; m×c."""
    left: Array
    """Weighted sum of the squared residuals [N²]; m."""
    evidence: Array
    """Logarithm of the probability without the factor of the residuals; m."""
    force: Array
    """Force that swimming adds [N]; m."""
    relative_variance: Array
    """Variance of `force` over that of a block; m."""
    used: tuple[tuple[Array, Array], ...]
    """Products with all candidates, and the weight, of each chosen candidate."""


class Mixture(NamedTuple):
    """A set of fits, one for each drift or for each drift and candidate."""

    log_probability: Array
    """Logarithm of the probability."""
    force: Array
    """Force that swimming adds [N]."""
    variance: Array
    """Variance of `force` [N²]."""


class Search:
    """The search for a set of disturbances, and the average over the sets near it."""

    def __init__(
        self,
        precision: Array,
        evidence: Array,
        force: Array,
        swims: Array,
        known: Candidates,
        variance: float,
    ) -> None:
        """Prepare the fit without a disturbance.

        precision: m×n×n, inverse covariance of the forces over the variance of a block, with
            level and trend projected out
        evidence: logarithm of the probability of each drift without the factor of the residuals; m
        force: mean force in each block [N]; n
        swims: 1 where the fish swam, else 0; n
        variance: variance of a block, from the differences of neighbours, which counts as one
            degree of freedom [N²]
        """
        self._precision = precision
        self._force, self._swims, self._candidates = force, swims, known
        self._variance = variance
        self._degrees = len(force) - 2
        self._limit = min(MAX_DISTURBANCES, (len(force) - MIN_BLOCKS) // BLOCKS_PER_DISTURBANCE)
        pulled, pulled_swims = precision @ force, precision @ swims
        self._pulled = pulled
        self._information = pulled_swims @ swims
        self._crossed = pulled_swims @ known.columns
        of_swims = (pulled @ swims) / self._information
        share = self._crossed / self._information[:, np.newaxis]
        self._columns: dict[int, Array] = {}
        self._empty = _State(
            chosen=(),
            pull=pulled @ known.columns - self._crossed * of_swims[:, np.newaxis],
            weight=self._weights() - self._crossed * share,
            share=share,
            left=np.maximum(pulled @ force - of_swims**2 * self._information, 0.0) + variance,
            evidence=evidence - 0.5 * np.log(self._information),
            force=of_swims,
            relative_variance=1.0 / self._information,
            used=(),
        )

    def _weights(self) -> Array:
        """Return the quadratic form of each candidate with the precision; m×c.

        For a step, this is the sum over the rows and columns after it.
        """
        precision, n = self._precision, len(self._force)
        diagonal = np.diagonal(precision, axis1=1, axis2=2)
        beyond = (precision * np.tri(n, n, -1).T).sum(axis=2)
        steps = np.cumsum((diagonal + 2.0 * beyond)[:, ::-1], axis=1)[:, -2::-1]
        responses = self._candidates.columns[:, 2 * n - 1 :]
        forms = ((precision @ responses) * responses).sum(axis=1)
        return np.concatenate((steps, diagonal, forms), axis=1)

    def _column(self, candidate: int) -> Array:
        """Return the products of a candidate with all candidates, swimming projected out; m×c."""
        if candidate not in self._columns:
            columns = self._candidates.columns
            products = self._precision @ columns[:, candidate] @ columns
            share = self._crossed[:, candidate] / self._information
            self._columns[candidate] = products - self._crossed * share[:, np.newaxis]
        return self._columns[candidate]

    def _added(self, state: _State, candidate: int) -> _State:
        """Return the fit with one more disturbance."""
        column = self._column(candidate)
        for used, weight in state.used:
            column = column - used * (used[:, candidate] / weight)[:, np.newaxis]
        weight = np.maximum(state.weight[:, candidate], 0.0) + PRIOR_SIZE**-2
        size, share = state.pull[:, candidate] / weight, state.share[:, candidate]
        return _State(
            chosen=(*state.chosen, candidate),
            pull=state.pull - column * size[:, np.newaxis],
            weight=state.weight - column**2 / weight[:, np.newaxis],
            share=state.share - column * (share / weight)[:, np.newaxis],
            left=np.maximum(state.left - state.pull[:, candidate] * size, self._variance),
            evidence=state.evidence
            - 0.5 * np.log(weight * PRIOR_SIZE**2)
            + self._candidates.log_odds[candidate],
            force=state.force - share * size,
            relative_variance=state.relative_variance + share**2 / weight,
            used=(*state.used, (column, weight)),
        )

    def _state(self, chosen: Sequence[int]) -> _State:
        state = self._empty
        for candidate in chosen:
            state = self._added(state, candidate)
        return state

    def _mixture(self, state: _State) -> Mixture:
        """Return the fits with these disturbances, one for each drift."""
        scale = state.left / max(1, self._degrees - 2)
        log_probability = state.evidence - 0.5 * self._degrees * np.log(state.left)
        return Mixture(log_probability, state.force, scale * state.relative_variance)

    def _additions(self, state: _State, barred: Sequence[int] = ()) -> Mixture:
        """Return the fits with one more disturbance, one for each drift and candidate.

        barred: candidates that are excluded, beside those of `state` and a second response
        """
        kinds = self._candidates.kinds
        weight = np.maximum(state.weight, 0.0) + PRIOR_SIZE**-2
        left = np.maximum(state.left[:, np.newaxis] - state.pull**2 / weight, self._variance)
        log_probability = (
            state.evidence[:, np.newaxis]
            - 0.5 * np.log(weight * PRIOR_SIZE**2)
            + self._candidates.log_odds
            - 0.5 * self._degrees * np.log(left)
        )
        log_probability[:, [*state.chosen, *barred]] = -np.inf
        if any(kinds[candidate] == Kind.RESPONSE for candidate in state.chosen):
            log_probability[:, kinds == Kind.RESPONSE] = -np.inf
        return Mixture(
            log_probability,
            state.force[:, np.newaxis] - state.share * state.pull / weight,
            left
            / max(1, self._degrees - 2)
            * (state.relative_variance[:, np.newaxis] + state.share**2 / weight),
        )

    def find(self) -> tuple[int, ...]:
        """Return a set of candidates that no change of a single candidate makes more probable."""
        chosen: tuple[int, ...] = ()
        best = _log_sum(self._mixture(self._empty).log_probability)
        while True:
            sets = list(self._extended(chosen))
            if not sets or max(sets)[0] <= best:
                for candidate in chosen:
                    fewer = tuple(index for index in chosen if index != candidate)
                    sets.append(
                        (_log_sum(self._mixture(self._state(fewer)).log_probability), fewer)
                    )
                    sets += self._extended(fewer)
            if not sets or max(sets)[0] <= best + 1e-6:
                return chosen
            best, chosen = max(sets)

    def _extended(self, chosen: tuple[int, ...]) -> Iterator[tuple[float, tuple[int, ...]]]:
        """Yield the most probable set with one more candidate, after its log-probability."""
        if len(chosen) < self._limit:
            log_probability = self._additions(self._state(chosen)).log_probability
            candidate = int(log_probability.max(axis=0).argmax())
            sums = _log_sum(log_probability[:, candidate])
            yield sums, (*chosen, candidate)

    def odds(self, chosen: Sequence[int], candidate: int) -> float:
        """Return the ratio of the probability of a set to that without one of its disturbances."""
        fewer = [item for item in chosen if item != candidate]
        both = (
            _log_sum(self._mixture(self._state(item)).log_probability) for item in (chosen, fewer)
        )
        return float(np.exp(min(700.0, next(both) - next(both))))

    def is_full(self, chosen: Sequence[int]) -> bool:
        """Return whether a set has the largest possible number of disturbances."""
        return len(chosen) >= self._limit > 0

    def average(self, chosen: Sequence[int]) -> tuple[float, float]:
        """Return mean force [N] and variance [N²] over this set and all sets that differ by one."""
        full = self._state(chosen)
        parts = [self._mixture(full)]
        if len(chosen) < self._limit:
            parts.append(self._additions(full))
        for candidate in chosen:
            fewer = self._state([item for item in chosen if item != candidate])
            parts += [self._mixture(fewer), self._additions(fewer, [candidate])]
        log_probability, force, variance = (
            np.concatenate([item.ravel() for item in arrays]) for arrays in zip(*parts, strict=True)
        )
        weight = np.exp(log_probability - log_probability.max())
        weight /= weight.sum()
        mean = float(weight @ force)
        return mean, float(weight @ (variance + (force - mean) ** 2))

    def explain(self, chosen: Sequence[int], noise: Array) -> tuple[Array, Array]:
        """Return the sizes of disturbances, and the force of each block without thrust, noise and
        outliers [N].

        noise: variance of each block over that of an average one
        """
        known, index = self._candidates, list(chosen)
        log_probability = self._mixture(self._state(chosen)).log_probability
        weight = np.exp(log_probability - log_probability.max())
        weight /= weight.sum()
        columns = np.column_stack((self._swims, known.columns[:, index]))
        crossed = self._precision @ columns
        ridge = np.diag([0.0, *[PRIOR_SIZE**-2] * len(index)])
        sizes = np.linalg.solve(
            columns.T @ crossed + ridge, (self._pulled @ columns)[..., np.newaxis]
        )
        residual = weight @ (self._pulled - (crossed @ sizes)[..., 0])
        mean = weight @ sizes[..., 0]
        gone = [0, *(1 + np.flatnonzero(known.kinds[index] == Kind.OUTLIER))]
        return mean[1:], self._force - columns[:, gone] @ mean[gone] - noise * residual


def _log_sum(log_probability: Array) -> float:
    """Return the logarithm of the sum of these probabilities."""
    highest = float(log_probability.max())
    return highest + float(np.log(np.exp(log_probability - highest).sum()))
