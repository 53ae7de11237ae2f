"""Readings of rigid pads on the host, whatever engine moves the bodies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import OverlapError
from raytac.gel.surface import PadGrid
from raytac.physics.base import PadReading
from raytac.physics.rigid.gel_contact import GelContact
from raytac.se3 import inverse
from raytac.warp_runtime import HostArrays
from raytac.world.engine.base import Engine
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_surfaces import PadSurfaces
from raytac.world.world_model import WorldModel


class RigidReadings:
    """Wrenches, overlaps and surfaces of all rigid pads of a world, from an engine's poses."""

    soft = None
    meshes: tuple[str, ...] = ()

    def __init__(self, composed: WorldModel, contact: GelContact, pairs: GelPairs, engine: Engine) -> None:
        """Readings of the pads of ``composed``; the others are as of ``RigidPads``."""
        self.composed, self.contact, self.engine = composed, contact, engine
        self._wrenches = HostArrays(contact.wrenches)
        self.bodies = composed.touched
        self._names = [mounted.name for mounted in composed.sensors]
        gels, shapes = [spec.gelpad for spec in composed.sensor_specs], [body.parts for body in self.bodies]
        self._others = {name: pairs.gels(k) for k, name in enumerate(self._names)}
        self.surfaces = PadSurfaces(dict(zip(self._names, gels, strict=True)), shapes, len(contact.wrenches), self._others)
        self.report: dict[str, np.ndarray] = {}

    def check_beyond(self, envs: Sequence[int], pad_from_body: np.ndarray) -> None:
        """Raise ``OverlapError`` where a body is beyond a pad's bonded face.

        ``pad_from_body``: poses (n, pads, bodies, 4, 4), of the environments ``envs``.
        """
        for row, pad, i in np.argwhere(self.contact.faces.pierced(pad_from_body)).tolist():
            rule = f"{self.bodies[i].name!r} starts beyond the face that the gel of {self._names[pad]!r} is bonded to"
            raise OverlapError(f"environment {envs[row]}: {rule}")

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin, pad frame, in the last step."""
        return self._wrenches.read()[0][:, self._names.index(name)].copy()

    def overlap(self, env: int) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at present; inf beyond a pad's bonded face."""
        poses = self._pad_from_body()[[env]]
        contacts = self.contact.search.contacts(poses, np.zeros(1, int), 0.0)
        depth = np.zeros(poses.shape[1:3])
        depth[contacts.pad, contacts.body] = contacts.depth
        depth[self.contact.faces.pierced(poses)[0]] = np.inf
        return [(self._names[k], self.bodies[i].name, float(depth[k, i])) for k, i in np.argwhere(depth > 0.0).tolist()]

    def reading(self, name: str, grid: PadGrid, failed: np.ndarray, envs: Sequence[int] | None = None) -> PadReading:
        """Surface and forces of one sensor on the nodes of ``grid``.

        ``envs``: the environments, one row each; None is all.
        """
        rows, index = np.arange(len(failed)) if envs is None else np.asarray(envs), self._names.index(name)
        pads, bodies = self.engine.read_poses()
        world_from_pad, failed = pads[rows], failed[rows]
        others = np.concatenate([bodies[rows], world_from_pad], axis=1) if self._others[name] else bodies[rows]
        return self.surfaces.reading(
            name,
            grid,
            inverse(world_from_pad[:, index])[:, None] @ others,
            self.wrench(name)[rows],
            failed,
            rows,
            shear=lambda pressed: self.contact.shear.of(rows, index, pressed),
        )

    def _pad_from_body(self) -> np.ndarray:
        """Present poses (B, pads, bodies, 4, 4) of bodies."""
        pads, bodies = self.engine.read_poses()
        return inverse(pads)[:, :, None] @ bodies[:, None]
