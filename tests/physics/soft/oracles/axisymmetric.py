"""A ball on a round pad by axisymmetric finite elements: large strain, Coulomb friction, no code shared with the package.

Biquadratic elements in (r, z), the stable neo-Hookean gel Ψ = μ/2 (I_C − 3) − μ (J − 1) + λ/2 (J − 1)² of small-strain moduli E and ν,
bonded at its back, free at its side. The ball is rigid. Contact acts at the Gauss points of the upper edge: pressure c g² of a penetration
g, and a spring along the ball from where a point first touched, up to ``friction`` times the pressure.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as linalg

GAUSS = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)]), np.array([5.0, 8.0, 5.0]) / 9.0
COLUMNS, ROWS = 32, 10
"""Elements along r and z."""
STEP = 0.05
"""Motion of the ball in a step [mm]."""
TOLERANCE, NEWTON, HALVINGS = 1e-5, 40, 14
"""Residual of a solved step [N]; most Newton iterations, and halvings of one."""


def shape_functions(x: float) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic shape functions at −1 ≤ x ≤ 1 and their derivatives, (3,) each."""
    return np.array([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2]), np.array([x - 0.5, -2 * x, x + 0.5])


def with_middles(places: np.ndarray) -> np.ndarray:
    """``places`` (N,) and the middles between them, (2 N − 1,)."""
    return np.interp(np.arange(2 * len(places) - 1) / 2, np.arange(len(places)), places)


