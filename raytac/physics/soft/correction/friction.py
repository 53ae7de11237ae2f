"""Friction below the size of the mesh's cells: how far the skin around a sheared or twisted contact comes along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.gel.interpolate import sampled
from raytac.gel.matmul import product, sandwich
from raytac.physics.soft.correction.layer import CosineSeries, layer_shear
from raytac.physics.soft.correction.normal import FineContact, FineShape
from raytac.specs.sensor import GelpadSpec

__all__ = ["Grip", "Held", "RigidMotion"]

_SPACING = 0.2e-3
"""Of the grid on which the traction is found [m]."""
_CLOSE = 0.5e-6
"""Motions that differ by less are the same [m]."""
_STICKS = 2e-6
"""What should stick and moves less against the object does [m]."""
_SLIDING = 0.05
"""With less than this share of it sticking, all of a contact slides."""
_SURE, _LOST = 0.3, 0.5
"""Share of the motion in contact that the fine contact may miss: below the first the exchange is whole, above the second there is none."""
_SMALL = 20e-6
"""Motion in contact [m] below which what is missed of it says little, so that a press off the middle is shown as one there is (a guess)."""
_LEAST = 1e-4
"""Places that bear less than this share of the greatest pressure do not count as in contact."""
_ROUNDS, _STEPS = 6, 10
"""So often the object is moved on, and so many steps of the search for the traction each time."""
_HOLDS = 200
"""Most steps of the search for the forces that hold the mesh."""


@dataclass(frozen=True)
class RigidMotion:
    """A motion in the plane, of less than a quarter turn."""

    centre: np.ndarray
    """[m], (2,)."""
    shift: np.ndarray
    """Of the centre [m], (2,)."""
    turn: float
    """Sine of the angle about +z."""

    @staticmethod
    def of(moved: np.ndarray, place: np.ndarray, weight: np.ndarray) -> RigidMotion:
        """The one nearest to what ``moved`` (n, 2) [m] from its ``place`` (n, 2) [m], by ``weight`` (n,); of a rotation, its sine."""
        share = weight / weight.sum()
        centre, shift = share @ place, share @ moved
        arm = place - centre
        size = float(share @ (arm**2).sum(axis=1))
        turn = float(share @ (arm[:, 0] * moved[:, 1] - arm[:, 1] * moved[:, 0])) / size if size > 0.0 else 0.0
        return RigidMotion(centre, shift, turn)

    def at(self, place: np.ndarray) -> np.ndarray:
        """Motion [m] of places (…, 2) [m], same shape."""
        arm = place - self.centre
        shorter = np.sqrt(max(1.0 - self.turn**2, 0.0)) - 1.0
        return self.shift + self.turn * np.stack([-arm[..., 1], arm[..., 0]], axis=-1) + shorter * arm

    def plus(self, other: RigidMotion, less: RigidMotion) -> RigidMotion:
        """This motion, and by how much ``other`` is more than another at this one's centre."""
        more = other.at(self.centre) - less.at(self.centre)
        return RigidMotion(self.centre, self.shift + more, self.turn + other.turn - less.turn)


@dataclass(frozen=True)
class Held:
    """Friction of one contact on a window of the fine grid."""

    place: np.ndarray
    """Of its nodes, where the skin was at rest [m], (n, m, 2)."""
    traction: np.ndarray
    """Of the object on the skin [Pa], (2, n, m)."""
    bound: np.ndarray
    """Most that it can be [Pa], (n, m)."""
    moved: np.ndarray
    """The layer's answer [m], (2, n, m)."""
    waves: np.ndarray
    """Its amplitudes over all of the pad [m], (2, Ky, Kx)."""


