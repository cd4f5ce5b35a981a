"""Free swimmer by finite elements on triangles that move with its body, a second method.

Only the water differs from `fishd.virtual.swimmer`; beam, muscles and mass are the same. With the
velocity w of the mesh (arbitrary Lagrangian–Eulerian; Donea, Huerta, Ponthot and Rodríguez-Ferran,
Encyclopedia of Computational Mechanics, 2004, chapter 14), the flow is

    ∂u/∂t + ((u − w)·∇) u = −∇p/ρ + 2ν ∇·ε(u),    ∇·u = 0

where ∂u/∂t is at a point of the mesh. The elements are those of Taylor and Hood (quadratic u,
linear p), with streamline diffusion (Brooks and Hughes, Comput. Methods Appl. Mech. Eng. 32, 1982,
doi:10.1016/0045-7825(82)90071-8) and a penalty on ∇·u. Time steps are backward differences of
second order, with u − w extrapolated.

On the body u = J(q) q̇ with the rates q̇ of the beam as unknowns, and the sum of the equations
there, weighted by J, is the force on the beam. Water and beam are one linear system, so that a body
as light as water is stable.
"""

from collections.abc import Callable

import ngsolve as ng
import numpy as np
import scipy.sparse as sp
from msgspec.structs import replace
from netgen.geom2d import SplineGeometry
from scipy.sparse.linalg import LinearOperator, gmres, splu

from fishd.virtual.swimmer.body import build_beam, curvature, half_thickness
from fishd.virtual.swimmer.fish import FRONT_FRACTION, REAR_FRACTION
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings

BUBBLE = -0.125
"""Value of the quadratic shape function of an edge in the middle of the edge, in NGSolve."""
GRAD_DIV = 1e-3
"""Factor of the penalty on ∇·u [m²/s]."""
MAX_ITERATIONS = 9
"""Number of iterations of GMRES above which the matrix is factorised again."""
TOLERANCE = 1e-5
"""Error of the solution of a step, relative to the solution."""
HEAD_SIZE, TAIL_SIZE = 0.5, 0.25
"""Length of the edges at the head and at the tail, relative to the middle of the body."""
WAKE_SIZE, FAR_SIZE = 2.5, 15.0
"""Largest edges in the water near body and wake, and elsewhere, relative to those of the body."""
LAYER, LAYER_REACH = 0.3, 0.2
"""Thickness of the elements at the skin relative to triangles of equal sides, and the distance over
which this returns to 1 [body lengths]."""
SHIFT, TURN, AHEAD = (0.1, 0.98), (0.0, 0.13), (0.1, 1.5)
"""Distances over which the mesh stops to follow the body: its shift, by |Y|, and its turn, by the
distance from the skin [half widths of the tank], and both before the head and behind the tail [body
lengths]."""
RELAX = 0.6
"""Distance over which the continued midline turns back to the x-axis [body lengths]."""


