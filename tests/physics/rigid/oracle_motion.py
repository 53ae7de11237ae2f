"""Poses and velocities of bodies, and of other gels, in the frames of pads, in NumPy: oracle of ``motion_kernels``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.physics.rigid.contacts import PadContacts
from raytac.robots.frames import body_poses, site_poses

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


def motion_of(
    model: mujoco.MjModel, datas: Sequence[mujoco.MjData], sites: np.ndarray, pads: np.ndarray, bodies: np.ndarray
) -> PadMotion:
    """Motion in the states given, after their velocities are known.

    Args:
        model: any of the states' models.
        datas: n states.
        sites: sites at the pads' frames.
        pads: bodies that carry them.
        bodies: indices of bodies; the pads follow them as what is touched.
    """
    world_from_pad = site_poses(datas, sites)
    world_from_body = np.concatenate([body_poses(datas, bodies), world_from_pad], axis=1)
    pad_from_body = relative(world_from_pad[:, :, None], world_from_body[:, None])
    indices = np.concatenate([pads, bodies, pads])
    twist = np.array([data.cvel[indices] for data in datas]).reshape(len(datas), len(indices), 6)
    # MuJoCo's velocities are about the centre of mass of the kinematic tree.
    about = np.array([data.subtree_com[model.body_rootid[indices]] for data in datas]).reshape(len(datas), -1, 3)
    place = np.concatenate([world_from_pad[..., :3, 3], world_from_body[..., :3, 3]], axis=1)
    linear = twist[..., 3:] + cross(twist[..., :3], place - about)
    count = len(pads)
    spin = twist[:, None, count:, :3] - twist[:, :count, None, :3]
    apart = place[:, None, count:] - place[:, :count, None]
    velocity = linear[:, None, count:] - linear[:, :count, None] - cross(twist[:, :count, None, :3], apart)
    to_pad = world_from_pad[:, :, None, :3, :3]
    return PadMotion(world_from_pad, pad_from_body, turned(velocity, to_pad), turned(spin, to_pad))


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