class Grip:
    """Exchanges the mesh's answer to friction for the layer's, one pad at a time (*defect correction*, see ``FineContact``).

    Let v be the sideways motion that friction has given to the vertices in contact, E q what *the same mesh* does, by linear elasticity,
    under tangential forces on them that hold v, and A τ what *the gel* does under a traction τ on a fine grid. The skin then goes

        u − E q + A τ,   A τ = D where the contact sticks,   |τ| ≤ μ p everywhere, and along it where it slips,

    with the pressure p of the fine contact: its edge slips as C. Cattaneo (1938) and R. D. Mindlin (J. Appl. Mech. 16, 1949) have it,
    one coefficient for all of the contact and in one go, without a history. D is a rigid motion, and such that the mean of A τ over the
    contact, shift and turn, weighted by p, is that of v weighted by the mesh's normal forces: on meshes of any fineness that mean is nearly
    the same. Where all slides and the mean is still less, μ p is raised in proportion: small strain knows too little pressure. And where
    the contact does not move as such a one would (a bar that ploughs its ends through the gel as it turns), less is exchanged, or nothing.

    A is the layer's compliance wave by wave, as if the pad were continued by its mirror image, and E is of a mesh whose sides are so too:
    both drag the gel by nearly the same force, so that the true sides stay in u.
    """

    def __init__(self, contact: FineContact, gelpad: GelpadSpec, compliance: np.ndarray) -> None:
        """``compliance`` [m/N], (2, 2, V, V): displacement along x, y of each vertex over a force along x, y (first axis) on each, for
        a mesh whose sides may not move outwards."""
        self._contact = contact
        self._compliance = compliance.astype(np.float32)
        ends = [(t[0], t[-1]) for t in (contact.x, contact.y)]
        self._x, self._y = (np.linspace(low, high, round((high - low) / _SPACING) + 1) for low, high in ends)
        x, y = CosineSeries(self._x), CosineSeries(self._y)
        wave = np.hypot(x.wave_numbers[None, :], y.wave_numbers[:, None])
        across_x, across_y = (
            k / np.maximum(wave, x.wave_numbers[1] * 1e-9) for k in (x.wave_numbers[None, :], y.wave_numbers[:, None])
        )
        along, across = (law * y.hat[:, None] * x.hat for law in layer_shear(wave, gelpad))
        self._law = tuple(
            law.astype(np.float32)
            for law in (
                across + (along - across) * across_x**2,
                (along - across) * across_x * across_y,
                across + (along - across) * across_y**2,
            )
        )
        self._to_x, self._to_y = (
            tuple(m.astype(np.float32) for m in (series.analysis, series.sine_analysis)) for series in (x, y)
        )
        self._series = x, y
        self._from_x, self._from_y = self._waves_at(self._x, self._y)
        lines = contact.surface.mesh
        self._vertex_x, self._vertex_y = self._waves_at(lines.lines_x, lines.lines_y)

    def exchange(
        self, shape: FineShape, dragged: np.ndarray, touching: np.ndarray, load: np.ndarray, friction: float
    ) -> np.ndarray:
        """A τ − E q [m], (V, 2), at the coat's vertices.

        Args:
            shape: the contact on the fine grid.
            dragged: v [m], (V, 2), of which those ``touching`` (V,) count.
            load: normal force on each vertex [N], (V,).
            friction: μ > 0.
        """
        rest = self._contact.surface.mesh.rest[:, :2]
        goal = RigidMotion.of(dragged[touching], rest[touching], load[touching])
        waves = np.zeros((2, len(self._y), len(self._x)), np.float32)
        if np.abs(goal.at(rest[touching])).max() > _CLOSE:
            found = self.hold(shape.pressure, goal, friction)
            if found is None:
                return np.zeros_like(dragged)
            waves = found.waves
        layer = self._back(waves, (self._vertex_x, self._vertex_y)).reshape(2, -1)
        trust = _trust(layer.T[touching], dragged[touching], load[touching])
        if trust == 0.0:
            return np.zeros_like(dragged)
        compliance = self._compliance[:, :, :, touching]
        here = compliance[:, :, touching].transpose(1, 2, 0, 3).reshape(2 * touching.sum(), -1)
        force = _held(here, dragged[touching].T.ravel().astype(np.float32))
        mesh = product(compliance.transpose(1, 2, 0, 3).reshape(-1, len(force)), force[:, None]).reshape(2, -1)
        return trust * (layer - mesh).T.astype(float)

    def hold(self, pressure: np.ndarray, goal: RigidMotion, friction: float) -> Held | None:
        """Friction under a ``pressure`` [Pa], (Ny, Nx) on the contact's fine grid, that moves the skin in contact by ``goal`` on the mean.

        None where no node is in contact, or none of those can move.
        """
        place = np.stack(np.meshgrid(self._x, self._y), axis=-1)

        def pressed(moved: np.ndarray, place: np.ndarray) -> np.ndarray:
            now = (place + moved).reshape(-1, 2)
            return sampled(pressure, self._contact.x, self._contact.y, *now.T).reshape(place.shape[:2])

        borne = pressed(goal.at(place), place) > _LEAST * pressure.max()
        if not borne.any():
            return None
        margin = 2 + int(0.3 * np.abs(goal.at(place)[borne]).max() / _SPACING)
        rows, columns = (_span(np.asarray(borne.any(axis=k)), margin) for k in (1, 0))
        place, borne = place[rows, columns], borne[rows, columns]
        to = tuple(m[:, columns].T for m in self._to_x), tuple(m[:, rows] for m in self._to_y)
        back = tuple(m[:, columns] for m in self._from_x), tuple(m[rows] for m in self._from_y)

        def answer(traction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            (cosines_x, sines_x), (cosines_y, sines_y) = to
            one, two = sandwich(cosines_y, traction[0], sines_x), sandwich(sines_y, traction[1], cosines_x)
            waves = np.stack([self._law[0] * one + self._law[1] * two, self._law[1] * one + self._law[2] * two])
            return waves, self._back(waves, back)

        moved, motion = np.moveaxis(goal.at(place), -1, 0), goal
        bound = friction * pressed(goal.at(place), place)
        softest = _softest(lambda traction: answer(traction)[1], bound > 0.0)
        if not softest > 0.0:
            return None
        stride = 1.0 / softest
        traction, held = np.zeros((2, *bound.shape), np.float32), None
        for _ in range(_ROUNDS):
            wanted = np.moveaxis(motion.at(place), -1, 0)
            traction = self._search(traction, wanted, bound.astype(np.float32), stride, lambda t: answer(t)[1])
            waves, moved = answer(traction)
            held = Held(place, traction, bound, moved, waves)
            mean = RigidMotion.of(np.moveaxis(moved, 0, -1).reshape(-1, 2), place.reshape(-1, 2), bound.ravel())
            at = place[bound > 0.0]
            off = goal.at(at) - mean.at(at)
            sticks = np.hypot(*traction) < 0.999 * bound
            slip = np.hypot(*(moved - wanted))[sticks].max(initial=0.0)
            if np.abs(off).max() < _CLOSE and slip < _STICKS:
                break
            if sticks.sum() < _SLIDING * len(at):
                friction *= max(float((goal.at(at) ** 2).sum() / (goal.at(at) * mean.at(at)).sum()), 1.0)
            motion = motion.plus(goal, mean)
            bound = friction * np.where(borne, pressed(np.moveaxis(moved, 0, -1), place), 0.0)
            if not (bound > 0.0).any():
                break
        return held

    @staticmethod
    def _search(traction, wanted, bound, stride, answer) -> np.ndarray:
        """Some steps towards the traction within ``bound`` whose answer is ``wanted``, both (…, rows, columns).

        Accelerated projected gradients, begun anew where they turn round (B. O'Donoghue and E. Candès, Found. Comput. Math. 15, 2015).
        """
        traction = ahead = _within(traction, bound)
        pace = 1.0
        for _ in range(_STEPS):
            new = _within(ahead - stride * (answer(ahead) - wanted), bound)
            if float(((ahead - new) * (new - traction)).sum()) > 0.0:
                pace = 1.0
            faster = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * pace * pace))
            ahead = new + (pace - 1.0) / faster * (new - traction)
            traction, pace = new, faster
        return traction

    def _waves_at(self, x: np.ndarray, y: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Cosines and sines over lines: (Kx, Nx) each, and (Ny, Ky) each."""
        along_x, along_y = self._series
        over_x = tuple(np.ascontiguousarray(f(x).T, np.float32) for f in (along_x.synthesis, along_x.sines))
        return over_x, tuple(f(y).astype(np.float32) for f in (along_y.synthesis, along_y.sines))

    @staticmethod
    def _back(waves: np.ndarray, lines: tuple) -> np.ndarray:
        """Motion [m] (2, Ny, Nx) over lines."""
        (cosines_x, sines_x), (cosines_y, sines_y) = lines
        return np.stack([sandwich(cosines_y, waves[0], sines_x), sandwich(sines_y, waves[1], cosines_x)])


def _trust(found: np.ndarray, moved: np.ndarray, weight: np.ndarray) -> float:
    """How far the exchange goes, in [0, 1], by what it leaves unexplained of the way that the mesh ``moved`` in contact."""
    left, whole = (float(weight @ (field**2).sum(axis=1)) for field in (found - moved, moved))
    missed = np.sqrt(left / (whole + weight.sum() * _SMALL**2))
    return float(np.clip((_LOST - missed) / (_LOST - _SURE), 0.0, 1.0))


def _within(traction: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Cut to the ``bound`` (Ny, Nx) >= 0, direction kept; (2, Ny, Nx)."""
    size = np.hypot(*traction)
    return (traction * np.minimum(1.0, bound / np.maximum(size, 1e-12))).astype(np.float32)


def _softest(answer, inside: np.ndarray) -> float:
    """A little more than the greatest motion over traction [m/Pa] within the contact, by power iteration; 0 where nothing can move."""
    trial = np.stack([inside, inside]).astype(np.float32)
    size = 0.0
    for _ in range(3):
        moved = answer(trial) * inside
        if not moved.any():
            return 0.0
        size = float(np.linalg.norm(moved) / np.linalg.norm(trial))
        trial = moved / np.float32(np.abs(moved).max())
    return 1.15 * size


def _held(compliance: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Forces [N], (n,), whose linear response is ``moved`` [m], (n,), by conjugate gradients; float32.

    What cannot move (the sides of the pad across themselves: rows of ``compliance`` that are 0) is left out and bears no force.
    """
    free = np.diagonal(compliance) > 0.0
    a, b = np.ascontiguousarray(compliance[np.ix_(free, free)]), moved[free]
    x, r, p = np.zeros_like(b), b.copy(), b.copy()
    rr = float(r @ r)
    for _ in range(_HOLDS):
        if np.abs(r).max(initial=0.0) < _CLOSE:
            break
        ap = product(a, p[:, None])[:, 0]
        curvature = float(p @ ap)
        if not curvature > 0.0:  # rounding of float32 is all that is left
            break
        alpha = np.float32(rr / curvature)
        x, r = x + alpha * p, r - alpha * ap
        rr, before = float(r @ r), rr
        beta = np.float32(rr / before)
        p = r + beta * p
    force = np.zeros_like(moved)
    force[free] = x
    return force


def _span(used: np.ndarray, margin: int) -> slice:
    """From the first to the last that is true, and ``margin`` more."""
    at = np.flatnonzero(used)
    return slice(max(int(at[0]) - margin, 0), int(at[-1]) + 1 + margin)
