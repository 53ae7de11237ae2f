"""Reading of soft pads: surface, contact and forces from the solver's state, on its device."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.products import Matrices, Products
from raytac.gel.surface import GelSurface, PadGrid, make_grid
from raytac.physics.soft import reading_kernels as kernels
from raytac.physics.soft.clearance import BarrierClearance, hat_arrays
from raytac.physics.soft.coat_state import CoatState
from raytac.physics.soft.coat_surface import CoatSurface
from raytac.physics.soft.correction import normal_kernels
from raytac.physics.soft.correction.mesh_compliance import correction_compliances
from raytac.physics.soft.correction.normal import ContactSampler, NormalCorrection
from raytac.physics.soft.correction.plane_waves import node_lines
from raytac.physics.soft.correction.tangential import TangentialCorrection
from raytac.physics.soft.mesh import PadMesh
from raytac.physics.soft.settings import DEFAULT_CORRECTION, Correction
from raytac.physics.soft.undersides import Undersides
from raytac.specs.sensor import GelpadSpec
from raytac.warp_runtime import LAUNCH, HostArrays, Recorded, start_warp

_SAMPLE = 0.2e-3
"""Spacing of the samples at which the clearance is measured [m]."""


class UnsolvedContactWarning(UserWarning):
    """The search for the contact below the size of a cell ended before it converged."""


@dataclass(frozen=True)
class SoftReading:
    """B pads as they are shown; pad frame."""

    surface: GelSurface
    """Its ``coat`` is the height shown: the solver's vertices with the correction, if any."""
    vertices: np.ndarray
    """The solver's own vertices of the coat [m], shape (B, V, 3): where ``forces`` act."""
    forces: np.ndarray
    """Contact force on each vertex of the coat [N], shape (B, V, 3)."""
    clearance: np.ndarray
    """Mean distance that the barrier kept [m], shape (B,); NaN out of contact."""
    poses: tuple[np.ndarray, ...]
    """``pad_from_object`` (B, 4, 4) of each object, rigid ones first, lowered by the clearance."""
    underside: np.ndarray
    """Underside of the objects over the grid [m], (B, Ny, Nx), inf where there is none.

    Rigid parts wholly above the pad's highest point may be missing."""
    residual: np.ndarray
    """Deepest overlap or widest gap under pressure [m], (B,), of the corrected contact.

    It is taken before the coat is laid on the object; NaN out of contact, or without correction."""
    failed: np.ndarray
    """Environments of which nothing is shown, (B,) bool: they failed, or are not finite."""


@dataclass(frozen=True)
class PadArrays:
    """B pads as they are shown, as arrays of the device; the next reading overwrites them."""

    height: wp.array
    """z of the surface, pad frame [m], (B, Ny, Nx), float32.

    This and the next five are NaN or 0 where ``failed``."""
    contact: wp.array
    """1 where an object touches, (B, Ny, Nx), uint8."""
    centre: wp.array
    """Mean place of the normal load [m], (B,) of ``vec2d``; NaN out of contact."""
    coat: wp.array
    """Vertices of the coat as they are shown [m], (B, V) of ``vec3d``."""
    clearance: wp.array
    """As of ``SoftReading``, (B,), float64."""
    residual: wp.array
    """As of ``SoftReading``, (B,), float64."""
    underside: wp.array
    """As of ``SoftReading``, (B, Ny, Nx), float64."""
    vertices: wp.array
    """The solver's own vertices of the coat [m], (B, V) of ``vec3d``."""
    forces: wp.array
    """Contact force on each of them [N], (B, V) of ``vec3d``."""
    failed: wp.array
    """Environments of which nothing is shown, (B,), bool."""


