"""Correction of how far the skin follows an object by friction, for B pads."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.physics.bonded_layer import layer_shear
from raytac.physics.soft.correction import friction_kernels as kernels
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.physics.soft.correction.normal import NormalCorrection
from raytac.physics.soft.correction.plane_kernels import Moments, PlaneMotion
from raytac.physics.soft.correction.plane_waves import PlaneField, PlaneWaves, node_lines
from raytac.physics.soft.correction.vertex_forces import VertexForces
from raytac.physics.soft.undersides import Touched
from raytac.specs.sensor import GelpadSpec

_TRIALS = 3
"""Steps of the power iteration for the greatest compliance."""


class FrictionCorrection:
    """Exchanges the mesh's response to friction for the layer's (*defect correction*).

    Let v be the sideways displacement that friction has given to the vertices in contact. E q is what *the same mesh* does, by linear
    elasticity, under tangential forces q on these vertices that hold them at v. A τ is what *the gel layer* does under a traction τ on
    a fine grid. The skin's displacement u becomes

        u − E q + A τ,   A τ = D where the contact sticks,   |τ| ≤ μ p everywhere, with τ along the slip at the limit,

    with the pressure p of ``NormalCorrection``. So the contact's edge slips as in C. Cattaneo (1938) and R. D. Mindlin (J. Appl. Mech. 16,
    1949): one coefficient for the whole contact, one loading, no history. D is a rigid motion. It makes the mean of A τ over the contact
    (shift and rotation, weighted by p) equal to that of v weighted by the mesh's normal forces, since that mean hardly depends on the
    mesh. Where everything slides and the mean is still too small, μ p is raised in proportion: small strain underestimates the pressure.
    Where the contact does not move as such a one would (a bar that ploughs its ends through the gel as it turns), the correction is
    left out, as far as A τ misses v: fully up to ``full_blend``, not at all from ``no_blend``.

    The pad is continued by its mirror image in A, whose law for one wave is ``layer_shear``, and E is of a mesh with such sides. Both drag
    the gel by nearly the same force, so the effect of the true sides stays in u. The traction is solved for by accelerated projected
    gradients with restarts (B. O'Donoghue and E. Candès, Found. Comput. Math. 15, 2015).

    Attributes of the last ``correct``:
        contact: motions, windows, and where friction was corrected (``chosen``).
        traction: of the object on the skin [Pa], on ``x``, ``y``.
        waves: amplitudes of A τ [m].
    """

    def __init__(self, normal: NormalCorrection, gelpad: GelpadSpec, compliance: np.ndarray) -> None:
        """Prepare the tangential grid.

        ``compliance``: displacement along x, y of each vertex over a force along x, y (first axis) on each [m/N], (2, 2, V, V), for a mesh
        whose sides may not move outwards.
        """
        self._normal, self._settings, products = normal, normal.settings, normal.products
        self._products, device = products, products.device
        ends, pitch = [(t[0], t[-1]) for t in (normal.x, normal.y)], self._settings.tangential_pitch
        self.x, self.y = (np.linspace(low, high, round((high - low) / pitch) + 1) for low, high in ends)
        x, y = CosineSeries(self.x), CosineSeries(self.y)
        k = np.hypot(x.wave_numbers[None, :], y.wave_numbers[:, None])
        least = np.maximum(k, x.wave_numbers[1] * 1e-9)
        cos_x, cos_y = x.wave_numbers[None, :] / least, y.wave_numbers[:, None] / least
        hats = y.hats(np.arange(len(self.y)))[1][:, None] * x.hats(np.arange(len(self.x)))[1]
        along, across = (law * hats for law in layer_shear(k, gelpad))
        excess = along - across
        laws = across + excess * cos_x**2, across + excess * cos_y**2, excess * cos_x * cos_y
        self._laws = [products.constant(law).numbers for law in laws]
        constant = products.constant
        self._to_cos_x, self._to_sin_x = constant(x.analysis.T), constant(x.sine_analysis.T)
        self._to_cos_y, self._to_sin_y = constant(y.analysis), constant(y.sine_analysis)
        self._at_nodes = PlaneWaves((x, y), self.x, self.y, products)
        mesh, shape = normal.surface.mesh, (len(self.y), len(self.x))
        self._at_vertices = PlaneWaves((x, y), mesh.lines_x, mesh.lines_y, products)
        self._spare = products.zeros(*shape)
        self.waves, self.traction, self._new, self._trial, self._moved = (PlaneField.zeros(products, *shape) for _ in range(5))
        self._bound, self._layer = products.zeros(*shape), PlaneField.zeros(products, *mesh.shape)
        # Unknown c V + i: component c of vertex i.
        n = 2 * len(mesh.rest)
        self._holding = VertexForces(compliance.transpose(1, 2, 0, 3).reshape(n, n), products)
        self._nodes, self._fine = node_lines(self.x, self.y), node_lines(normal.x, normal.y)
        count, rows = products.num_envs, shape[0]
        contact: Any = kernels.Contact()
        for name, dtype in _CONTACT.items():
            setattr(contact, name, wp.zeros(count, dtype=dtype, device=device))
        self.contact = contact
        self._loaded = wp.zeros((count, *shape), dtype=wp.int32, device=device)
        self._near, self._any = (wp.zeros((count, rows), dtype=dtype, device=device) for dtype in (wp.vec2i, wp.int32))
        self._far = wp.zeros((count, rows), dtype=wp.float64, device=device)
        self._sums = wp.zeros((count, rows), dtype=Moments, device=device)
        self._pressures = wp.zeros((count, len(normal.y)), dtype=wp.float32, device=device)
        self._go = wp.zeros(1, dtype=wp.int32, device=device)

    def correct(self, dragged: wp.array, objects: Touched, sideways: wp.array) -> None:
        """Launch the addition of A τ − E q to ``sideways``.

        It comes after the solution of the normal contact. ``dragged``: v [m]; both (B, 2 V), float64, all x and then all y.
        """
        s, normal, settings = self.contact, self._normal, self._settings
        pads, each = len(self._sums), self._sums.shape
        fine, bound = normal.pressure.numbers, self._bound.numbers
        chosen = [normal.search.touched, normal.touching, objects.touching, objects.friction, normal.load, dragged]
        mesh = [normal.surface.struct.rest, self._holding.can_move, settings.motion_tolerance]
        self._launch(kernels.choose_contacts, pads, [*chosen, *mesh, s, self._holding.unknowns])
        self._launch(kernels.greatest_pressure, self._pressures.shape, [fine, s.active, self._pressures])
        self._launch(kernels.least_pressure, pads, [self._pressures, settings.least_load, s])
        loaded = [self._loaded, bound, self._near, self._far]
        self._launch(kernels.load_nodes, each, [s, self._fine, fine, self._nodes, *loaded])
        self._launch(kernels.choose_windows, pads, [self._near, self._far, self._nodes, s])
        self._launch(kernels.put, 1, [0, self._go])
        self._launch(kernels.begin_search, pads, [s, self._go])
        with wp.ScopedDevice(self._products.device):
            wp.capture_if(self._go, self._search)
        amplitudes = [self.waves.x.numbers, self.waves.y.numbers]
        self._launch(kernels.clear_unsolved, each, [s, *amplitudes])
        self._at_vertices.displacement(self.waves, self._layer, s.chosen)
        wp.copy(self._holding.wanted, dragged)
        self._holding.solve(settings.motion_tolerance, settings.force_iterations)
        layer = [self._layer.x.numbers, self._layer.y.numbers, self._holding.response()]
        blend = [settings.full_blend, settings.no_blend, settings.small_motion]
        self._launch(kernels.blend, pads, [s, normal.touching, normal.load, dragged, *layer, *blend, sideways])

    def _search(self) -> None:
        """Launch the search for the traction, by fixed points between it and its limits."""
        s, pads, each, bound = self.contact, len(self._sums), self._sums.shape, self._bound.numbers
        tried = [self._trial.x.numbers, self._trial.y.numbers]
        moved = [self._moved.x.numbers, self._moved.y.numbers]
        self._launch(kernels.begin, each, [s, bound, self.traction.x.numbers, self.traction.y.numbers, *tried])
        for _ in range(_TRIALS):
            self._respond(self._trial)
            self._launch(kernels.trial_sums, each, [s, bound, *moved, *tried, self._sums])
            self._launch(kernels.trial_sizes, pads, [self._sums, s])
            self._launch(kernels.next_trial, each, [s, bound, *moved, *tried])
        wp.capture_while(self._go, self._iterate)

    def _iterate(self) -> None:
        """Launch the traction under the present limits, and the motion and the limits that follow."""
        s, settings, pads, each, bound = self.contact, self._settings, len(self._sums), self._sums.shape, self._bound.numbers
        traction, moved, new, y = (
            [field.x.numbers, field.y.numbers] for field in (self.traction, self._moved, self._new, self._trial)
        )
        self._launch(kernels.begin_gradients, each, [s, bound, *traction, *y])
        for _ in range(settings.traction_iterations):
            self._respond(self._trial)
            self._launch(kernels.gradient_step, each, [s, self._nodes, bound, *moved, *y, *traction, *new, self._sums])
            self._launch(kernels.accelerate, pads, [self._sums, s])
            self._launch(kernels.advance, each, [s, *new, *traction, *y])
        self._respond(self.traction)
        self._launch(kernels.mean_sums, each, [s, self._nodes, bound, *moved, self._sums])
        self._launch(kernels.find_means, pads, [self._sums, s])
        self._launch(kernels.slip_sums, each, [s, self._nodes, bound, *moved, *traction, self._sums])
        limits = [settings.motion_tolerance, settings.stick_tolerance, settings.sliding_share, settings.slip_iterations]
        self._launch(kernels.judge, pads, [self._sums, *limits, s])
        fields = [self._fine, self._normal.pressure.numbers, self._nodes, self._loaded]
        self._launch(kernels.next_bounds, each, [s, *fields, *moved, bound, self._any])
        self._launch(kernels.put, 1, [0, self._go])
        self._launch(kernels.go_on, pads, [self._any, s, self._go])

    def _respond(self, traction: PlaneField) -> None:
        """Launch A τ [m] within the windows, and its amplitudes ``waves``."""
        s, multiply = self.contact, self._products.multiply
        for to_y, to_x, field, wave in (
            (self._to_cos_y, self._to_sin_x, traction.x, self.waves.x),
            (self._to_sin_y, self._to_cos_x, traction.y, self.waves.y),
        ):
            multiply(to_y, field, self._spare, inner=s.rows, columns=s.columns, active=s.active)
            multiply(self._spare, to_x, wave, inner=s.columns, active=s.active)
        self._launch(kernels.mix, self._sums.shape, [s.active, *self._laws, self.waves.x.numbers, self.waves.y.numbers])
        self._at_nodes.displacement(self.waves, self._moved, s.active, (s.rows, s.columns))

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._products.device)


_CONTACT = {
    "chosen": wp.int32, "active": wp.int32, "failed": wp.int32, "rows": wp.vec2i, "columns": wp.vec2i, "goal": PlaneMotion,
    "motion": PlaneMotion, "mean": PlaneMotion, "friction": wp.float64, "least": wp.float64, "size": wp.float64, "t": wp.float64,
    "share": wp.float32, "count": wp.int32,
}  # fmt: skip