@dataclass
class RoundPad:
    """Round pad under a ball; lengths in mm, moduli in MPa, forces in N."""

    modulus: float
    poisson: float
    friction: float
    ball: float
    thickness: float
    radius: float
    u: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        shear = self.modulus / (2 * (1 + self.poisson))
        self._mu, self._lam = shear, 2 * shear * self.poisson / (1 - 2 * self.poisson) + shear
        fine, count = 0.5 * self.radius, int(0.75 * COLUMNS)
        outer = fine + (self.radius - fine) * np.linspace(0, 1, COLUMNS - count + 1)[1:] ** 1.2
        r = with_middles(np.concatenate([np.linspace(0, fine, count + 1), outer]))
        z = with_middles(-self.thickness * np.linspace(1, 0, ROWS + 1) ** 1.3)
        self._rest = np.stack(np.meshgrid(r, z, indexing="ij"), axis=-1).reshape(-1, 2)
        nodes = np.arange(len(self._rest)).reshape(len(r), len(z))
        cells = np.array([nodes[i : i + 3, j : j + 3].ravel() for i in range(0, len(r) - 2, 2) for j in range(0, len(z) - 2, 2)])
        self._edge = np.array([nodes[i : i + 3, -1] for i in range(0, len(r) - 2, 2)])
        fixed = np.concatenate([2 * nodes[:, 0], 2 * nodes[:, 0] + 1, 2 * nodes[0]])
        self._free = np.setdiff1d(np.arange(2 * len(self._rest)), fixed)
        self._dofs, self._edge_dofs = (np.stack([2 * of, 2 * of + 1], axis=-1).reshape(len(of), -1) for of in (cells, self._edge))
        self._gradient, self._weight = self._quadrature(self._rest[cells])
        self._edge_shape = np.stack([shape_functions(x)[0] for x in GAUSS[0]])
        at = self._rest[self._edge][..., 0]
        slope = np.stack([shape_functions(x)[1] for x in GAUSS[0]])
        self._edge_weight = 2 * np.pi * (at @ self._edge_shape.T) * (at @ slope.T) * GAUSS[1]
        self._pressure, self._spring = 3e5 * self.modulus, 60 * self.modulus
        self._touched = np.full(self._edge_weight.shape, np.nan)
        self.u = np.zeros(2 * len(self._rest))
        self._before = self.u

    @staticmethod
    def _quadrature(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients F_rr, F_rz, F_zr, F_zz, F_θθ by nodal displacement (E, 9, 5, 18), and weights [mm³] (E, 9)."""
        gradients, weights = [], []
        for x, by_x in zip(*GAUSS, strict=True):
            for y, by_y in zip(*GAUSS, strict=True):
                (n, dn), (m, dm) = shape_functions(x), shape_functions(y)
                value, slopes = np.outer(n, m).ravel(), np.stack([np.outer(dn, m).ravel(), np.outer(n, dm).ravel()])
                jacobian = np.einsum("cn,enk->eck", slopes, nodes)
                slope, radius = np.linalg.solve(jacobian, np.broadcast_to(slopes, (len(nodes), 2, 9))), nodes[..., 0] @ value
                gradient = np.zeros((len(nodes), 5, 18))
                gradient[:, 0, 0::2], gradient[:, 1, 0::2] = slope[:, 0], slope[:, 1]
                gradient[:, 2, 1::2], gradient[:, 3, 1::2] = slope[:, 0], slope[:, 1]
                gradient[:, 4, 0::2] = value / radius[:, None]
                gradients.append(gradient)
                weights.append(2 * np.pi * radius * np.linalg.det(jacobian) * by_x * by_y)
        return np.stack(gradients, axis=1), np.stack(weights, axis=1)

    def _assembled(self, dofs: np.ndarray, force: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, sparse.csc_matrix]:
        total, width = np.zeros_like(self.u), dofs.shape[1]
        np.add.at(total, dofs, force)
        places = np.repeat(dofs, width, axis=1).ravel(), np.tile(dofs, (1, width)).ravel()
        return total, sparse.csc_matrix((stiffness.ravel(), places), shape=(len(total),) * 2)

    def _elastic(self, u: np.ndarray) -> tuple[np.ndarray, sparse.csc_matrix] | None:
        """Gradient and Hessian of the elastic energy; None where an element is turned inside out."""
        f = np.einsum("egij,ej->egi", self._gradient, u[self._dofs]) + np.array([1.0, 0.0, 0.0, 1.0, 1.0])
        a, b, c, d, hoop = np.moveaxis(f, -1, 0)
        volume = (a * d - b * c) * hoop
        if (volume <= 0.0).any():
            return None
        cofactor = np.stack([d * hoop, -c * hoop, -b * hoop, a * hoop, a * d - b * c], axis=-1)
        curved = np.zeros((*f.shape, 5))
        curved[..., 0, 3] = curved[..., 3, 0] = hoop
        curved[..., 1, 2] = curved[..., 2, 1] = -hoop
        for k, entry in enumerate((d, -c, -b, a)):
            curved[..., k, 4] = curved[..., 4, k] = entry
        pressure = self._lam * (volume - 1.0) - self._mu
        stress = self._mu * f + pressure[..., None] * cofactor
        tangent = self._mu * np.eye(5) + self._lam * cofactor[..., :, None] * cofactor[..., None, :]
        tangent = tangent + pressure[..., None, None] * curved
        force = np.einsum("egij,egi,eg->ej", self._gradient, stress, self._weight)
        stiffness = np.einsum("egki,egkl,eglj,eg->eij", self._gradient, tangent, self._gradient, self._weight, optimize=True)
        return self._assembled(self._dofs, force, stiffness)

    def _contact(self, u: np.ndarray, height: float) -> tuple[np.ndarray, sparse.csc_matrix, float, np.ndarray]:
        """Forces on nodes, less; their derivative; force on the ball; where each point would touch, if it does (edge, 3) [mm]."""
        moved = (self._rest + u.reshape(-1, 2))[self._edge]
        from_ball = np.einsum("gn,enk->egk", self._edge_shape, moved) - np.array([0.0, height])
        distance = np.linalg.norm(from_ball, axis=-1)
        n = from_ball / distance[..., None]
        t = np.stack([-n[..., 1], n[..., 0]], axis=-1)
        gap = distance - self.ball
        on = gap < 0.0
        arc = self.ball * np.arctan2(from_ball[..., 0], -from_ball[..., 1])
        fresh = np.isnan(self._touched)
        pressure, by_gap = self._pressure * gap**2 * on, 2 * self._pressure * gap * on
        drag = -self._spring * (arc - np.where(fresh, arc, self._touched)) * on
        slides = on & (np.abs(drag) > self.friction * pressure)
        sign = np.sign(drag)
        drag = np.where(slides, sign * self.friction * pressure, drag)
        traction = pressure[..., None] * n + drag[..., None] * t
        along = np.where(slides | fresh, 0.0, -self._spring * on) * self.ball / distance + pressure / distance
        sliding = np.where(slides, self.friction * sign * by_gap, 0.0)
        nn, tt, tn, nt = (p[..., :, None] * q[..., None, :] for p, q in ((n, n), (t, t), (t, n), (n, t)))
        tangent = by_gap[..., None, None] * nn + along[..., None, None] * tt
        tangent = tangent + sliding[..., None, None] * tn - (drag / distance)[..., None, None] * nt
        count = len(self._edge)
        force = -np.einsum("gn,egk,eg->enk", self._edge_shape, traction, self._edge_weight).reshape(count, 6)
        by_node = -np.einsum("gn,egkl,gm,eg->enkml", self._edge_shape, tangent, self._edge_shape, self._edge_weight)
        places = np.where(on, np.where(slides, arc + drag / self._spring, np.where(fresh, arc, self._touched)), np.nan)
        total = self._assembled(self._edge_dofs, force, by_node.reshape(count, 6, 6))
        return *total, -float((traction[..., 1] * self._edge_weight).sum()), places

    def _solve(self, height: float) -> float:
        """Equilibrium with the ball's centre at ``height`` [mm]; its force [N]."""

        def residual(u: np.ndarray) -> tuple[np.ndarray, sparse.csc_matrix] | None:
            elastic = self._elastic(u)
            if elastic is None:
                return None
            force, stiffness, *_ = self._contact(u, height)
            total = sparse.csc_matrix(elastic[1] + stiffness)
            return (elastic[0] + force)[self._free], total[self._free][:, self._free]

        starts = (self.u + share * (self.u - self._before) for share in (1.0, 0.5, 0.0))
        u, at = next((start, at) for start in starts if (at := residual(start)) is not None)
        for _ in range(NEWTON):
            size = np.linalg.norm(at[0])
            if size < TOLERANCE:
                break
            step, trials = linalg.splu(at[1]).solve(-at[0]), []
            for halving in range(HALVINGS):
                trial = u.copy()
                trial[self._free] += 0.5**halving * step
                if (there := residual(trial)) is not None:
                    trials.append((np.linalg.norm(there[0]), trial, there))
                    if trials[-1][0] < 0.9 * size:
                        break
            _, u, at = min(trials, key=lambda trial: trial[0])
        else:
            raise ArithmeticError(f"no equilibrium at {self.ball - height:.3f} mm: a residual of {np.linalg.norm(at[0]):.1e} N")
        self._before, self.u = self.u, u
        *_, force, self._touched = self._contact(u, height)
        return force

    def press(self, depths: np.ndarray) -> np.ndarray:
        """Force [N] at each of ``depths`` [mm], ascending."""
        forces, depth = [], 0.0
        for goal in depths:
            for height in np.linspace(self.ball - depth, self.ball - goal, round((goal - depth) / STEP) + 1)[1:]:
                force = self._solve(float(height))
            forces.append(force)
            depth = goal
        return np.array(forces)