class SoftReader:
    """Reads one kind of pad, whatever touches it: one object or several, rigid or soft.

    All environments are read at once, by kernels on the device that holds their state.
    """

    def __init__(
        self, mesh: PadMesh, gelpad: GelpadSpec, grid: PadGrid, correction: Correction | None = DEFAULT_CORRECTION
    ) -> None:
        """Show surfaces on ``grid``; without ``correction`` the spline through the vertices."""
        start_warp()
        self.mesh, self.grid, self.correction, self._gelpad = mesh, grid, correction, gelpad
        self._batches: dict[tuple[int, str], _Batch] = {}
        self._warned = False

    def clearance(self, state: CoatState) -> np.ndarray:
        """Mean distance that the barrier keeps [m], shape (B,), NaN out of contact; a copy."""
        with LAUNCH:
            return self._batch(state).measure(state).numpy().copy()

    def launch(self, state: CoatState, failed: wp.array) -> PadArrays:
        """Read every pad on the device but where ``failed`` (B,); nothing is copied.

        The next reading overwrites the arrays. From the second reading of one state on, all kernels are launched as one recording.
        """
        with LAUNCH:
            batch = self._batch(state)
            wp.copy(batch.unread, failed)
            return batch.read(state)

    def read(self, state: CoatState, failed: np.ndarray) -> SoftReading:
        """Surface, contact and forces of every pad, copied; NaN where ``failed`` (B,) or not finite."""
        with LAUNCH:
            batch = self._batch(state)
            batch.leave_out(failed)
            batch.read(state)
            failed, clearance, residual, centre, coat, vertices, forces, *on_grid, poses, touching = batch.copies(state)
        height, contact, underside = on_grid
        poses[:, :, 2, 3] -= np.nan_to_num(clearance)[:, None]
        for values in (vertices, forces, poses):
            values[failed] = np.nan
        self._warn(residual)
        pose = None
        if poses.shape[1]:
            first = np.where(touching.any(axis=1), touching.argmax(axis=1), 0)  # object that touches, else the first
            pose = poses[np.arange(len(poses)), first]
        surface = GelSurface(self.grid, height, contact.view(bool), centre, pose, DeformedCoat(self.mesh.coat, coat))
        by_object = tuple(poses[:, k].copy() for k in range(poses.shape[1]))
        return SoftReading(surface, vertices, forces, clearance, by_object, underside, residual, failed)

    def _batch(self, state: CoatState) -> _Batch:
        """Arrays for as many environments as the state has, on its device."""
        key = len(state.vertices), str(state.vertices.device)
        if key not in self._batches:
            self._batches[key] = _Batch(self, *key)
        return self._batches[key]

    def _warn(self, residual: np.ndarray) -> None:
        """Warn once of a contact that was not solved."""
        worst = float(np.nanmax(residual, initial=0.0))
        if self.correction is not None and worst > self.correction.unsolved and not self._warned:
            self._warned = True
            warnings.warn(
                f"the contact below the size of a cell was left {1e6 * worst:.1f} µm from its solution, more than "
                f"{1e6 * self.correction.unsolved:g} µm: the shown coat is laid on the object where it touches, and off by about so much "
                "around it",
                UnsolvedContactWarning,
                stacklevel=3,
            )

    @property
    def gelpad(self) -> GelpadSpec:
        """Gelpad of the pads."""
        return self._gelpad

    @cached_property
    def fine_grid(self) -> PadGrid:
        """Grid on which contact below the size of a cell is solved."""
        correction = self.correction
        if correction is None or min(self.grid.pitch) > 0.9 * correction.pitch:
            return self.grid
        return make_grid(self._gelpad, correction.pitch)

    @cached_property
    def compliances(self) -> tuple[np.ndarray, np.ndarray]:
        """``correction_compliances`` of the mesh; the first of a mesh take a while."""
        return correction_compliances(self.mesh, self._gelpad)


