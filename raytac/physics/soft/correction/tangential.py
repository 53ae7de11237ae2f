"""Correction of the sideways displacement of the coat's vertices by pressure, for B pads."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.physics.bonded_layer import layer_spread
from raytac.physics.soft.correction import force_kernels
from raytac.physics.soft.correction.friction import FrictionCorrection
from raytac.physics.soft.correction.normal import NormalCorrection
from raytac.physics.soft.correction.plane_kernels import Lines, Moments, displaced, fit, moments, sampled
from raytac.physics.soft.correction.plane_waves import PlaneField, PlaneWaves, node_lines
from raytac.physics.soft.undersides import Touched
from raytac.specs.sensor import GelpadSpec

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def vector(values: wp.array2d(dtype=wp.float64), env: wp.int32, v: wp.int32, vertices: wp.int32) -> wp.vec2d:
    """Entries of a vertex in numbers along x and then y, (B, 2 V)."""
    return wp.vec2d(values[env, v], values[env, vertices + v])


@wp.func
def moved(values: wp.array3d(dtype=wp.float64), env: wp.int32, v: wp.int32) -> wp.vec2d:
    return wp.vec2d(values[env, 0, v], values[env, 1, v])


@wp.kernel
def find_shares(
    touched: wp.array(dtype=wp.int32), touching: wp.array2d(dtype=wp.int32), rest: wp.array(dtype=wp.vec3d),
    displacement: wp.array3d(dtype=wp.float64), pattern: wp.array2d(dtype=wp.float64),
    # outputs
    share: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Share in [0, 1] of a ``pattern`` (B, 2 V) in the displacement of what touches.

    Rigid motions are taken out of both.
    """
    env = wp.tid()
    share[env] = _0
    if touched[env] == 0:
        return
    vertices, total = len(rest), Moments()
    for v in range(vertices):
        if touching[env, v] != 0:
            total += moments(_1, wp.vec2d(rest[v][0], rest[v][1]), moved(displacement, env, v))
    count = total[0]
    if not (count > _0):
        share[env] = _1
        return
    motion, middle = fit(total), wp.vec2d(total[1] / count, total[2] / count)
    mean_u, mean_p, size, turn_u, turn_p = wp.vec2d(), wp.vec2d(), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            place = wp.vec2d(rest[v][0], rest[v][1])
            u, p, arm = moved(displacement, env, v) - displaced(motion, place), vector(pattern, env, v, vertices), place - middle
            mean_u += u / count
            mean_p += p / count
            size += wp.length_sq(arm)
            # The arms sum to 0, so means have no part in these.
            turn_u += arm[0] * u[1] - arm[1] * u[0]
            turn_p += arm[0] * p[1] - arm[1] * p[0]
    size = wp.max(size, wp.float64(1e-24))
    pu, pp = wp.float64(0.0), wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            place = wp.vec2d(rest[v][0], rest[v][1])
            arm = place - middle
            turn = wp.vec2d(-arm[1], arm[0])
            u = moved(displacement, env, v) - displaced(motion, place) - mean_u - (turn_u / size) * turn
            p = vector(pattern, env, v, vertices) - mean_p - (turn_p / size) * turn
            pu += wp.dot(p, u)
            pp += wp.dot(p, p)
    share[env] = wp.where(pp > _0, wp.clamp(pu / pp, _0, _1), _1)


