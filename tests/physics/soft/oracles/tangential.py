"""Correction of the sideways displacement of the coat's vertices, by pressure and friction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from raytac.gel.components import span
from raytac.gel.interpolate import sampled
from raytac.physics.bonded_layer import layer_shear, layer_spread
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.specs.sensor import GelpadSpec
from tests.physics.soft.oracles.matmul import product, sandwich
from tests.physics.soft.oracles.normal import NormalContact, NormalCorrection

Response = Callable[[np.ndarray], np.ndarray]
"""A: displacement [m] of a traction [Pa], (2, n, m) each."""


@dataclass(frozen=True)
class PlaneMotion:
    """Rigid motion in the plane, of less than a quarter turn."""

    centre: np.ndarray
    """[m], (2,)."""
    shift: np.ndarray
    """Displacement of the centre [m], (2,)."""
    sine: float
    """Sine of the rotation about +z."""

    @staticmethod
    def fit(displacement: np.ndarray, place: np.ndarray, weight: np.ndarray) -> PlaneMotion:
        """The motion nearest to a ``displacement`` (n, 2) of ``place`` (n, 2) [m], by ``weight``."""
        share = weight / weight.sum()
        centre, shift = share @ place, share @ displacement
        arm = place - centre
        size = float(share @ (arm**2).sum(axis=1))
        moment = float(share @ (arm[:, 0] * displacement[:, 1] - arm[:, 1] * displacement[:, 0]))
        return PlaneMotion(centre, shift, moment / size if size > 0.0 else 0.0)

    def at(self, place: np.ndarray) -> np.ndarray:
        """Displacement [m] of places (…, 2) [m], same shape."""
        arm = place - self.centre
        shorter = np.sqrt(max(1.0 - self.sine**2, 0.0)) - 1.0
        return self.shift + self.sine * np.stack([-arm[..., 1], arm[..., 0]], axis=-1) + shorter * arm

    def plus(self, goal: PlaneMotion, mean: PlaneMotion) -> PlaneMotion:
        """This motion plus the difference of ``goal`` and ``mean``, taken at this one's centre."""
        difference = goal.at(self.centre) - mean.at(self.centre)
        return PlaneMotion(self.centre, self.shift + difference, self.sine + goal.sine - mean.sine)


@dataclass(frozen=True)
class TangentialContact:
    """Stick and slip of one contact on a window of the tangential grid."""

    place: np.ndarray
    """Rest position of the window's nodes [m], (n, m, 2)."""
    traction: np.ndarray
    """τ of the object on the skin [Pa], (2, n, m)."""
    bound: np.ndarray
    """Coulomb's limit μ p [Pa], (n, m)."""
    displacement: np.ndarray
    """A τ [m], (2, n, m)."""
    waves: np.ndarray
    """Amplitudes of A τ over the whole pad [m], (2, Ky, Kx)."""


Lines = tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]
"""Cosines and sines over lines, (Kx, Nx) each, and (Ny, Ky) each."""


def plane_waves(along_x: CosineSeries, along_y: CosineSeries, x: np.ndarray, y: np.ndarray) -> Lines:
    """Waves of both series over lines ``x`` (Nx,), ``y`` (Ny,) [m], for ``plane_displacement``."""
    over_x = tuple(np.ascontiguousarray(f(x).T, np.float32) for f in (along_x.synthesis, along_x.sines))
    return over_x, tuple(f(y).astype(np.float32) for f in (along_y.synthesis, along_y.sines))


def plane_displacement(waves: np.ndarray, lines: Lines) -> np.ndarray:
    """Displacement along x and y [m], (2, Ny, Nx), of amplitudes (2, Ky, Kx) of plane waves."""
    (cos_x, sin_x), (cos_y, sin_y) = lines
    return np.stack([sandwich(cos_y, waves[0], sin_x), sandwich(sin_y, waves[1], cos_x)])


