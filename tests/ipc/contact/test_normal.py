"""Contact energy, forces, Hessian and friction of whole surfaces against ipctk and finite differences."""

from __future__ import annotations

import ipctk
import numpy as np
import pytest
import scipy.sparse
import warp as wp

import ipc
from ipc.bodies import build_layout
from ipc.solver.potential import Potential
from tests.ipc.conftest import unit_cell

D_HAT, KAPPA, MU, EPS = 0.05, 3e4, 0.4, 1e-3


class Scene:
    """Two cubes, one turned and tilted above the other, as bare contact terms."""

    def __init__(
        self, gap: float, tilt: tuple[float, float, float], friction: float = 0.0, middle: tuple[float, float] = (0.5, 0.5)
    ) -> None:
        a, b = unit_cell(2), unit_cell(2, 0.7)
        angle = np.linalg.norm(tilt)
        axis = np.array(tilt) / max(angle, 1e-300)
        K = np.cross(np.eye(3), axis) * -1
        R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        v = (b.vertices - 0.35) @ R.T + [*middle, 0.0]
        v[:, 2] += 1.0 + gap - v[:, 2].min()
        bodies = [ipc.SoftBody("a", a, ipc.Material(1e5)), ipc.SoftBody("b", ipc.TetMesh(v, b.tets), ipc.Material(1e5))]
        self.layout = build_layout(bodies, friction, {}, [])
        settings = ipc.Settings(dt=1.0, friction_slip=EPS)
        self.solver = Potential(self.layout, settings, 1, D_HAT, KAPPA, wp.get_device("cpu"))
        self.solver.y.assign(self.layout.node_rest[None])
        self.solver.frame_q.fill_(wp.quatd(0.0, 0.0, 0.0, 1.0))
        self.solver.goal_q.fill_(wp.quatd(0.0, 0.0, 0.0, 1.0))
        self.solver.set_frames(wp.zeros(1, dtype=wp.float64, device="cpu"), self.solver.R, self.solver.t)
        self.x = self.place(self.layout.node_rest)
        self.mesh = ipctk.CollisionMesh(self.x, self.layout.edges, self.layout.faces)
        self.potential = ipctk.BarrierPotential(D_HAT, KAPPA, True)

    def place(self, nodes: np.ndarray) -> np.ndarray:
        self.solver.y.assign(nodes[None])
        self.solver.place_vertices(self.solver.y, self.solver.R, self.solver.t, self.solver.x)
        return self.solver.x.numpy()[0].copy()

    def evaluate(self, x: np.ndarray, start: np.ndarray | None = None) -> tuple[float, np.ndarray]:
        """Barrier energy and gradient (V, 3) of barrier and friction."""
        s = self.solver
        s.x.assign(x[None])
        s.x_start.assign((x if start is None else start)[None])
        s.dx.zero_()
        s.collision.refresh(s.x, s.dx, s.everyone)
        s.touch(s.everyone)
        s.add_friction(s.everyone)
        return float(s.barrier.numpy()[0]), s.vert_gradient.numpy()[0].copy()

    def hessian(self, definite: bool = False) -> np.ndarray:
        """± Σ q qᵀ of the last evaluation, (3V, 3V), with minus for concave rows, which are left out where it must be ``definite``."""
        contacts = self.solver.collision.contacts
        rows = int(contacts.row_count.numpy()[0])
        n = len(self.x)
        verts, q = contacts.row_verts.numpy()[0, :rows], contacts.row.numpy()[0, :rows]
        Q = np.zeros((rows, n, 3))
        for r in range(rows):
            for k in range(4):
                if verts[r, k] >= 0:
                    Q[r, verts[r, k]] += q[r, :, k]
        Q = Q.reshape(rows, 3 * n)
        concave = contacts.concave.numpy()[0, :rows]
        return Q.T @ (np.where(concave == 1, 0.0 if definite else -1.0, 1.0)[:, None] * Q)

    def collisions(self, x: np.ndarray) -> ipctk.NormalCollisions:
        pairs = ipctk.NormalCollisions()
        pairs.use_area_weighting = True
        pairs.build(self.mesh, np.asfortranarray(x), D_HAT)
        return pairs


