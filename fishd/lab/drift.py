"""The force that swimming adds while the sensor drifts, separated from the drift by rests.

The force is measured in blocks, while the fish swims and while it rests. What swimming adds is
fitted by generalised least squares beside a level, a trend, and a drift of unknown kind and
strength: a random walk, and a smooth Gaussian process, which together follow most that sensors do.
Kinds and strengths are not chosen but averaged over, each weighed by its restricted likelihood
(REML; Patterson & Thompson, Biometrika 58 (1971) 545; Gaussian processes: Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, section 2.7).

Three kinds of disturbance that no such drift describes are searched for: a step of the zero
between two blocks, a block that is far off, and a zero that follows swimming like a first-order
system. Each is a regressor with a Gaussian prior of its size and a prior probability. The set of
disturbances is built by adding or exchanging one at a time while that makes the whole more
probable; the result is averaged over that set and all sets that differ from it by one disturbance.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WALKS = (0.0, 0.01, 0.1, 1.0, 10.0)
"""Variances of the random walk after a second, over that of a block, that are tried."""
TIMES = (2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 40.0)
"""Correlation times of the smooth drift that are tried [s]."""
STRENGTHS = tuple(10.0**exponent for exponent in range(-1, 6))
"""Variances of the smooth drift, over that of a block, that are tried."""
LEAST_BLOCKS = 6
"""Fewer say nothing about a drift."""

RESPONSE_TIMES_S = (3.0, 6.0, 12.0, 24.0, 48.0)
"""Time constants of a zero that follows swimming that are tried [s]."""
RESPONSE_PROBABILITY = 3.0
STEPS_PER_SECOND = 1 / 60
"""Expected rate of steps of the zero before the force is seen [1/s]."""
OUTLIER_PROBABILITY = 0.01
SIZE = 15.0
"""Prior standard deviation of the size of a disturbance, over that of a block."""
MAX_DISTURBANCES = 12


class Blocks(NamedTuple):
    """Means of the force over short times, one after the other; arrays of n."""

    time: Array
    """The middle of each [s]."""
    force: Array
    """Mean force in it [N]."""
    variance: Array
    """What that varies by, drift aside, up to a common factor."""
    swims: NDArray[np.bool_]
    """Did the fish swim? It rested where not."""
    responses: Array | None = None
    """n×k"""


class Fit(NamedTuple):
    """What swimming adds to the force, and the drift below it."""

    force: float
    """[N]"""
    error: float
    """Half of the 95 % interval [N]."""
    drift: Array
    """The force without swimming, block by block [N]."""
    steps: float = 0.0
    outliers: float = 0.0
    response: float = 0.0
    chosen: tuple = ()


class _State(NamedTuple):
    """All drifts (m) with a set of disturbances; and candidates (c)."""

    chosen: tuple[int, ...]
    u: Array
    d: Array
    k: Array
    """Coefficient of swimming in a regression of the candidate."""
    left: Array
    weight: Array
    force: Array
    unsure: Array
    used: tuple[tuple[Array, Array, int], ...]


class _Search:
    def __init__(self, blocks: Blocks) -> None:
        time, force, variance, swims, responses = blocks
        n = len(time)
        self.n = n
        seconds = time - time[0]
        noise = np.diag(variance / variance.mean())
        base = np.column_stack((np.ones(n), seconds - seconds.mean()))
        self.degrees = n - 3
        self.responses = np.empty((n, 0)) if responses is None else responses
        nr = self.responses.shape[1]
        V = np.concatenate([noise + w for w in _covariances(seconds)])
        self.wander = V
        factor = np.linalg.cholesky(V)
        logdet = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        inv = np.linalg.inv(V)
        left = inv @ base
        info = base.T @ left
        self.P = P = inv - left @ np.linalg.solve(info, left.swapaxes(1, 2))
        self.base_weight = -logdet - 0.5 * np.linalg.slogdet(info)[1]
        gaps = np.diff(time)
        self.prior = np.log(np.concatenate((
            gaps * STEPS_PER_SECOND, np.full(n, OUTLIER_PROBABILITY),
            np.full(nr, RESPONSE_PROBABILITY / max(1, nr)))))
        # what candidates are
        H = np.concatenate((np.tri(n, n, -1)[:, :-1], np.eye(n), self.responses), axis=1)
        self.H = H
        Py = P @ force
        Pt = P @ swims.astype(float)
        self.yPy = Py @ force
        self.tPt = Pt @ swims
        self.ty = Pt @ force
        self.u0 = self.project(Py)
        self.t0 = self.project(Pt)
        upper = (P * np.tri(n, n, -1).T).sum(axis=2)
        diag = np.diagonal(P, axis1=1, axis2=2)
        steps = np.cumsum((diag + 2 * upper)[:, ::-1], axis=1)[:, ::-1][:, 1:]
        PR = P @ self.responses
        self.d0 = np.concatenate((steps, diag, (PR * self.responses).sum(axis=1)), axis=1)
        self.columns: dict[int, Array] = {}
        t = self.t0
        self.empty = _State(
            (), self.u0 - t * (self.ty / self.tPt)[:, None], self.d0 - t**2 / self.tPt[:, None],
            t / self.tPt[:, None], self.yPy - self.ty**2 / self.tPt,
            self.base_weight - 0.5 * np.log(self.tPt), self.ty / self.tPt, 1 / self.tPt, ())
        self.kind = np.array([0] * (n - 1) + [1] * n + [2] * nr)

    def project(self, v: Array) -> Array:
        s = np.cumsum(v[:, ::-1], axis=1)[:, ::-1][:, 1:]
        return np.concatenate((s, v, v @ self.responses), axis=1)

    def column(self, c: int) -> Array:
        if c not in self.columns:
            v = self.P @ self.H[:, c]
            g = self.project(v)
            self.columns[c] = g - self.t0 * (self.t0[:, c] / self.tPt)[:, None]
        return self.columns[c]

    def add(self, s: _State, c: int) -> _State:
        g = self.column(c)
        for gr, dr, r in s.used:
            g = g - gr * (gr[:, c] / dr)[:, None]
        d = s.d[:, c] + 1 / SIZE**2
        a = s.u[:, c] / d
        return _State(
            (*s.chosen, c), s.u - g * a[:, None], s.d - g**2 / d[:, None],
            s.k - g * (s.k[:, c] / d)[:, None], s.left - s.u[:, c] * a,
            s.weight - 0.5 * np.log(d * SIZE**2) + self.prior[c], s.force - s.k[:, c] * a,
            s.unsure + s.k[:, c] ** 2 / d, (*s.used, (g, d, c)))

    def of(self, chosen: Sequence[int]) -> _State:
        s = self.empty
        for c in chosen:
            s = self.add(s, c)
        return s

    def likely(self, s: _State) -> Array:
        return s.weight - 0.5 * self.degrees * np.log(s.left)

    def additions(self, s: _State):
        d = np.maximum(s.d, 0) + 1 / SIZE**2
        a = s.u / d
        left = s.left[:, None] - s.u * a
        w = s.weight[:, None] - 0.5 * np.log(d * SIZE**2) + self.prior - 0.5 * self.degrees * np.log(left)
        barred = list(s.chosen)
        if any(self.kind[c] == 2 for c in s.chosen):
            barred += list(np.flatnonzero(self.kind == 2))
        w[:, barred] = -1e9
        return w, left, s.force[:, None] - s.k * a, s.unsure[:, None] + s.k**2 / d


def lse(w, axis=None):
    m = w.max(axis=axis, keepdims=True)
    return np.squeeze(m, axis) + np.log(np.exp(w - m).sum(axis=axis)) if axis is not None else m.max() + math.log(np.exp(w - m.max()).sum())


def fit(blocks: Blocks) -> Fit:
    """What swimming adds to the force, with an interval that knows what the drift may have done.

    Raises ValueError for fewer than `LEAST_BLOCKS` blocks, or without both swimming and rest.
    """
    time, force, variance, swims, responses = blocks
    n = len(time)
    if n < LEAST_BLOCKS or swims.all() or not swims.any():
        raise ValueError("blocks of swimming and of rest are needed, six at least")
    S = _Search(blocks)
    limit = min(MAX_DISTURBANCES, (n - 3) // 4)
    chosen: tuple[int, ...] = ()
    best = lse(S.likely(S.empty))
    for _ in range(4 * limit):
        # additions, and exchanges
        options = []
        if len(chosen) < limit:
            sc = lse(S.additions(S.of(chosen))[0], 0)
            c = int(sc.argmax()); options.append((sc[c], (*chosen, c)))
        if not options or options[0][0] <= best:
            for drop in chosen:
                rest = tuple(c for c in chosen if c != drop)
                st = S.of(rest)
                options.append((lse(S.likely(st)), rest))
                sc = lse(S.additions(st)[0], 0)
                c = int(sc.argmax()); options.append((sc[c], (*rest, c)))
        if not options: break
        top = max(options)
        if top[0] <= best + 1e-9: break
        best, chosen = top
    # average
    ws, fs, vs, sets = [], [], [], []
    def take(w, left, f, v):
        ws.append(w.ravel()); fs.append(f.ravel()); vs.append((v * left / S.degrees * S.degrees / max(1, S.degrees - 2)).ravel())
    full = S.of(chosen)
    take(S.likely(full), full.left, full.force, full.unsure)
    if len(chosen) < limit: take(*S.additions(full))
    for drop in chosen:
        st = S.of([c for c in chosen if c != drop])
        take(S.likely(st), st.left, st.force, st.unsure)
        w, *rest = S.additions(st)
        w[:, drop] = -1e9
        take(w, *rest)
    w = np.concatenate(ws); f = np.concatenate(fs); v = np.concatenate(vs)
    w = np.exp(w - w.max()); w /= w.sum()
    mean = float(w @ f)
    spread = float(w @ (v + (f - mean) ** 2))
    kinds = [S.kind[c] for c in chosen]
    return Fit(mean, 1.96 * spread**0.5, np.zeros(n), kinds.count(0), kinds.count(1), kinds.count(2), chosen)


def _covariances(seconds: Array) -> Iterator[Array]:
    """Of all drifts that are tried, at these times; over the variance of a block.

    Several at once, shape (·, n, n), since numpy takes as long to be called as for a small matrix.
    Each counts as much as any other before the forces are seen: a kind that is added here with n
    strengths counts n times.
    """
    walk = np.minimum.outer(seconds, seconds)
    gap = np.subtract.outer(seconds, seconds)
    for time in TIMES:
        smooth = np.exp(-0.5 * (gap / time) ** 2)
        for strength in STRENGTHS:
            yield np.multiply.outer(WALKS, walk) + strength * smooth
