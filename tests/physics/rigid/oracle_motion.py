"""Poses and velocities of bodies, and of other gels, in the frames of pads, in NumPy: oracle of ``motion_kernels``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.physics.rigid.contacts import PadContacts

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True)
class PadMotion:
    """Poses and velocities of bodies in the frames of pads, of n environments."""

    world_from_pad: np.ndarray
    """(n, pads, 4, 4)."""
    pad_from_body: np.ndarray
    """(n, pads, bodies, 4, 4)."""
    velocity: np.ndarray
    """Of bodies' origins relative to the pad [m/s], pad frame, (n, pads, bodies, 3)."""
    spin: np.ndarray
    """Angular velocity relative to the pad [rad/s], (n, pads, bodies, 3)."""

    def closing(self, contacts: PadContacts, row: np.ndarray) -> np.ndarray:
        """Speeds (n,) at which contacts close [m/s]; ``row``: of each contact's environment here."""
        at = row, contacts.pad, contacts.body
        arm = contacts.centre - self.pad_from_body[at][:, :3, 3]
        return -np.vecdot(self.velocity[at] + cross(self.spin[at], arm), contacts.normal)

    def greatest_speed(self, radius: np.ndarray) -> np.ndarray:
        """Greatest speeds (n, pads, bodies) [m/s] of any point of bodies in balls of a radius (bodies,); of a half-space, within a metre.

        The pads, which follow the bodies, are left out.
        """
        size, some = np.minimum(radius, 1.0), np.s_[:, :, : len(radius)]
        return np.linalg.norm(self.velocity[some], axis=-1) + np.linalg.norm(self.spin[some], axis=-1) * size


def motion_of(place: np.ndarray, turn: np.ndarray, velocity: np.ndarray, spin: np.ndarray, pads: int) -> PadMotion:
    """Motion from the frames (n, pads + bodies) of pads and bodies, world frame; the pads follow the bodies as what is touched."""
    frames = np.zeros((*place.shape[:2], 4, 4))
    frames[..., :3, :3], frames[..., :3, 3], frames[..., 3, 3] = turn, place, 1.0
    touched = [*range(pads, place.shape[1]), *range(pads)]
    world_from_pad = frames[:, :pads]
    pad_from_body = relative(world_from_pad[:, :, None], frames[:, None, touched])
    apart = place[:, None, touched] - place[:, :pads, None]
    own = np.broadcast_to(spin[:, :pads, None], apart.shape)
    relative_velocity = velocity[:, None, touched] - velocity[:, :pads, None] - cross(own, apart)
    to_pad = world_from_pad[:, :, None, :3, :3]
    return PadMotion(
        world_from_pad, pad_from_body, turned(relative_velocity, to_pad), turned(spin[:, None, touched] - own, to_pad)
    )


def relative(world_from_pad: np.ndarray, world_from_body: np.ndarray) -> np.ndarray:
    """``pad_from_body`` (…, 4, 4) of poses that broadcast."""
    away = np.broadcast_to(world_from_body, np.broadcast_shapes(world_from_pad.shape, world_from_body.shape)).copy()
    away[..., :3, 3] -= world_from_pad[..., :3, 3]
    back = np.swapaxes(world_from_pad[..., :3, :3], -1, -2)
    away[..., :3, :] = back @ away[..., :3, :]
    return away


def turned(vectors: np.ndarray, target_from_source: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) of the target frame in the source's, by rotations (…, 3, 3)."""
    return (vectors[..., None, :] @ target_from_source)[..., 0, :]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (…, 3); NumPy's own takes several times as long for a few."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]