def build_mesh(settings: SwimmerSettings, size: float) -> ng.Mesh:
    """Return triangles around the straight body, whose head is at the origin.

    size: length of the edges in the middle of the body [m]
    """
    body, water = settings.body, settings.water
    length = body.length
    fine = np.linspace(0.0, length, 4001)
    at_head = HEAD_SIZE + (1.0 - HEAD_SIZE) * fine / (0.2 * length)
    at_tail = TAIL_SIZE + (1.0 - TAIL_SIZE) * (length - fine) / (0.3 * length)
    edges = 1.0 / (size * np.minimum(1.0, np.minimum(at_head, at_tail)))
    count = np.concatenate([[0.0], np.cumsum(0.5 * (edges[1:] + edges[:-1]) * np.diff(fine))])
    X = np.interp(np.linspace(0.0, count[-1], int(np.ceil(count[-1])) + 1), count, fine)
    Y = half_thickness(body, X)
    geometry = SplineGeometry()

    def add(
        corners: list[tuple[float, float]], names: list[str], inside: int, outside: int
    ) -> None:
        points = [geometry.AppendPoint(*corner) for corner in corners]
        for a, b, name in zip(points, points[1:] + points[:1], names, strict=True):
            geometry.Append(["line", a, b], leftdomain=inside, rightdomain=outside, bc=name)

    def box(left: float, right: float, high: float) -> list[tuple[float, float]]:
        return [(left, -high), (right, -high), (right, high), (left, high)]

    outline = [*zip(X, -Y, strict=True), *zip(X[-2:0:-1], Y[-2:0:-1], strict=True)]
    add(outline, ["body"] * len(outline), 0, 1)
    add(box(-0.1 * length, 2.2 * length, 0.3 * length), ["inside"] * 4, 1, 2)
    left = 0.5 * (length - water.length)
    tank = box(left, left + water.length, 0.5 * water.width)
    add(tank, ["side", "outlet", "side", "inlet"], 2, 0)
    geometry.SetDomainMaxH(1, WAKE_SIZE * size)
    geometry.SetDomainMaxH(2, FAR_SIZE * size)
    return ng.Mesh(geometry.GenerateMesh(maxh=water.length, grading=0.25))