TILTS = {"flat": (0.0, 0.0, 0.0), "turned": (0.0, 0.0, 0.4), "corner": (0.5, 0.4, 0.3), "edge": (0.3, 0.0, 0.0)}


@pytest.mark.parametrize("tilt", TILTS, ids=str)
@pytest.mark.parametrize("gap", [0.002, 0.03])
def test_energy_and_gradient_match_ipctk(tilt: str, gap: float) -> None:
    scene = Scene(gap, TILTS[tilt])
    energy, gradient = scene.evaluate(scene.x)
    pairs = scene.collisions(scene.x)
    x = np.asfortranarray(scene.x)
    expected = scene.potential(pairs, scene.mesh, x)
    expected_gradient = scene.potential.gradient(pairs, scene.mesh, x).reshape(-1, 3)
    assert len(pairs) > 0 and np.linalg.norm(gradient) > 1e-8
    assert energy == pytest.approx(expected, rel=1e-10)
    assert np.abs(gradient - expected_gradient).max() < 1e-10 * np.abs(expected_gradient).max()
    assert np.abs(gradient.sum(axis=0)).max() < 1e-12 * np.abs(gradient).sum()


ATTITUDES = TILTS | {"nearly parallel": (0.0, 0.0, 0.01), "nearly parallel, tilted": (0.008, 0.005, 0.012)}