class FrictionCorrection:
    """Exchanges the mesh's response to friction for the layer's (*defect correction*).

    Let v be the sideways displacement that friction has given to the vertices in contact. E q is what *the same mesh* does, by linear
    elasticity, under tangential forces q on these vertices that hold them at v. A τ is what *the gel layer* does under a traction τ on
    a fine grid. The skin's displacement u becomes

        u − E q + A τ,   A τ = D where the contact sticks,   |τ| ≤ μ p everywhere, with τ along the slip at the limit,

    with the pressure p of ``NormalContact``. So the contact's edge slips as in C. Cattaneo (1938) and R. D. Mindlin (J. Appl. Mech. 16,
    1949): one coefficient for the whole contact, one loading, no history. D is a rigid motion. It makes the mean of A τ over the contact
    (shift and rotation, weighted by p) equal to that of v weighted by the mesh's normal forces, since that mean hardly depends on the
    mesh. Where everything slides and the mean is still too small, μ p is raised in proportion: small strain underestimates the pressure.
    Where the contact does not move as such a one would (a bar that ploughs its ends through the gel as it turns), the correction is
    blended out.

    A is the layer's compliance wave by wave, as if the pad were continued by its mirror image, and E is of a mesh with such sides.
    Both drag the gel by nearly the same force, so the effect of the true sides stays in u.
    """

    def __init__(self, normal: NormalCorrection, gelpad: GelpadSpec, compliance: np.ndarray) -> None:
        """Prepare the tangential grid.

        ``compliance``: displacement along x, y of each vertex over a force along x, y (first axis) on each [m/N], (2, 2, V, V), for a mesh
        whose sides may not move outwards.
        """
        self._normal, self._settings = normal, normal.settings
        self._compliance = compliance.astype(np.float32)
        ends = [(t[0], t[-1]) for t in (normal.x, normal.y)]
        pitch = self._settings.tangential_pitch
        self._x, self._y = (np.linspace(low, high, round((high - low) / pitch) + 1) for low, high in ends)
        x, y = CosineSeries(self._x), CosineSeries(self._y)
        k = np.hypot(x.wave_numbers[None, :], y.wave_numbers[:, None])
        cos_x, cos_y = (
            k_axis / np.maximum(k, x.wave_numbers[1] * 1e-9) for k_axis in (x.wave_numbers[None, :], y.wave_numbers[:, None])
        )
        hats = y.hats(np.arange(len(self._y)))[1][:, None] * x.hats(np.arange(len(self._x)))[1]
        along, across = (law * hats for law in layer_shear(k, gelpad))
        excess = along - across
        laws = across + excess * cos_x**2, excess * cos_x * cos_y, across + excess * cos_y**2
        self._layer = tuple(law.astype(np.float32) for law in laws)
        self._analysis_x, self._analysis_y = (
            tuple(m.astype(np.float32) for m in (series.analysis, series.sine_analysis)) for series in (x, y)
        )
        self._nodes = plane_waves(x, y, self._x, self._y)
        self._vertices = plane_waves(x, y, normal.surface.mesh.lines_x, normal.surface.mesh.lines_y)

    def correct(
        self, contact: NormalContact, dragged: np.ndarray, touching: np.ndarray, load: np.ndarray, friction: float
    ) -> np.ndarray:
        """A τ − E q [m], (V, 2), at the coat's vertices.

        Args:
            contact: solution of the normal stage.
            dragged: v [m], (V, 2), of which those ``touching`` (V,) count.
            load: normal force on each vertex [N], (V,).
            friction: μ > 0.
        """
        rest = self._normal.surface.mesh.rest[:, :2]
        goal = PlaneMotion.fit(dragged[touching], rest[touching], load[touching])
        waves = np.zeros((2, len(self._y), len(self._x)), np.float32)
        if np.abs(goal.at(rest[touching])).max() > self._settings.motion_tolerance:
            solution = self.solve(contact.pressure, goal, friction)
            if solution is None:
                return np.zeros_like(dragged)
            waves = solution.waves
        layer = plane_displacement(waves, self._vertices).reshape(2, -1)
        blend = self._blend(layer.T[touching], dragged[touching], load[touching])
        if blend == 0.0:
            return np.zeros_like(dragged)
        compliance = self._compliance[:, :, :, touching]
        within = compliance[:, :, touching].transpose(1, 2, 0, 3).reshape(2 * touching.sum(), -1)
        force = self._mesh_forces(within, dragged[touching].T.ravel().astype(np.float32))
        mesh = product(compliance.transpose(1, 2, 0, 3).reshape(-1, len(force)), force[:, None]).reshape(2, -1)
        return blend * (layer - mesh).T.astype(float)

    def solve(self, pressure: np.ndarray, goal: PlaneMotion, friction: float) -> TangentialContact | None:
        """Stick and slip under ``pressure`` [Pa] for a mean displacement ``goal``, or None."""
        settings = self._settings
        place = np.stack(np.meshgrid(self._x, self._y), axis=-1)

        def pressure_at(displacement: np.ndarray, place: np.ndarray) -> np.ndarray:
            now = (place + displacement).reshape(-1, 2)
            return sampled(pressure, self._normal.x, self._normal.y, *now.T).reshape(place.shape[:2])

        loaded = pressure_at(goal.at(place), place) > settings.least_load * pressure.max()
        if not loaded.any():
            return None
        margin = 2 + int(0.3 * np.abs(goal.at(place)[loaded]).max() / settings.tangential_pitch)
        rows, columns = (span(loaded.any(axis=k), margin) for k in (1, 0))
        place, loaded = place[rows, columns], loaded[rows, columns]
        (to_cos_x, to_sin_x), (to_cos_y, to_sin_y) = (
            tuple(m[:, columns].T for m in self._analysis_x),
            tuple(m[:, rows] for m in self._analysis_y),
        )
        window = tuple(m[:, columns] for m in self._nodes[0]), tuple(m[rows] for m in self._nodes[1])

        def amplitudes(traction: np.ndarray) -> np.ndarray:
            τx, τy = sandwich(to_cos_y, traction[0], to_sin_x), sandwich(to_sin_y, traction[1], to_cos_x)
            return np.stack([self._layer[0] * τx + self._layer[1] * τy, self._layer[1] * τx + self._layer[2] * τy])

        def respond(traction: np.ndarray) -> np.ndarray:
            return plane_displacement(amplitudes(traction), window)

        motion, bound = goal, friction * pressure_at(goal.at(place), place)
        largest = _largest_compliance(respond, bound > 0.0)
        if not largest > 0.0:
            return None
        traction, solution = np.zeros((2, *bound.shape), np.float32), None
        for _ in range(settings.slip_iterations):
            target = np.moveaxis(motion.at(place), -1, 0)
            traction = _projected_gradients(
                traction, target, bound.astype(np.float32), 1.0 / largest, respond, settings.traction_iterations
            )
            waves = amplitudes(traction)
            displacement = plane_displacement(waves, window)
            solution = TangentialContact(place, traction, bound, displacement, waves)
            mean = PlaneMotion.fit(np.moveaxis(displacement, 0, -1).reshape(-1, 2), place.reshape(-1, 2), bound.ravel())
            inside = place[bound > 0.0]
            error = goal.at(inside) - mean.at(inside)
            sticks = np.hypot(*traction) < 0.999 * bound
            slip = np.hypot(*(displacement - target))[sticks].max(initial=0.0)
            if np.abs(error).max() < settings.motion_tolerance and slip < settings.stick_tolerance:
                break
            if sticks.sum() < settings.sliding_share * len(inside):
                friction *= max(float((goal.at(inside) ** 2).sum() / (goal.at(inside) * mean.at(inside)).sum()), 1.0)
            motion = motion.plus(goal, mean)
            bound = friction * np.where(loaded, pressure_at(np.moveaxis(displacement, 0, -1), place), 0.0)
            if not (bound > 0.0).any():
                break
        return solution

    def _blend(self, layer: np.ndarray, displacement: np.ndarray, weight: np.ndarray) -> float:
        """Weight of the correction in [0, 1]: less, the less the ``layer`` explains."""
        s = self._settings
        error, size = (float(weight @ (field**2).sum(axis=1)) for field in (layer - displacement, displacement))
        missed = np.sqrt(error / (size + weight.sum() * s.small_motion**2))
        return float(np.clip((s.no_blend - missed) / (s.no_blend - s.full_blend), 0.0, 1.0))

    def _mesh_forces(self, compliance: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Forces [N] whose linear response is ``displacement`` [m], (n,), by conjugate gradients.

        Unknowns that cannot move (the pad's sides across themselves, whose rows of ``compliance`` are 0) have no force.
        """
        free = np.diagonal(compliance) > 0.0
        A, b = np.ascontiguousarray(compliance[np.ix_(free, free)]), displacement[free]
        x, r, p = np.zeros_like(b), b.copy(), b.copy()
        rr = float(r @ r)
        for _ in range(self._settings.force_iterations):
            if np.abs(r).max(initial=0.0) < self._settings.motion_tolerance:
                break
            Ap = product(A, p[:, None])[:, 0]
            pAp = float(p @ Ap)
            if not pAp > 0.0:  # only rounding of float32 remains
                break
            alpha = np.float32(rr / pAp)
            x, r = x + alpha * p, r - alpha * Ap
            rr, last = float(r @ r), rr
            beta = np.float32(rr / last)
            p = r + beta * p
        force = np.zeros_like(displacement)
        force[free] = x
        return force


def _projected_gradients(
    τ: np.ndarray, target: np.ndarray, bound: np.ndarray, step: float, respond: Response, iterations: int
) -> np.ndarray:
    """Traction |τ| <= ``bound`` (n, m) whose response approaches ``target`` (2, n, m).

    Accelerated projected gradients with restarts (B. O'Donoghue and E. Candès, Found. Comput. Math. 15, 2015).
    """
    τ = y = _project(τ, bound)
    t = 1.0
    for _ in range(iterations):
        new = _project(y - step * (respond(y) - target), bound)
        if float(((y - new) * (new - τ)).sum()) > 0.0:
            t = 1.0
        t_new = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        y = new + (t - 1.0) / t_new * (new - τ)
        τ, t = new, t_new
    return τ


def _project(traction: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Traction (2, n, m) shortened to the ``bound`` (n, m) >= 0, in its own direction."""
    size = np.hypot(*traction)
    return (traction * np.minimum(1.0, bound / np.maximum(size, 1e-12))).astype(np.float32)


def _largest_compliance(respond: Response, inside: np.ndarray) -> float:
    """Bound of displacement over traction [m/Pa], by power iteration; 0 if nothing can move."""
    trial = np.stack([inside, inside]).astype(np.float32)
    size = 0.0
    for _ in range(3):
        response = respond(trial) * inside
        if not response.any():
            return 0.0
        size = float(np.linalg.norm(response) / np.linalg.norm(trial))
        trial = response / np.float32(np.abs(response).max())
    return 1.15 * size


class TangentialCorrection:
    """Corrects the skin's spread under pressure and its drag by friction, one pad at a time.

    Nearly incompressible gel moves sideways under pressure. A mesh whose cells are as wide as the contact pushes it out far too much.
    Let E be what the mesh does sideways under the normal forces of ``NormalContact``, and L the layer's own response to the pressure on the
    fine grid. Friction has let only a share θ of that spread happen, and the rest of the solver's displacement u (shear, twist) says
    nothing of it. So the skin's displacement becomes

        u − θ (E − L),   θ = ⟨u, E⟩ / ⟨E, E⟩ within [0, 1],

    with products over the vertices in contact, after their rigid motions were removed (u contains the object's shear and twist). Without
    friction, u is E but for large strain, and θ is 1, as where only one vertex touches. A contact that sticks from the first has
    θ = 0. The finer the mesh, the smaller is E − L. One θ holds for all of a pad's contact.

    The remainder in contact, u − θ E, is due to friction. How far the skin around follows it is corrected by ``FrictionCorrection``.
    """

    def __init__(self, normal: NormalCorrection, gelpad: GelpadSpec, compliance: np.ndarray, continued: np.ndarray) -> None:
        """Prepare the grid of sideways displacements.

        Args:
            compliance: displacements along x, y, z of the vertices over a force along z on each [m/N], (3, V, V).
            continued: the same over a force along x, y, z (first axis) if the pad's sides may not move outwards, (3, 3, V, V).
        """
        self._friction = FrictionCorrection(normal, gelpad, continued[:2, :2])
        self._normal, self._settings = normal, normal.settings
        self._mesh = compliance[:2].astype(np.float32)
        self._sides = (compliance[:2] - continued[2, :2]).astype(np.float32)
        pitch = self._settings.tangential_pitch
        self._x, self._y = (t[:: max(round(pitch / (t[1] - t[0])), 1)] for t in (normal.x, normal.y))
        series_x, series_y = normal.series_x, normal.series_y
        resolved = tuple(s.wave_numbers * (t[1] - t[0]) <= np.pi for s, t in ((series_y, self._y), (series_x, self._x)))
        self._resolved = np.ix_(*resolved)
        (k_y, hat_y), (k_x, hat_x) = (
            s.hats(np.flatnonzero(np.ravel(k))) for s, k in zip((series_y, series_x), resolved, strict=True)
        )
        k = np.hypot(k_x[None, :], k_y[:, None])
        ratio = layer_spread(k, gelpad) * (hat_y[:, None] * hat_x) / np.maximum(k, k_x[1])
        self._spread = np.stack([ratio * k_x, ratio * k_y[:, None]]).astype(np.float32)
        over_x, over_y = plane_waves(series_x, series_y, self._x, self._y)
        self._lines = tuple(np.asfortranarray(m[: len(k_x)]) for m in over_x), tuple(m[:, : len(k_y)] for m in over_y)

    def sideways(
        self, contact: NormalContact, displacement: np.ndarray, load: np.ndarray, friction: float | None = None
    ) -> np.ndarray:
        """Corrected displacement along x, y [m], (V, 2).

        Args:
            contact: solution of the normal stage.
            displacement: u of the solver's vertices [m], (V, 3).
            load: normal force on each [N], (V,).
            friction: μ; None or 0 leaves the effect of friction as the mesh has it.
        """
        rest, touching = self._normal.surface.mesh.rest, self._normal.touching(load)
        u = displacement[:, :2]
        mesh = product(self._mesh.reshape(-1, len(rest)), contact.mesh_forces[:, None]).reshape(2, -1).T
        θ = _share(mesh[touching], u[touching], rest[touching, :2])
        corrected = u.copy()
        if self._settings.tangential:
            corrected -= θ * (mesh - self._layer(contact, rest[:, 0] + u[:, 0], rest[:, 1] + u[:, 1]))
        if self._settings.friction and friction:
            corrected += self._friction.correct(contact, u - θ * mesh, touching, load, friction)
        return corrected

    def _layer(self, contact: NormalContact, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """L: sideways displacement of the layer under the fine grid's pressure [m], (V, 2)."""
        field = plane_displacement(self._spread * contact.waves[self._resolved], self._lines)
        force = sandwich(self._normal.force_y, contact.pressure, self._normal.force_x).reshape(-1, 1)
        sides = product(self._sides.reshape(-1, len(force)), force).reshape(2, -1)
        return (sampled(field, self._x, self._y, x, y) - sides).T


def _share(pattern: np.ndarray, displacement: np.ndarray, place: np.ndarray) -> float:
    """Share in [0, 1] of a ``pattern`` (T, 2) in a ``displacement``, besides rigid motions."""
    displacement = displacement - PlaneMotion.fit(displacement, place, np.ones(len(place))).at(place)
    arm = place - place.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    turn /= max(float(np.linalg.norm(turn)), 1e-12)

    def without_rigid(field: np.ndarray) -> np.ndarray:
        field = field - field.mean(axis=0)
        return field - (field * turn).sum() * turn

    pattern, displacement = without_rigid(pattern), without_rigid(displacement)
    size = float((pattern**2).sum())
    return float(np.clip((pattern * displacement).sum() / size, 0.0, 1.0)) if size > 0.0 else 1.0