@wp.kernel
def spread_waves(
    active: wp.array(dtype=wp.int32), spread_x: wp.array3d(dtype=wp.float32), spread_y: wp.array3d(dtype=wp.float32),
    waves: wp.array3d(dtype=wp.float32),
    # outputs
    x: wp.array3d(dtype=wp.float32),
    y: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Amplitudes of the layer's displacement sideways under pressure, by (environment, row)."""
    env, row = wp.tid()
    if active[env] == 0:
        return
    i, end = wp.int32(0), x.shape[2]
    while i < end:
        x[env, row, i] = spread_x[0, row, i] * waves[env, row, i]
        y[env, row, i] = spread_y[0, row, i] * waves[env, row, i]
        i += 1


@wp.kernel
def correct_spread(
    touched: wp.array(dtype=wp.int32), corrects: wp.int32, rest: wp.array(dtype=wp.vec3d), lines: Lines,
    field_x: wp.array3d(dtype=wp.float32), field_y: wp.array3d(dtype=wp.float32), sides: wp.array3d(dtype=wp.float32),
    displacement: wp.array3d(dtype=wp.float64), mesh: wp.array2d(dtype=wp.float64), share: wp.array(dtype=wp.float64),
    # outputs
    sideways: wp.array2d(dtype=wp.float64),
    dragged: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Displacement u − θ (E − L) and what friction has dragged, u − θ E, (B, 2 V) [m].

    By (environment, vertex).
    """
    env, v = wp.tid()
    vertices = len(rest)
    u = moved(displacement, env, v)
    result, drag = wp.vec2d(u[0], u[1]), wp.vec2d(u[0], u[1])
    if touched[env] != 0:
        θ = share[env]
        E = vector(mesh, env, v, vertices)
        drag = u - θ * E
        if corrects != 0:
            place = wp.vec2d(rest[v][0], rest[v][1]) + u
            L = wp.vec2d(
                sampled(field_x, env, lines, place) - wp.float64(sides[0, env, v]),
                sampled(field_y, env, lines, place) - wp.float64(sides[0, env, vertices + v]),
            )
            result = u - θ * (E - L)
    sideways[env, v] = result[0]
    sideways[env, vertices + v] = result[1]
    dragged[env, v] = drag[0]
    dragged[env, vertices + v] = drag[1]


class TangentialCorrection:
    """Corrects the skin's spread under pressure and its drag by friction.

    Nearly incompressible gel moves sideways under pressure. A mesh whose cells are as wide as the contact pushes it out far too much.
    Let E be what the mesh does sideways under the normal forces of ``NormalCorrection``, and L the layer's own response to the pressure on
    the fine grid. Friction has let only a share θ of that spread happen, and the rest of the solver's displacement u (shear, twist) says
    nothing of it. So the skin's displacement becomes

        u − θ (E − L),   θ = ⟨u, E⟩ / ⟨E, E⟩ within [0, 1],

    with products over the vertices in contact, after their rigid motions were removed (u contains the object's shear and twist). Without
    friction, u is E but for large strain, and θ is 1, as where only one vertex touches. A contact that sticks from the first has
    θ = 0. The finer the mesh, the smaller is E − L. One θ holds for all of a pad's contact.

    The remainder in contact, u − θ E, is due to friction. How far the skin around follows it is corrected by ``FrictionCorrection``.

    Attributes:
        displacement: of the vertices, corrected, (B, 2 V), float64 [m], all x and then all y, of the last ``correct``.
        share: θ, (B,), float64.
    """

    def __init__(self, normal: NormalCorrection, gelpad: GelpadSpec, compliance: np.ndarray, continued: np.ndarray) -> None:
        """Prepare the grid of sideways displacements.

        Args:
            compliance: displacements along x, y, z of the vertices over a force along z on each [m/N], (3, V, V).
            continued: the same over a force along x, y, z (first axis) if the pad's sides may not move outwards, (3, 3, V, V).
        """
        self._normal, self._settings, products = normal, normal.settings, normal.products
        self._products, device, vertices = products, products.device, len(compliance[0])
        self._friction = FrictionCorrection(normal, gelpad, continued[:2, :2]) if self._settings.friction else None
        self._mesh = wp.array(compliance[:2].reshape(2 * vertices, vertices), dtype=wp.float64, device=device)
        self._side_law = products.constant((compliance[:2] - continued[2, :2]).reshape(2 * vertices, vertices).T)
        pitch = self._settings.tangential_pitch
        x, y = (t[:: max(round(pitch / (t[1] - t[0])), 1)] for t in (normal.x, normal.y))
        series = normal.series_x, normal.series_y
        resolved = [int((one.wave_numbers * (t[1] - t[0]) <= np.pi).sum()) for one, t in zip(series, (x, y), strict=True)]
        (k_x, hat_x), (k_y, hat_y) = (one.hats(np.arange(count)) for one, count in zip(series, resolved, strict=True))
        k = np.hypot(k_x[None, :], k_y[:, None])
        ratio = layer_spread(k, gelpad) * (hat_y[:, None] * hat_x) / np.maximum(k, k_x[1])
        self._spread = [products.constant(ratio * along).numbers for along in (k_x, k_y[:, None])]
        shape = len(k_y), len(k_x)
        self._synthesis, self._lines = PlaneWaves(series, x, y, products, shape), node_lines(x, y)
        self._waves, self._field = PlaneField.zeros(products, *shape), PlaneField.zeros(products, len(y), len(x))
        self._sides = products.zeros(products.num_envs, 2 * vertices, num_envs=1)
        count = products.num_envs
        self._response, self.displacement, self._dragged = (
            wp.zeros((count, 2 * vertices), dtype=wp.float64, device=device) for _ in range(3)
        )
        self.share = wp.zeros(count, dtype=wp.float64, device=device)

    def correct(self, objects: Touched) -> None:
        """Launch the correction, after the solution of the normal contact."""
        normal, settings, active = self._normal, self._settings, self._normal.search.touched
        rest, moved, vertices = normal.surface.struct.rest, normal.surface.displacement, len(normal.surface.mesh.rest)
        inputs = [self._mesh, normal.holding.unknowns, normal.mesh_forces, self._response]
        self._launch(force_kernels.respond, self._response.shape, inputs)
        shares = [active, normal.touching, rest, moved, self._response, self.share]
        self._launch(find_shares, len(self.share), shares)
        if settings.tangential:
            amplitudes = [normal.waves.numbers, self._waves.x.numbers, self._waves.y.numbers]
            self._launch(spread_waves, (len(active), self._waves.x.shape[0]), [active, *self._spread, *amplitudes])
            self._synthesis.displacement(self._waves, self._field, active)
            self._products.multiply(normal.forces, self._side_law, self._sides)
        field = [self._field.x.numbers, self._field.y.numbers, self._sides.numbers]
        inputs = [active, int(settings.tangential), rest, self._lines, *field, moved, self._response, self.share]
        self._launch(correct_spread, (len(active), vertices), [*inputs, self.displacement, self._dragged])
        if self._friction is not None:
            self._friction.correct(self._dragged, objects, self.displacement)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._products.device)