def terms_of_hessian(scene: Scene, pairs: ipctk.NormalCollisions, x: np.ndarray) -> tuple[np.ndarray, ...]:
    """From ipctk's distances and mollifiers, pair by pair: terms that are kept, the same clamped, those of turning, and those dropped.

    A pair stores m(c) f(d); with ∇ over its vertices and w = a × b, c = ‖w‖², its Hessian is
    [∇d ∇c] [m f'', m' f'; m' f', m'' f] [∇d ∇c]ᵀ + 2 m' f ∇wᵀ∇w (kept) + m f' ∇²d + 2 m' f w·∇²w. Where m = 1, f' ∇²d is that of
    turning, less f'/d across an edge or a corner, which is dropped; where m < 1 all of it is. All (3V, 3V).
    """
    size = 3 * len(x)
    kept, clamped, turning, dropped = (np.zeros((size, size)) for _ in range(4))
    b, Dh = ipctk.ClampedLogBarrier(), D_HAT**2
    edges, faces = scene.layout.edges, scene.layout.faces
    for i in range(len(pairs)):
        pair = pairs[i]
        at = pair.dof(x, edges, faces)
        dof = (3 * np.array(pair.vertex_ids(edges, faces)[: len(at) // 3])[:, None] + np.arange(3)).ravel()
        block = np.ix_(dof, dof)
        D, gD, hD = pair.compute_distance(at), pair.compute_distance_gradient(at), pair.compute_distance_hessian(at)
        d = D**0.5
        gd = gD / (2 * d)
        hd = (hD - 2 * np.outer(gd, gd)) / (2 * d)
        scale = pair.weight * KAPPA / D_HAT**3
        f, b1, b2 = scale * b(D, Dh), b.first_derivative(D, Dh), b.second_derivative(D, Dh)
        f1, f2 = scale * 2 * d * b1, scale * (2 * b1 + 4 * D * b2)
        m, m1, m2, J, W = 1.0, 0.0, 0.0, gd[:, None], np.zeros((3, len(at)))
        H = np.array([[f2]])
        if pairs.is_edge_edge(i):
            a0, a1, b0, b1_ = at.reshape(4, 3)
            c, eps = ipctk.edge_edge_cross_squarednorm(a0, a1, b0, b1_), pair.eps_x
            m, m1 = ipctk.edge_edge_mollifier(c, eps), ipctk.edge_edge_mollifier_gradient(c, eps)
            m2 = -2 / eps**2 if c < eps else 0.0
            gc = ipctk.edge_edge_cross_squarednorm_gradient(a0, a1, b0, b1_)
            hc = ipctk.edge_edge_cross_squarednorm_hessian(a0, a1, b0, b1_)
            # w = (a1 − a0) × (b1 − b0) is linear in each edge.
            for k, step in enumerate(np.eye(3)):
                W[:, 3 + k], W[:, 9 + k] = np.cross(step, b1_ - b0), np.cross(a1 - a0, step)
            W[:, 0:3], W[:, 6:9] = -W[:, 3:6], -W[:, 9:12]
            J, H = np.stack([gd, gc], axis=1), np.array([[m * f2, m1 * f1], [m1 * f1, m2 * f]])
            dropped[block] += m1 * f * (hc - 2 * W.T @ W)
        term = J @ H @ J.T
        values, vectors = np.linalg.eigh(term)
        kept[block] += term + 2 * m1 * f * W.T @ W
        clamped[block] += (vectors * np.maximum(values, 0)) @ vectors.T + 2 * m1 * f * W.T @ W
        if m < 1:
            dropped[block] += m * f1 * hd
            continue
        c, across = gd.reshape(-1, 3), np.zeros((0, 3))
        if pairs.is_vertex_vertex(i) or pairs.is_edge_vertex(i):
            across = scipy.linalg.null_space(np.stack([c[0], at[6:] - at[3:6] if len(at) == 9 else c[0]])).T
        moves = np.einsum("i,kj->kij", c @ c[0], across).reshape(len(across), len(at))
        turning[block] += f1 * (hd - moves.T @ moves / d)
        dropped[block] += f1 * moves.T @ moves / d
    return kept, clamped, turning, dropped


@pytest.mark.parametrize("attitude", ATTITUDES, ids=str)
@pytest.mark.parametrize("gap", [0.002, 0.02])
def test_hessian_is_ipctks_but_for_what_is_dropped(attitude: str, gap: float) -> None:
    """Term by term: all add up to ipctk's Hessian; the rows are what is kept, clamped pair by pair, and what turning adds."""
    scene = Scene(gap, ATTITUDES[attitude], middle=(0.513, 0.527))  # no vertex lies above an edge
    scene.evaluate(scene.x)
    rows = scene.hessian()
    x = np.asfortranarray(scene.x)
    pairs = scene.collisions(scene.x)
    exact = scipy.sparse.csr_matrix(scene.potential.hessian(pairs, scene.mesh, x)).toarray()
    kept, clamped, turning, dropped = terms_of_hessian(scene, pairs, x)
    size = np.abs(exact).max()
    assert size > 1e-3 and np.abs(turning).max() > 1e-6 * size
    assert np.abs(kept + turning + dropped - exact).max() < 1e-8 * size
    assert np.abs(rows - clamped - turning).max() < 1e-8 * size
    # Without the concave rows the matrix is definite, and no smaller.
    definite = scene.hessian(definite=True)
    values = np.linalg.eigvalsh(definite)
    assert values[0] > -1e-12 * values[-1] and np.linalg.eigvalsh(definite - rows)[0] > -1e-12 * values[-1]
    assert np.linalg.eigvalsh(turning)[0] < -1e-8 * values[-1] and np.linalg.eigvalsh(clamped - kept)[0] > -1e-12 * values[-1]


@pytest.mark.parametrize("attitude", ATTITUDES, ids=str)
@pytest.mark.parametrize("gap", [0.002, 0.02])
def test_along_the_force_the_hessian_is_ipctks(attitude: str, gap: float) -> None:
    """What is dropped and what clamping adds hardly count there, but for nearly parallel edges."""
    scene = Scene(gap, ATTITUDES[attitude])
    scene.evaluate(scene.x)
    rows, x, pairs = scene.hessian(), np.asfortranarray(scene.x), scene.collisions(scene.x)
    exact, u = scene.potential.hessian(pairs, scene.mesh, x), scene.potential.gradient(pairs, scene.mesh, x)
    assert u @ rows @ u == pytest.approx(u @ exact @ u, rel=0.1 if "nearly" in attitude else 1e-3)


def test_gradient_matches_finite_differences_near_parallel_edges(rng: np.random.Generator) -> None:
    """Mollified pairs included: the energy is smooth, and its gradient is what is applied."""
    scene = Scene(0.01, (0.0, 0.0, 0.01))
    x = scene.x + 1e-3 * rng.standard_normal(scene.x.shape)
    _, g = scene.evaluate(x)
    for _ in range(6):
        u = rng.standard_normal(x.shape)
        h = 1e-7
        slope = (scene.evaluate(x + h * u)[0] - scene.evaluate(x - h * u)[0]) / (2 * h)
        assert abs((g * u).sum()) > 1e-3
        assert slope == pytest.approx((g * u).sum(), rel=2e-6)


@pytest.mark.parametrize("slide", [0.3 * EPS, 5 * EPS])
def test_friction_matches_ipctk(slide: float, rng: np.random.Generator) -> None:
    scene = Scene(0.02, TILTS["corner"], friction=MU)
    scene.evaluate(scene.x)
    changes = scene.solver.reach, scene.solver.elastic_energy, scene.solver.kinetic
    scene.solver.collision.lag(scene.solver.everyone, scene.solver.everyone, changes, guarded=False)
    _, normal = scene.evaluate(scene.x)
    moved = scene.x.copy()
    moved[scene.x[:, 2] > 1.001] += slide * np.array([0.6, 0.8, 0.1])
    moved += 0.05 * slide * rng.standard_normal(moved.shape)
    energy0, _ = scene.evaluate(moved, start=scene.x)
    friction = scene.solver.vert_gradient.numpy()[0] - barrier_gradient(moved)
    pairs = scene.collisions(scene.x)
    tangential = ipctk.TangentialCollisions()
    tangential.build(scene.mesh, np.asfortranarray(scene.x), pairs, scene.potential, MU)
    potential = ipctk.FrictionPotential(EPS)
    expected = potential.gradient(tangential, scene.mesh, np.asfortranarray(moved - scene.x)).reshape(-1, 3)
    assert np.linalg.norm(expected) > 1e-6 and energy0 >= 0
    assert np.abs(friction - expected).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(normal).max() > 0


def barrier_gradient(x: np.ndarray) -> np.ndarray:
    """The barrier gradient alone."""
    bare = Scene(0.02, TILTS["corner"])
    return bare.evaluate(x)[1]


@pytest.mark.parametrize("size", [0.0, 0.7], ids=["from rest", "with slip"])
def test_friction_force_and_hessian_match_finite_differences(size: float, rng: np.random.Generator) -> None:
    """Of the energy and of the force, also with elastic slips that the pairs brought along, below and beyond ε."""
    scene = Scene(0.02, TILTS["corner"], friction=MU)
    scene.evaluate(scene.x)
    collision = scene.solver.collision
    changes = scene.solver.reach, scene.solver.elastic_energy, scene.solver.kinetic
    collision.lag(scene.solver.everyone, scene.solver.everyone, changes, guarded=False)
    n = collision.lagged.normal.numpy()
    z = rng.standard_normal(n.shape)
    z -= (z * n).sum(axis=-1, keepdims=True) * n
    z *= size * EPS / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-300)
    collision.lagged.slip.assign(z)
    far = scene.x.copy()
    far[scene.x[:, 2] > 1.001] += [0.4 * EPS, 0.1 * EPS, 0.0]
    bare = Scene(0.02, TILTS["corner"])

    def friction_gradient(x: np.ndarray) -> np.ndarray:
        return scene.evaluate(x, start=scene.x)[1] - bare.evaluate(x)[1]

    def energy_change(x: np.ndarray) -> float:
        changes = []
        for one in (scene, bare):
            one.evaluate(x, start=scene.x)
            s, change = one.solver, wp.zeros(1, dtype=wp.float64, device="cpu")
            s.x.assign(far[None])
            s.x1.assign(x[None])
            s.collision.energy_change(s.x, s.x1, s.x_start, s.R, s.t, s.kappa, EPS, s.everyone, change)
            changes.append(float(change.numpy()[0]))
        return changes[0] - changes[1]

    force = friction_gradient(far)
    H = scene.hessian()
    bare.evaluate(far)
    H = H - bare.hessian()
    for _ in range(3):
        u = rng.standard_normal(far.shape)
        h = 1e-3 * EPS
        slope = (energy_change(far + h * u) - energy_change(far - h * u)) / (2 * h)
        assert abs((force * u).sum()) > 1e-6
        assert slope == pytest.approx((force * u).sum(), rel=1e-4)
        expected = (friction_gradient(far + h * u) - friction_gradient(far - h * u)).ravel() / (2 * h)
        got = H @ u.ravel()
        assert np.abs(expected).max() > 1e-3
        assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()