class BodyFitted:
    """Fish that begins at rest in a tank that travels with it; `step` advances it.

    Velocities and motion of the mesh are coefficients of the shape functions of NGSolve: those
    along x of vertices and edges, then those along y.
    """

    def __init__(self, settings: SwimmerSettings, size: float, dt: float) -> None:
        """settings: steering is ignored; size: see `build_mesh`; dt: time step [s]"""
        body, water = settings.body, settings.water
        self.dt, self._density, self._nu = dt, water.density, water.viscosity
        # The whole mass: here no water is inside the body.
        heavy = replace(body, excess_density=body.excess_density + water.density)
        self.beam = build_beam(replace(settings, body=heavy))
        self.drive = self.beam.drive(lambda X: curvature(settings, X))
        self._half_width = 0.5 * water.width
        mesh = build_mesh(settings, size)
        self.V = ng.VectorH1(mesh, order=2, dirichletx="inlet", dirichlety="side|inlet")
        self.space = self.V * ng.H1(mesh, order=1)
        self._find_nodes(mesh, settings)
        fields = [ng.GridFunction(self.V) for _ in range(4)]
        self._moved, self._convecting, self._stream, self._past = fields
        mesh.SetDeformation(self._moved)
        self._set_up_forms()
        size_ = self.beam.size
        self.state = {
            "q": np.zeros((2, size_)),
            "rate": np.zeros((2, size_)),
            "velocity": np.zeros((2, self.beam.slices, 3)),
            "u": np.zeros((2, self.V.ndof)),
            "moved": np.zeros((2, self.V.ndof)),
            "p": np.zeros((2, self.space.ndof - self.V.ndof)),
        }
        """Unknowns of the beam and their rates, velocities of its slices and of the water, motion
        of the mesh, and pressure over density: now, and a step ago."""
        self.steps, self.work = 0, 0.0
        self._factors: splu | None = None

    def _find_nodes(self, mesh: ng.Mesh, settings: SwimmerSettings) -> None:
        """Find vertices and middles of edges, with thin elements at the skin of the body."""
        vertices = np.array([vertex.point for vertex in mesh.vertices])
        self._ends = np.array([[vertex.nr for vertex in edge.vertices] for edge in mesh.edges])
        self._flat = np.concatenate([vertices, vertices[self._ends].mean(axis=1)])
        """Places of the nodes in the mesh that NGSolve deforms."""
        spans = np.linalg.norm(vertices[self._ends[:, 0]] - vertices[self._ends[:, 1]], axis=1)
        both = self._ends.ravel()
        around = np.bincount(both, np.repeat(spans, 2)) / np.bincount(both)
        self._size = np.concatenate([around, spans])
        X, Y = self._flat.T
        on_body = np.array(list(self.V.GetDofs(mesh.Boundaries("body"))))[: len(X)]
        body, length = settings.body, settings.body.length
        inside = half_thickness(body, np.clip(X, 0.0, length))
        beside = np.where(on_body, 0.0, np.maximum(0.0, np.abs(Y) - inside))
        beside *= 1.0 - (1.0 - LAYER) * fade(beside, (0.0, LAYER_REACH * length))
        self._beside, self._at, self._off = beside, X, np.sign(Y) * (inside + beside)
        beam = self.beam
        self._skin = np.flatnonzero(on_body)
        at = X[self._skin, None]
        self._reach = np.clip(at - (beam.X - 0.5 * beam.spacing), 0.0, beam.spacing)
        """Length of each slice of the beam before the nodes of the skin [m]."""
        knots = np.arange(beam.segments + 1) * length / beam.segments
        self._skin_hats, self._hats = (
            np.clip(1.0 - np.abs(x - knots) * beam.segments / length, 0.0, None)
            for x in (at, beam.X[:, None])
        )
        self._on_body = np.concatenate([self._skin, len(X) + self._skin])
        free = np.array(list(self.space.FreeDofs()))
        free[self._on_body] = False
        self._free = np.flatnonzero(free)

    def _set_up_forms(self) -> None:
        """Define the integrals; the first coefficient of the backward difference is a parameter."""
        (u, p), (v, q) = self.space.TnT()
        self._first = ng.Parameter(1.0)
        dx = ng.dx(intrules={ng.ET.TRIG: ng.IntegrationRule(ng.ET.TRIG, 5)})
        along = ng.Grad(v) * self._stream
        self._form, self._right = ng.BilinearForm(self.space), ng.LinearForm(self.space)
        # The sum as one integral takes three times as long.
        for part in (
            ng.InnerProduct(self._first * u + ng.Grad(u) * self._convecting, v + along),
            ng.InnerProduct(ng.grad(p), along),
            2.0 * self._nu * ng.InnerProduct(ng.Sym(ng.Grad(u)), ng.Sym(ng.Grad(v))),
            GRAD_DIV * ng.div(u) * ng.div(v) - p * ng.div(v) - q * ng.div(u),
        ):
            self._form += part * dx
        self._right += -ng.InnerProduct(self._past, v + along) * dx

    def step(self, activation: float) -> None:
        """Advance by one step with this activation of the muscles."""
        state, first = self.state, self.steps == 0
        c = np.array([1.0, -1.0, 0.0] if first else [1.5, -2.0, 0.5]) / self.dt
        self._first.Set(c[0])
        past = {name: c[1] * values[0] + c[2] * values[1] for name, values in state.items()}
        new = {name: values[0] + (values[0] - values[1]) for name, values in state.items()}
        new["q"] = (new["rate"] - past["q"]) / c[0]
        new["moved"] = self._move(new["q"])
        relative = new["u"] - (c[0] * new["moved"] + past["moved"])
        for field, values in (
            (self._moved, new["moved"]),
            (self._convecting, relative),
            (self._stream, self._delay(c[0], relative)),
            (self._past, past["u"]),
        ):
            field.vec.FV().NumPy()[:] = values
        self._solve(c[0], past, new, activation)
        new["q"] = (new["rate"] - past["q"]) / c[0]
        for name, values in state.items():
            values[1], values[0] = values[0], new[name]
        self.work += self.dt * activation * float(self.drive @ new["rate"])
        self.steps += 1

    def _coefficients(self, values: Array) -> Array:
        """Return the coefficients of values at the nodes; shape (nodes, columns), as the result."""
        vertices = len(values) - len(self._ends)
        middles = values[vertices:] - 0.5 * values[self._ends].sum(axis=1)
        return np.concatenate([values[:vertices], middles / BUBBLE])

    def _delay(self, first: float, relative: Array) -> Array:
        """Return the velocity times the time scale of streamline diffusion (Tezduyar, Adv. Appl.
        Mech. 28, 1991, doi:10.1016/S0065-2156(08)70153-4)."""
        v = relative.reshape(2, -1).T.copy()
        vertices = len(v) - len(self._ends)
        v[vertices:] = BUBBLE * v[vertices:] + 0.5 * v[self._ends].sum(axis=1)
        square = 16.0 * (v**2).sum(axis=1) / self._size**2 + (64.0 * self._nu / self._size**2) ** 2
        return self._coefficients(v / np.sqrt(square + 4.0 * first**2)[:, None]).T.ravel()

    def _move(self, q: Array) -> Array:
        """Return the motion of the mesh for a body with these unknowns.

        The midline is continued beyond head and tail. Nodes near the body shift and turn with it;
        the tank only travels along x.
        """
        beam, at, off, half = self.beam, self._at, self._off, self._half_width
        length, h = beam.length, beam.spacing
        ahead = int(np.ceil(-at.min() / h))
        X = h * np.arange(-ahead, int(np.ceil(at.max() / h)) + 1)

        def angle(X: Array) -> Array:
            inside = np.interp(X, np.linspace(0.0, length, beam.segments + 1), q[2:])
            return inside * np.exp(-outside(X, length) / (RELAX * length))

        middle = angle(0.5 * (X[1:] + X[:-1]))
        lines = [np.concatenate([[0.0], np.cumsum(h * f(middle))]) for f in (np.cos, np.sin)]
        x, y = (np.interp(at, X, line - line[ahead]) + q[k] for k, line in enumerate(lines))
        theta = angle(at)
        along = fade(outside(at, length), (AHEAD[0] * length, AHEAD[1] * length))
        shift = along * fade(np.abs(off), (SHIFT[0] * half, SHIFT[1] * half))
        turn = along * fade(self._beside, (TURN[0] * half, TURN[1] * half)) * off
        travel = float(beam.share @ (beam.shape(q)[0][:, 0] - beam.X))
        moved_x = at + travel + shift * (x - at - travel) - turn * np.sin(theta)
        moved_y = off + shift * y + turn * (np.cos(theta) - 1.0)
        moved = np.stack([moved_x, moved_y], axis=1)
        return self._coefficients(moved - self._flat).T.ravel()

    def _jacobian(self, q: Array) -> Array:
        """Return J, the coefficients of u on the body for each rate of the beam."""
        _, angle = self.beam.shape(q)
        on_skin, Y = self._skin_hats @ q[2:], self._off[self._skin]
        nodes = np.zeros((len(self._at), 2, self.beam.size))
        nodes[self._skin, 0, 0] = nodes[self._skin, 1, 1] = 1.0
        for row, lever, turned in (
            (0, -np.sin(angle), -Y * np.cos(on_skin)),
            (1, np.cos(angle), -Y * np.sin(on_skin)),
        ):
            slices = self._reach @ (lever[:, None] * self._hats)
            nodes[self._skin, row, 2:] = slices + turned[:, None] * self._skin_hats
        columns = self._coefficients(nodes.reshape(len(nodes), -1))[self._skin]
        return columns.reshape(-1, 2, self.beam.size).transpose(1, 0, 2).reshape(-1, self.beam.size)

    def _solve(
        self, first: float, past: dict[str, Array], new: dict[str, Array], activation: float
    ) -> None:
        """Solve for water and rates of the beam, at the place and shape q of `new`."""
        beam, free, skin, rho = self.beam, self._free, self._on_body, self._density
        self._form.Assemble()
        self._right.Assemble()
        entries = [vector.NumPy() for vector in self._form.mat.CSR()]
        A, f = sp.csr_matrix(tuple(entries)), self._right.vec.FV().NumPy()
        J, motion = self._jacobian(new["q"]), beam.motion(beam.shape(new["q"])[1])
        momenta = (motion * beam.excess[:, :, None]).reshape(-1, beam.size).T
        B = first * momenta @ motion.reshape(-1, beam.size) + beam.K / first + beam.D
        load = activation * self.drive + beam.K @ past["q"] / first
        load -= momenta @ past["velocity"].ravel()

        def expand(z: Array) -> Array:
            full = np.zeros(self.space.ndof)
            full[free], full[skin] = z[: len(free)], J @ z[len(free) :]
            return full

        def reduce(full: Array) -> Array:
            return np.concatenate([full[free], J.T @ full[skin]])

        def apply(z: Array) -> Array:
            result = reduce(A @ expand(z))
            result[len(free) :] += B @ z[len(free) :] / rho
            return result

        guess = np.concatenate([np.concatenate([new["u"], new["p"]])[free], new["rate"]])
        right = reduce(f) - apply(guess)
        right[len(free) :] += load / rho
        z = guess + self._correction(A, J, B / rho, apply, right, float(np.linalg.norm(guess)))
        full = expand(z)
        new["u"], new["p"] = np.split(full, [self.V.ndof])
        new["rate"] = z[len(free) :]
        new["velocity"] = motion @ new["rate"]

    def _correction(
        self,
        A: sp.csr_matrix,
        J: Array,
        B: Array,
        apply: Callable[[Array], Array],
        right: Array,
        size: float,
    ) -> Array:
        """Return the solution of the linear system, by GMRES with the factors of an earlier matrix.

        size: norm of the unknowns that the solution corrects
        Raises `ArithmeticError` where GMRES finds no solution.
        """
        free, skin = self._free, self._on_body
        for is_last in (self._factors is None, True):
            if self._factors is None:
                rows, body = A[free], A[skin]
                matrix = sp.bmat(
                    [
                        [rows[:, free], sp.csr_matrix(rows[:, skin] @ J)],
                        [sp.csr_matrix(J.T @ body[:, free]), J.T @ (body[:, skin] @ J) + B],
                    ],
                    format="csc",
                )
                # The pattern is symmetric; GMRES corrects what the weak pivots cost.
                self._factors = splu(
                    matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True}
                )
            factors, iterations = self._factors, []
            start = factors.solve(right)
            result, failed = gmres(
                LinearOperator((len(right),) * 2, lambda z, lu=factors: lu.solve(apply(z))),
                start,
                rtol=0.0,
                atol=TOLERANCE * (size + float(np.linalg.norm(start))),
                restart=30,
                maxiter=2,
                callback=iterations.append,
                callback_type="pr_norm",
            )
            if is_last or len(iterations) <= MAX_ITERATIONS:
                break
            self._factors = None
        if failed or not np.isfinite(result).all():
            raise ArithmeticError("the finite elements diverged: a shorter step may help")
        return np.asarray(result)

    def reading(self) -> tuple[float, float, float]:
        """Return x of the centre of mass [m], angle of the tail [rad], work of the muscles [J/m].

        The angle is that of `fishd.virtual.swimmer.fish.Motion`.
        """
        beam = self.beam
        places, angle = beam.shape(self.state["q"][0])
        share = beam.X / beam.length
        front, rear = share < FRONT_FRACTION, share > REAR_FRACTION
        heading = np.average(angle[front], weights=beam.share[front])
        ends = [
            np.average(places[part], axis=0, weights=beam.share[part]) for part in (front, rear)
        ]
        x, y = ends[1] - ends[0]
        centre = float(beam.share @ places[:, 0])
        return centre, float(np.arctan2(y, x) - heading), self.work


def fade(distance: Array, ends: tuple[float, float]) -> Array:
    """Return 1 up to the first end and 0 from the second on, with a continuous slope."""
    share = np.clip((ends[1] - distance) / (ends[1] - ends[0]), 0.0, 1.0)
    return share**2 * (3.0 - 2.0 * share)


def outside(X: Array, length: float) -> Array:
    """Return the distance along x from the straight body [m]."""
    return np.maximum(0.0, np.abs(X - 0.5 * length) - 0.5 * length)
