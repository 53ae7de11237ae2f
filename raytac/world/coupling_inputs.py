"""``CouplingInputs``: what a step of the contact solver gives to ``Coupling``.

On one device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from raytac.physics.soft.mesh import pad_stiffness_terms
from raytac.world import coupling_input_kernels as kernels
from raytac.world.coupling import Coupling
from raytac.world.coupling_kernels import NOTHING

if TYPE_CHECKING:
    from raytac.physics.soft.scene import SoftScene

STIFFENING = 2.0
"""Stiffness assumed of a bonded soft body over that at rest.

It stiffens as it is stretched, twisted or sheared (docs/concepts/coupling.md)."""
_NOTHING = int(NOTHING)


class CouplingInputs:
    """Reader of a scene for ``Coupling``: no loop over environments but for bonded soft bodies.

    Attributes:
        names: pads and driven bodies that MuJoCo moves, in the order of the coupling's bodies.
        contacts, solver_bodies: how many of them the coupling needs room for.
    """

    def __init__(self, scene: SoftScene, names: Sequence[str]) -> None:
        """``names``: as of the attribute; driven bodies that are not named stand still."""
        self._scene, self.names = scene, tuple(names)
        self._free = [name for name, body in scene.bodies.items() if not body.is_driven]
        self._bonded = [name for name, body in scene.bodies.items() if body.is_driven and body.is_soft]
        self._pairs = [
            (a, b) for a, b in scene.world.layout.pairs.tolist() if a != b and {self._side(a), self._side(b)} != {_NOTHING}
        ]
        self.contacts, self.solver_bodies = len(self._pairs) + len(self._bonded), len(self._free) + len(self._bonded)
        self._made: Any = None

    def _side(self, body: int) -> int:
        """Side of a contact that one of the solver's bodies is."""
        name = self._scene.world.layout.names[body]
        if name in self.names:
            return self.names.index(name)
        moved = [*self._free, *self._bonded]
        return -2 - moved.index(name) if name in moved else _NOTHING

    def gather(self, coupling: Coupling, chosen: wp.array) -> None:
        """Write wrenches, contacts and bodies of the environments ``chosen`` (B,) to a coupling.

        On the solver's device nothing is copied; on another one the host's copy of the sums is taken there.
        """
        if self._made is None:
            self._made = self._names(coupling.device), self._patches(coupling)
        names, patches = self._made
        self._read_patches(patches, np.flatnonzero(chosen.numpy()) if self._bonded else np.zeros(0, int))
        sums = self._sums(coupling.device)
        inputs = [chosen, names, sums, patches, coupling.wrench, coupling.contacts, coupling.solver_bodies]
        wp.launch(kernels.gather_inputs, dim=coupling.num_envs, inputs=inputs, device=coupling.device)

    def _sums(self, device: Any) -> Any:
        """The solver's sums on a device."""
        sums, result = self._scene.world.sums, kernels.Sums()
        chosen: Mapping[str, Any]
        if device == self._scene.world.device:
            sums.launch()
            chosen = sums.arrays
        else:
            chosen = {name: wp.array(sums.host[name], dtype=wp.float64, device=device) for name in kernels.Sums.vars}
        self._kept = chosen  # the struct holds addresses
        for name, field in kernels.Sums.vars.items():
            array = chosen[name]
            place = {"ptr": array.ptr, "shape": array.shape[:2], "dtype": field.type.dtype, "device": device}
            setattr(result, name, array if field.type.dtype is wp.float64 else wp.array(**place))
        return result

    def _names(self, device: Any) -> Any:
        scene, layout = self._scene, self._scene.world.layout
        terms = np.zeros((len(layout.names), 4, 2))
        for name, pad in scene.pads.items():
            terms[layout.names.index(name)] = pad_stiffness_terms(pad.sensor.gelpad)
        # A pair that does not count keeps its number: both of its sides stand still.
        all_pairs = [tuple(pair) for pair in layout.pairs.tolist()]
        sides = [(self._side(a), self._side(b)) if (a, b) in self._pairs else (_NOTHING, _NOTHING) for a, b in all_pairs]
        free = [layout.names.index(name) for name in self._free]
        result: Any = kernels.Names()
        with wp.ScopedDevice(device):
            result.felt = wp.array([layout.names.index(name) for name in self.names], dtype=wp.int32)
            result.free = wp.array(np.array(free, np.int32), dtype=wp.int32)
            result.free_mass = wp.array(scene.world.sums.mass[np.array(free, int)], dtype=wp.float64)
            gravity = np.broadcast_to(scene.gravity, (scene.num_envs, 3))
            result.gravity = wp.array(np.ascontiguousarray(gravity), dtype=wp.vec3d)
            result.side = wp.array(np.reshape(sides, (-1, 2)).astype(np.int32), dtype=wp.int32)
            result.body = wp.array(np.reshape(layout.pairs, (-1, 2)).astype(np.int32), dtype=wp.int32)
            result.terms = wp.array(terms, dtype=wp.float64)
        return result

    def _patches(self, coupling: Coupling) -> Any:
        count, bonded = coupling.num_envs, len(self._bonded)
        result: Any = kernels.Patches()
        with wp.ScopedDevice(coupling.device):
            result.touched = wp.zeros((count, bonded), dtype=wp.int32)
            result.mass, result.inertia = (wp.zeros((count, bonded), dtype=kind) for kind in (wp.float64, wp.mat33d))
            for name in ("centre", "velocity", "spin"):
                setattr(result, name, wp.zeros((count, bonded), dtype=wp.vec3d))
            result.stiffness = wp.zeros((count, bonded, 6, 6), dtype=wp.float64)
        return result

    def _read_patches(self, patches: Any, envs: np.ndarray) -> None:
        """Patches of bonded soft bodies, which the solver condenses on the host.

        One after the other.
        """
        if not self._bonded:
            return
        fields = {name: getattr(patches, name).numpy() for name in kernels.Patches.vars}
        for b in envs.tolist():
            for p, name in enumerate(self._bonded):
                patch = self._scene.world.held_patch(name, b)
                fields["touched"][b, p] = patch is not None
                if patch is not None:
                    fields["mass"][b, p], fields["inertia"][b, p], fields["centre"][b, p] = (
                        patch.mass,
                        patch.inertia,
                        patch.centre,
                    )
                    fields["velocity"][b, p], fields["spin"][b, p] = patch.velocity[:3], patch.velocity[3:]
                    fields["stiffness"][b, p] = STIFFENING * patch.stiffness
        for name, values in fields.items():
            getattr(patches, name).assign(values)
