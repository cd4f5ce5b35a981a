"""One step of a finite-element flow solver, to compare the swimmer's cost with.

Taylor–Hood elements (P2 for the velocity, P1 for the pressure) of scikit-fem on the tank, backward
Euler, iterations of Picard, each assembled and solved directly with SuperLU.
"""

import importlib.util
import time
from typing import NamedTuple

import numpy as np
from scipy.sparse import bmat
from scipy.sparse.linalg import splu

NU, STEP = 1e-6, 1e-3
TOLERANCE = 1e-6
"""Relative change of the velocity at which the iteration ends."""


class ElementStep(NamedTuple):
    """Duration of a step."""

    unknowns: int
    iterations: int
    solve_seconds: float
    """Shortest time of an iteration, including assembly [s]."""
    assembly_seconds: float
    """Time of the assembly [s]."""


def element_step(unknowns: int) -> ElementStep:
    """Measure a step with about `unknowns` unknowns, from a field of vortices of 0.3 m/s."""
    if importlib.util.find_spec("skfem") is None:
        raise SystemExit(
            "tools/bench swimmer speed compares with scikit-fem: pip install scikit-fem"
        )
    from skfem import Basis, BilinearForm, ElementTriP1, ElementTriP2, ElementVector, MeshTri
    from skfem.helpers import ddot, div, dot, grad, mul

    rows = round((unknowns / 9 / 2.5) ** 0.5)  # nine unknowns for each pair of triangles
    mesh = MeshTri.init_tensor(
        np.linspace(0.0, 1.0, round(2.5 * rows) + 1), np.linspace(0.0, 0.2, rows + 1)
    )
    velocity = Basis(mesh, ElementVector(ElementTriP2()), intorder=4)
    pressure = velocity.with_element(ElementTriP1())

    @BilinearForm
    def momentum(u, v, w):  # type: ignore[no-untyped-def]
        return dot(u, v) / STEP + NU * ddot(grad(u), grad(v)) + dot(mul(grad(u), w["wind"]), v)

    @BilinearForm
    def mass(u, v, w):  # type: ignore[no-untyped-def]
        return dot(u, v) / STEP

    @BilinearForm
    def continuity(u, q, w):  # type: ignore[no-untyped-def]
        return -div(u) * q

    B = continuity.assemble(velocity, pressure)
    M = mass.assemble(velocity)
    size = velocity.N + pressure.N
    walls = velocity.get_dofs(lambda x: np.isclose(x[0], 0.0) | (np.abs(x[1] - 0.1) > 0.0999))
    free = np.setdiff1d(np.arange(size), walls.all())
    begin = velocity.project(
        lambda x: 0.3 * np.stack(
            [
                np.sin(20 * np.pi * x[0]) * np.cos(10 * np.pi * x[1]),
                -2.0 * np.cos(20 * np.pi * x[0]) * np.sin(10 * np.pi * x[1]),
            ]
        )
    )  # fmt: skip
    load = np.concatenate([M @ begin, np.zeros(pressure.N)])
    u, times = begin, []
    for _ in range(20):
        begun = time.perf_counter()
        A = momentum.assemble(velocity, wind=velocity.interpolate(u))
        system = bmat([[A, B.T], [B, None]], format="csc")[free][:, free]
        assembled = time.perf_counter()
        solution = np.zeros(size)
        solution[free] = splu(system.tocsc()).solve(load[free])
        times.append((time.perf_counter() - begun, assembled - begun))
        before, u = u, solution[: velocity.N]
        if np.abs(u - before).max() <= TOLERANCE * np.abs(u).max():
            break
    best = min(times)
    return ElementStep(size, len(times), *best)