class _Batch:
    """Arrays and kernels of a reader for B pads of one device.

    Attributes:
        unread: environments that are not to be read, (B,), bool.
    """

    def __init__(self, reader: SoftReader, num_envs: int, device: str) -> None:
        mesh, grid, gelpad = reader.mesh, reader.grid, reader.gelpad
        self._reader, self._products = reader, Products(num_envs, device)
        products, self._device = self._products, wp.get_device(device)
        self._surface = CoatSurface(mesh.coat, gelpad, products)
        samples = make_grid(gelpad, max(_SAMPLE, *grid.pitch))
        self._clearance = BarrierClearance(self._surface, samples, mesh.d_hat, products)
        self._rows, self._columns = self._surface.matrices(grid.x, grid.y)
        self._lattice = self._clearance.lattice
        self._half_product = products.zeros(grid.shape[0], self._surface.lattice[1])
        self._rise = products.zeros(*grid.shape)
        self._undersides = Undersides(grid, float(grid.rest.max()), num_envs, self._device)
        self._rest = self._on_device(grid.rest, wp.float64)
        self._hats, self._lines = hat_arrays(mesh.coat, grid.x, grid.y, self._device), node_lines(grid.x, grid.y)
        vertices = len(mesh.coat.rest)
        self._sound, self._plain = (self._zeros(num_envs, dtype=wp.int32) for _ in range(2))
        self._load = self._zeros(num_envs, vertices, dtype=wp.float64)
        self._solved, self._none_failed = self._zeros(0, dtype=wp.float64), self._zeros(num_envs, dtype=wp.bool)
        self._height, self._contact = (self._zeros(num_envs, *grid.shape, dtype=dtype) for dtype in (wp.float32, wp.uint8))
        self._single_rest = self._on_device(grid.rest[None].astype(np.float32), wp.float32)
        self._coat, self._centre = self._zeros(num_envs, vertices, dtype=wp.vec3d), self._zeros(num_envs, dtype=wp.vec2d)
        self.unread = self._zeros(num_envs, dtype=wp.bool)
        self._unread = HostArrays(self.unread)
        self._host: tuple[CoatState, HostArrays] | None = None
        self._measured, self._shown = (_Repeated(f, self._device) for f in (self._launch_clearance, self._launch_all))
        self._residual, self._failed = self._zeros(num_envs, dtype=wp.float64), self._zeros(num_envs, dtype=wp.bool)

    def measure(self, state: CoatState) -> wp.array:
        """Launch the clearance of all environments [m], (B,)."""
        return self._measured(state)

    def read(self, state: CoatState) -> PadArrays:
        """Show a state, but for the environments ``unread``."""
        return self._shown(state)

    def leave_out(self, failed: np.ndarray) -> None:
        """Read all but ``failed`` (B,) from now on."""
        self._unread.values[0][:] = failed
        self._unread.write()

    def copies(self, state: CoatState) -> list[np.ndarray]:
        """Numbers that ``read`` has shown of a state, and poses and touch of its objects."""
        if self._host is None or self._host[0] is not state:
            shown = self._shown.result
            numbers = shown.failed, shown.clearance, shown.residual, shown.centre, shown.coat, shown.vertices, shown.forces
            fields = shown.height, shown.contact, shown.underside
            self._host = state, HostArrays(*numbers, *fields, state.objects.poses, state.objects.touching)
        return [values.copy() for values in self._host[1].read()]

    def _launch_clearance(self, state: CoatState) -> wp.array:
        self._find_sound(state, self._none_failed)
        return self._measure(state)

    def _launch_all(self, state: CoatState) -> PadArrays:
        """Launch all that is shown."""
        correction, sound = self._reader.correction, self._sound
        lines, under = self._height.shape[:2], self._undersides
        self._find_sound(state, self.unread)
        clearance = self._measure(state)
        plain: Any = self._plain if correction is not None and correction.normal else None
        self._launch(kernels.choose_plain, len(sound), [clearance, state.objects.touching, self._plain])
        self._products.sandwich(self._rows, self._lattice, self._columns, self._half_product, self._rise, active=plain)
        under.find(state.objects, sound, clearance)
        under.remove_behind(state.objects, self._rise.numbers, clearance)
        if correction is None:
            self._launch(normal_kernels.loads, self._load.shape, [sound, state.forces, clearance, self._load])
            fields = [self._load, clearance, self._rest, self._rise.numbers, under.under, self._height, self._contact, sound]
            columns, d_hat = self._reader.mesh.coat.shape[1], self._reader.mesh.d_hat
            self._launch(kernels.show_plain, lines, [self._hats, columns, d_hat, *fields])
            wp.copy(self._coat, state.vertices)
        else:
            self._correct(state, clearance, correction)
        self._launch(kernels.find_centres, len(sound), [sound, clearance, state.forces, state.vertices, self._centre])
        self._launch(kernels.find_sound_surfaces, self._coat.shape, [self._coat, sound])
        self._launch(kernels.hide_nodes, lines, [sound, self._height, self._contact, under.under])
        hidden = [self._coat, clearance, self._centre, self._residual, self._failed]
        self._launch(kernels.hide_coats, len(sound), [sound, self._solved, *hidden])
        return PadArrays(
            self._height, self._contact, self._centre, self._coat, clearance, self._residual, under.under, state.vertices,
            state.forces, self._failed,
        )  # fmt: skip

    def _find_sound(self, state: CoatState, failed: wp.array) -> None:
        """Mark environments that have not ``failed`` (B,) and whose numbers are all finite."""
        objects = state.objects
        arrays = [failed, state.vertices, state.forces, objects.poses, self._sound]
        self._launch(kernels.find_sound, len(self._sound), arrays)
        for vertices, _ in objects.surfaces:
            self._launch(kernels.find_sound_surfaces, vertices.shape, [vertices, self._sound])

    def _measure(self, state: CoatState) -> wp.array:
        """Launch the clearance of sound environments [m], (B,)."""
        self._surface.place(state.vertices, self._sound)
        self._clearance.measure(state.forces, state.objects, self._sound)
        return self._clearance.clearance

    def _correct(self, state: CoatState, clearance: wp.array, correction: Correction) -> None:
        """Launch the correction of height, contact and coat."""
        normal, sampler, tangential, fine = self._stages
        sound, lines, under = self._sound, self._height.shape[:2], self._undersides.under
        if fine is not None:
            finer, rows, columns, lattice, risen = fine
            self._products.sandwich(rows, self._lattice, columns, lattice, risen, active=self._plain)
            finer.find(state.objects, sound, clearance)
            finer.remove_behind(state.objects, risen.numbers, clearance)
            under = finer.under
        normal.solve(state.forces, clearance, sound, under)
        self._solved = normal.search.best
        normal_rise = normal.over
        if fine is not None:
            normal_rise = self._normal_rise
            self._products.sandwich(self._rows, normal.rise, self._columns, self._half_product, normal_rise)
        laid = [normal.search, int(correction.normal), correction.closed_gap, clearance, *sampler.nearest]
        fields = [normal.pressure, self._rest, self._rise, normal_rise, sampler.dent(normal), self._undersides.under]
        numbers = [one.numbers if isinstance(one, Matrices) else one for one in fields]
        self._launch(normal_kernels.lay, lines, [*laid, *numbers, self._height, self._contact, sound])
        tangential.correct(state.objects)
        heights = [self._height, self._single_rest]
        placed = [clearance, tangential.displacement, self._lines, *heights, state.vertices, self._coat]
        self._launch(kernels.place_coat, self._coat.shape, [self._surface.struct, *placed])

    @cached_property
    def _stages(self) -> tuple[NormalCorrection, ContactSampler, TangentialCorrection, Any]:
        """Stages of the correction, and what the fine grid needs if it is not the grid itself."""
        reader, products = self._reader, self._products
        assert reader.correction is not None
        grid, (compliance, continued) = reader.fine_grid, reader.compliances
        normal = NormalCorrection(self._surface, reader.gelpad, grid, compliance[2], continued[2, 2], reader.correction, products)
        tangential = TangentialCorrection(normal, reader.gelpad, compliance, continued)
        fine = None
        if grid is not reader.grid:
            undersides = Undersides(grid, float(grid.rest.max()), products.num_envs, self._device)
            lattice = products.zeros(grid.shape[0], self._surface.lattice[1])
            fine = undersides, *self._surface.matrices(grid.x, grid.y), lattice, products.zeros(*grid.shape)
        return normal, ContactSampler(normal, reader.grid.x, reader.grid.y), tangential, fine

    @cached_property
    def _normal_rise(self) -> Any:
        """Rise of the corrected contact on the grid [m], if that is not the fine one."""
        return self._products.zeros(*self._reader.grid.shape)

    def _on_device(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._device)

    def _zeros(self, *shape: int, dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)


class _Repeated:
    """Launches for a state, which are one recording from the second time on."""

    def __init__(self, launch: Callable[[CoatState], Any], device: Any) -> None:
        """``launch``: returns the same arrays every time."""
        self._launch, self._device = launch, device
        self._state: CoatState | None = None
        self._recorded: Recorded | None = None
        self.result: Any = None
        """Arrays of the last launch."""

    def __call__(self, state: CoatState) -> Any:
        if self._state is not state:
            self._state, self._recorded, self.result = state, None, self._launch(state)
        else:
            if self._recorded is None:
                self._recorded = Recorded(partial(self._launch, state), device=self._device)
            self._recorded()
        return self.result
