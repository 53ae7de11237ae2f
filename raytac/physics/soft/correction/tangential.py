"""Correction of the sideways displacement of the coat's vertices by pressure, for B pads."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.physics.bonded_layer import layer_spread
from raytac.physics.soft.correction import force_kernels
from raytac.physics.soft.correction import tangential_kernels as kernels
from raytac.physics.soft.correction.friction import FrictionCorrection
from raytac.physics.soft.correction.normal import NormalCorrection
from raytac.physics.soft.correction.plane_waves import PlaneField, PlaneWaves, node_lines
from raytac.physics.soft.undersides import Touched
from raytac.specs.sensor import GelpadSpec


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
        self._launch(kernels.find_shares, len(self.share), shares)
        if settings.tangential:
            amplitudes = [normal.waves.numbers, self._waves.x.numbers, self._waves.y.numbers]
            self._launch(kernels.spread_waves, (len(active), self._waves.x.shape[0]), [active, *self._spread, *amplitudes])
            self._synthesis.displacement(self._waves, self._field, active)
            self._products.multiply(normal.forces, self._side_law, self._sides)
        field = [self._field.x.numbers, self._field.y.numbers, self._sides.numbers]
        inputs = [active, int(settings.tangential), rest, self._lines, *field, moved, self._response, self.share]
        self._launch(kernels.correct_spread, (len(active), vertices), [*inputs, self.displacement, self._dragged])
        if self._friction is not None:
            self._friction.correct(self._dragged, objects, self.displacement)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._products.device)
