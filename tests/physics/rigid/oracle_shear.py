"""Shear of contacts in NumPy: oracle of ``shear_kernels``."""

from __future__ import annotations

import numpy as np

from raytac.physics.rigid.shear import ELEMENTS, element_limits

_LIMITS = element_limits()
_PLAY = 0.125
"""Share of the contact's radius that its centre may go to and fro over gel and body without rolling: the centroid of nodes jitters."""


class ShearOracle:
    """Stretch of all contacts: one row for each environment, pad and body."""

    def __init__(self, num_envs: int, pads: int, bodies: int) -> None:
        shape = num_envs, pads, bodies
        self.stretch = np.zeros((*shape, ELEMENTS, 3))
        """Displacement [m] along two tangents and rotation [rad] about the normal, of every element."""
        self.stiffness = np.zeros((*shape, 2))
        """Shear and twist stiffness at the last step [N/m, N m/rad]; 0 out of contact."""
        self.load = np.zeros((*shape, 2))
        """Tangential force and torque at which the contact slips [N, N m]."""
        self.centre = np.zeros((*shape, 3))
        self.play = np.zeros((*shape, 2, 2))
        """Travel of the centre over the gel and over the body that does not count as rolling yet, along both tangents [m]."""
        self.moved = np.zeros((*shape, 2))
        """Displacement of the body over the gel in the last step, along both tangents [m]."""

    def clear(self, *rows: np.ndarray) -> None:
        """Forget the contacts named by indices of environments, pads and bodies, or all of some environments."""
        for values in vars(self).values():
            values[rows] = 0.0

    def begin(self, rows: tuple[np.ndarray, ...], stiffness: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Elastic force along two tangents and torque about the normal, (n, 3), of contacts of shear and twist stiffness (n, 2).

        ``centre`` (n, 3) [m] is where new ones start.

        A contact that has grown since keeps its force, since new area comes without stress; one that has shrunk keeps its stretch.
        """
        before = self.stiffness[rows]
        self.centre[rows] = np.where(before[:, :1] > 0.0, self.centre[rows], centre)
        kept = np.minimum(before / stiffness, 1.0)[:, [0, 0, 1]]
        self.stretch[rows] *= kept[:, None]
        self.stiffness[rows] = stiffness
        return stiffness[:, [0, 0, 1]] * self.stretch[rows].mean(axis=1)

    def move(
        self, rows: tuple[np.ndarray, ...], displacement: np.ndarray, limit: np.ndarray, centre: np.ndarray, radius: np.ndarray
    ) -> None:
        """Add a step's displacement (n, 3) and let elements slip.

        ``limit`` (n, 2): force and torque of slip [N, N m] at the load of the step; ``centre`` (n, 3) of the contact at the start of the
        step and its ``radius`` (n,) [m]. Gel that leaves the contact as it rolls on takes its stretch with it: over the contact's diameter.
        """
        stretch = self.stretch[rows] + displacement[:, None]
        largest = 1.5 * limit / np.maximum(self.stiffness[rows], 1e-30)
        part = stretch / np.maximum(largest[:, None, [0, 0, 1]] * _LIMITS[None, :, None], 1e-30)
        stretch /= np.maximum(np.sqrt(np.vecdot(part, part)), 1.0)[..., None]
        radius = np.maximum(radius, 0.5e-9)
        stretch *= np.exp(-self._rolled(rows, centre, radius) / (2.0 * radius))[:, None, None]
        self.stretch[rows], self.load[rows], self.centre[rows] = stretch, limit, centre
        self.moved[rows] = displacement[:, :2]

    def _rolled(self, rows: tuple[np.ndarray, ...], centre: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] that contacts have rolled on in the last step: what their centres travel over gel and body alike.

        A body that shears the gel, or slides, takes the centre with it or leaves it where it is on the gel: one of both is zero. Between
        two gels the centre goes half as far as the body, and back over it.
        """
        over_gel = (centre - self.centre[rows])[:, :2]
        play = self.play[rows] + np.stack([over_gel, over_gel - self.moved[rows]], axis=1)
        size = np.linalg.norm(play, axis=2)
        beyond = np.maximum(size - _PLAY * radius[:, None], 0.0)
        play_share = beyond / np.maximum(size, 1e-30)
        same_way = np.vecdot(play[:, 0], play[:, 1]) > 0.0
        self.play[rows] = play * (1.0 - play_share[:, :, None])
        return np.where(same_way, beyond.min(axis=1), 0.0)
