"""Shear of contacts in NumPy: oracle of ``shear_kernels``."""

from __future__ import annotations

import numpy as np

from raytac.physics.rigid.shear import LEAST_RINGS, MOST_RINGS

_PLAY = 0.125
"""Share of the contact's radius that its centre may go to and fro over gel and body without rolling: the centroid of nodes jitters."""


class ShearOracle:
    """Stretch of all contacts: one row for each environment, pad and body."""

    def __init__(self, num_envs: int, pads: int, bodies: int) -> None:
        shape = num_envs, pads, bodies
        self.stretch = np.zeros((*shape, 2 * MOST_RINGS, 3))
        """Displacement [m] along two tangents and rotation [rad] about the normal, of both parts of every ring."""
        self.inner = np.zeros((*shape, MOST_RINGS))
        """Width of the inner part of every ring over the ring's."""
        self.width = np.zeros(shape)
        """Shear stiffness of a ring [N/m]."""
        self.mean = np.zeros((*shape, 3))
        """Of the stretch by stiffness."""
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

        What a contact has grown by is without stretch; what it has shrunk by leaves with its own.
        """
        mean = np.empty((len(stiffness), 3))
        for k, row in enumerate(zip(*rows, strict=True)):
            before, after = self.stiffness[row][0], stiffness[k, 0]
            if not before > 0.0:
                self.centre[row], self.width[row] = centre[k], 2.0 * after / MOST_RINGS
            elif before != after:
                parts = _Parts.of(self, row, before)
                if after < before:
                    parts.shrink(after)
                    while after / parts.width < LEAST_RINGS:
                        parts = parts.halved()
                else:
                    while after / parts.width > MOST_RINGS:
                        parts = parts.doubled()
                    parts.grow(after, stiffness[k, 1] / after)
                self.stretch[row], self.inner[row], self.width[row] = parts.stretch.reshape(-1, 3), parts.inner, parts.width
            parts = _Parts.of(self, row, after)
            parts.halve_whole()
            self.stretch[row], self.inner[row], mean[k] = parts.stretch.reshape(-1, 3), parts.inner, parts.mean()
        self.stiffness[rows] = stiffness
        return stiffness[:, [0, 0, 1]] * mean

    def share_that_sticks(self, rows: tuple[np.ndarray, ...], displacement: np.ndarray, limit: np.ndarray) -> np.ndarray:
        """Stiffness (n,) against displacements (n, 3) over that without slip; 0 where all of a contact would slip."""
        result = np.zeros(len(displacement))
        for k, row in enumerate(zip(*rows, strict=True)):
            stiffness = self.stiffness[row]
            parts = _Parts.of(self, row, stiffness[0])
            before, mean = parts.stretch.copy(), parts.mean()
            parts.slip(displacement[k], limit[k] / np.maximum(stiffness, 1e-30), 1.0)
            low, high = parts.edges()
            slips = (parts.stretch != before + displacement[k]).any(axis=2) | (high <= low)
            work = stiffness[[0, 0, 1]] * displacement[k]
            if not slips.all():
                full = work @ displacement[k]
                result[k] = np.clip(work @ (parts.mean() - mean) / full, 1e-30, 1.0) if full > 0.0 else 1.0
        return result

    def move(
        self, rows: tuple[np.ndarray, ...], displacement: np.ndarray, limit: np.ndarray, centre: np.ndarray, radius: np.ndarray
    ) -> None:
        """Add a step's displacement (n, 3) and let rings slip.

        ``limit`` (n, 2): force and torque of slip [N, N m] at the load of the step; ``centre`` (n, 3) of the contact at the start of the
        step and its ``radius`` (n,) [m]. Gel that leaves the contact as it rolls on takes its stretch with it: over the contact's diameter.
        """
        radius = np.maximum(radius, 0.5e-9)
        kept = np.exp(-self._rolled(rows, centre, radius) / (2.0 * radius))
        for k, row in enumerate(zip(*rows, strict=True)):
            parts = _Parts.of(self, row, self.stiffness[row][0])
            parts.slip(displacement[k], limit[k] / np.maximum(self.stiffness[row], 1e-30), kept[k])
            self.stretch[row], self.inner[row], self.mean[row] = parts.stretch.reshape(-1, 3), parts.inner, parts.mean()
        self.load[rows], self.centre[rows] = limit, centre
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


class _Parts:
    """Rings of one contact by places on the coordinate of its shear stiffness, in widths of a ring."""

    def __init__(self, stretch: np.ndarray, inner: np.ndarray, width: float, stiffness: float) -> None:
        self.stretch, self.inner, self.width, self.size = stretch, inner, width, stiffness / width
        """(MOST_RINGS, 2, 3), (MOST_RINGS,), of a ring [N/m], of the contact."""

    @staticmethod
    def of(shear: ShearOracle, row: tuple[int, ...], stiffness: float) -> _Parts:
        return _Parts(shear.stretch[row].reshape(-1, 2, 3).copy(), shear.inner[row].copy(), shear.width[row], stiffness)

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (MOST_RINGS, 2) where parts begin and end."""
        low = np.arange(MOST_RINGS, dtype=float)
        edge, high = np.minimum(low + self.inner, self.size), np.minimum(low + 1.0, self.size)
        return np.stack([np.minimum(low, self.size), edge], axis=1), np.stack([edge, high], axis=1)

    def weights(self) -> np.ndarray:
        """Of parts, (MOST_RINGS, 2, 3): along as the radius, about the normal as its cube."""
        low, high = self.edges()
        return np.stack([high - low, high - low, high**3 - low**3], axis=2)

    def mean(self) -> np.ndarray:
        weights = self.weights()
        return (weights * self.stretch).sum(axis=(0, 1)) / weights.sum(axis=(0, 1))

    def means(self) -> np.ndarray:
        """Of rings, (MOST_RINGS, 3); 0 where there is none."""
        weights = self.weights()
        whole = weights.sum(axis=1)
        return (weights * self.stretch).sum(axis=1) / np.where(whole > 0.0, whole, 1.0)

    def shrink(self, stiffness: float) -> None:
        self.size = stiffness / self.width
        covered = np.clip(self.size - np.arange(MOST_RINGS), 0.0, 1.0)
        gone = (covered < 1.0) & (covered <= self.inner)
        self.inner = np.where(gone, covered, self.inner)
        self.stretch[gone, 1] = 0.0
        self.stretch[covered == 0.0] = 0.0

    def grow(self, stiffness: float, twist: float) -> None:
        k, old, size = int(self.size), self.size, stiffness / self.width
        if size > old > k:
            first, second = self.stretch[k]
            scale = np.array([1.0, 1.0, twist])
            if scale @ second**2 >= 0.01 * (scale @ first**2):
                self.stretch[k] = self.means()[k], np.zeros(3)
                self.inner[k] = old - k
            else:
                before = self.weights()[k, 1]
                self.size = size
                self.stretch[k, 1] *= before / self.weights()[k, 1]
        self.size = size

    def doubled(self) -> _Parts:
        means, stretch, inner = self.means(), np.zeros_like(self.stretch), np.zeros(MOST_RINGS)
        for k in range(MOST_RINGS // 2):
            if self.size > 2 * k + 1:
                inner[k], stretch[k] = 0.5, means[2 * k : 2 * k + 2]
            else:
                inner[k], stretch[k] = 0.5 * self.inner[2 * k], self.stretch[2 * k]
        return _Parts(stretch, inner, 2.0 * self.width, self.size * self.width)

    def halved(self) -> _Parts:
        inner, half = np.zeros(MOST_RINGS), 2.0 * self.inner[: MOST_RINGS // 2]
        inner[::2], inner[1::2] = np.minimum(half, 1.0), np.maximum(half - 1.0, 0.0)
        stretch = np.repeat(self.stretch[: MOST_RINGS // 2], 2, axis=0)
        stretch[::2][half >= 1.0, 1] = 0.0
        stretch[1::2][half <= 1.0, 0] = 0.0
        stretch[np.arange(MOST_RINGS) >= 2.0 * self.size] = 0.0
        return _Parts(stretch, inner, 0.5 * self.width, self.size * self.width)

    def halve_whole(self) -> None:
        whole = (np.arange(MOST_RINGS) + 1.0 <= self.size) & ((self.inner <= 0.0) | (self.inner >= 1.0))
        for k in np.flatnonzero(whole):
            self.stretch[k] = self.stretch[k, 1 if self.inner[k] <= 0.0 else 0]
            self.inner[k] = 0.5

    def slip(self, displacement: np.ndarray, limit: np.ndarray, kept: float) -> None:
        """``limit`` (2,): force and torque of slip over the stiffness."""
        low, high = (places / self.size for places in self.edges())
        real = high > low
        share = np.where(real, high - low, 1.0)
        # Means of 1 − y² over y and over y³.
        along = 1.0 - (high**3 - low**3) / (3.0 * share)
        about = 1.0 - 0.6 * (high**5 - low**5) / np.where(real, high**3 - low**3, 1.0)
        largest = np.stack([1.5 * limit[0] * along, 1.5 * limit[0] * along, 2.5 * limit[1] * about], axis=2)
        stretch = self.stretch + displacement
        part = np.linalg.norm(stretch / np.maximum(largest, 1e-30), axis=2)
        self.stretch = np.where(real[..., None], kept * stretch / np.maximum(part, 1.0)[..., None], self.stretch)
