"""Where pads and bodies of a soft scene go in a step: their poses, and into how many parts the step must be cut."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.physics.rotation import between, rotations
from raytac.physics.soft_approach import STEP, TURN, Mover, Pair, allowed_share
from raytac.physics.soft_bodies import SceneBody

if TYPE_CHECKING:
    from raytac.physics.soft_scene import SoftScene

__all__ = ["MOST_SUBSTEPS", "Poses", "Travel"]

MOST_SUBSTEPS = 64
"""Parts that one step may be cut into: 6.4 mm or 128° near something."""
_REACH = 4.0
"""Bodies closer than so many d̂ are near."""


@dataclass(frozen=True)
class Poses:
    """Of all that is driven, ``world_from_…``."""

    pads: np.ndarray
    """(B, S, 4, 4)."""
    bodies: dict[str, np.ndarray]
    """(B, 4, 4) by name."""

    def copy(self) -> Poses:
        return Poses(self.pads.copy(), {name: pose.copy() for name, pose in self.bodies.items()})

    def towards(self, goal: Poses, share: float) -> Poses:
        """A share of the way to ``goal``."""
        pads = [between(self.pads[:, k], goal.pads[:, k], share) for k in range(self.pads.shape[1])]
        return Poses(np.stack(pads, axis=1), {name: between(self.bodies[name], p, share) for name, p in goal.bodies.items()})

    def longest(self, goal: Poses, b: int) -> float:
        """Longest way of any origin of environment ``b`` to ``goal`` [m]."""
        ways = [np.linalg.norm((goal.pads - self.pads)[b, :, :3, 3], axis=-1).max()]
        ways += [np.linalg.norm((goal.bodies[n] - p)[b, :3, 3]) for n, p in self.bodies.items()]
        return float(max(ways))


class Travel:
    """Cuts the steps of a scene: half, a quarter and so on of it, never more than bodies that are near may move against each other."""

    def __init__(self, scene: SoftScene) -> None:
        self.scene = scene
        pads, bodies = list(scene.pads), list(scene.bodies.values())
        self.pairs: list[Pair] = [(a, b) for k, a in enumerate(pads) for b in pads[k + 1 :]]
        self.pairs += [(a, b.name) for a in pads for b in bodies]
        for k, a in enumerate(bodies):  # the solver alone sees to those that are both free; a half-space comes second
            others = [b for b in bodies[k + 1 :] if a.is_driven != b.is_driven]
            flip = isinstance(a.solid, ipc.HalfSpace)
            self.pairs += [(b.name, a.name) if flip else (a.name, b.name) for b in others]

    def part(self, done: int, now: Poses, goal: Poses, dt: float) -> tuple[int, dict[int, Pair | None]]:
        """How much of a step of ``dt`` [s] may be made next, and environments where even the least part is too much, with the pair.

        In ``MOST_SUBSTEPS``-ths, a power of two that ``done`` is a multiple of; what is too much counts for nothing in it. What no one
        drives may be too fast (a beam that snaps back): that is the solver's to resolve, in the smallest parts.
        """
        room, pairs = self._room(done, self._movers(now, goal, dt * (1.0 - done / MOST_SUBSTEPS)))
        if (room < 1.0).any():
            driven = self._room(done, self._movers(now, goal, 0.0))[0]
            room = np.where((room < 1.0) & (driven >= 1.0), 1.0, room)
        least = room[room >= 1.0].min(initial=MOST_SUBSTEPS)
        part = MOST_SUBSTEPS
        while part > least or done % part:
            part //= 2
        return part, {b: pairs[b] for b in np.flatnonzero(room < 1.0).tolist()}

    def _room(self, done: int, movers: Mapping[str, Mover]) -> tuple[np.ndarray, list[Pair | None]]:
        """Sixty-fourths of the step that these motions leave in every environment (B,), and the pairs that set it."""
        pairs = [(a, b) for a, b in self.pairs if not (_is_still(movers[a]) and _is_still(movers[b]))]
        share, limiting = allowed_share(movers, pairs, _REACH * self.scene.world.d_hat)
        return (MOST_SUBSTEPS - done) * share * (1.0 + 1e-9), limiting

    def refusal(self, b: int, pair: Pair | None, now: Poses, goal: Poses) -> InputError:
        """The error of a motion of environment ``b`` that cannot be resolved."""
        where = f"in environment {b} " if self.scene.num_envs > 1 else ""
        rule = (
            f"{where}takes {' and '.join(pair or ())} too far against each other where they are near: "
            f"at most {MOST_SUBSTEPS * STEP * 1e3:.3g} mm "
            f"or {np.degrees(MOST_SUBSTEPS * TURN):.3g} degrees in one step of {self.scene.settings.dt} s; move slower or in more steps"
        )
        return InputError("world_from_pad", value=f"ways of up to {now.longest(goal, b) * 1e3:.3g} mm", rule=rule)

    def _movers(self, now: Poses, goal: Poses, left: float) -> dict[str, Mover]:
        found = {}
        for k, (name, pad) in enumerate(self.scene.pads.items()):
            rest, at = pad.mesh.tets.vertices, self.scene.world.positions(name, frame="body")
            low, high = np.minimum(rest.min(axis=0), at.min(axis=1)), np.maximum(rest.max(axis=0), at.max(axis=1))
            found[name] = Mover(now.pads[:, k], goal.pads[:, k], low, high)
        for name, body in self.scene.bodies.items():
            found[name] = self._mover(body, now.bodies, goal.bodies, left)
        failed = self.scene.failed[:, None, None]
        if failed.any():  # nothing moves there, whatever speed it had
            found = {name: replace(mover, end=np.where(failed, mover.start, mover.end)) for name, mover in found.items()}
        return found

    def _mover(self, body: SceneBody, now: Mapping[str, np.ndarray], goal: Mapping[str, np.ndarray], left: float) -> Mover:
        name, solid, one = body.name, body.solid, np.ones((self.scene.num_envs, 1))
        if isinstance(solid, ipc.HalfSpace):
            return Mover(now[name], goal[name], 0.0 * one, 0.0 * one, is_plane=True)
        start = now[name] if body.is_driven else self.scene.pose(name)
        if isinstance(solid, ipc.SoftBody):
            at = np.einsum("bji,bnj->bni", start[:, :3, :3], self.scene.world.positions(name) - start[:, None, :3, 3])
            end = self._pulled(solid, start, goal[name], left) if body.is_driven else self._carried(name, start, left)
            return Mover(start, end, at.min(axis=1), at.max(axis=1))
        vertices = solid.surface.vertices
        end = goal[name] if body.is_driven else self._carried(name, start, left)
        return Mover(start, end, one * vertices.min(axis=0), one * vertices.max(axis=0))

    def _carried(self, name: str, start: np.ndarray, left: float) -> np.ndarray:
        """Where a free body's momentum takes its pose in the time ``left`` [s]."""
        motion = self.scene.world.rigid_motion(name)
        return _moved(start, motion.centre, left * motion.velocity, left * motion.spin)

    def _pulled(self, solid: ipc.SoftBody, start: np.ndarray, goal: np.ndarray, left: float) -> np.ndarray:
        """The same of a soft body that is held somewhere: its places in contact, as they move now; without any, it is where it is held."""
        world = self.scene.world
        load = np.linalg.norm(world.contact_forces(solid.name), axis=2)
        touched = load.sum(axis=1) > 0.0
        if not touched.any():
            return goal
        nodes = world.surface(solid.name)[0]
        x, v = world.positions(solid.name)[:, nodes], world.velocities(solid.name)[:, nodes]
        share = load / np.where(touched, load.sum(axis=1), 1.0)[:, None]
        centre, velocity = np.einsum("bn,bni->bi", share, x), np.einsum("bn,bni->bi", share, v)
        arm = x - centre[:, None]
        second = np.einsum("bn,bni,bnj->bij", share, arm, arm) + 1e-12 * np.eye(3)
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        momentum = np.einsum("bn,bni->bi", share, np.cross(arm, v - velocity[:, None]))
        spin = np.linalg.solve(inertia, momentum[..., None])[..., 0]
        return np.where(touched[:, None, None], _moved(start, centre, left * velocity, left * spin), goal)


def _moved(poses: np.ndarray, centre: np.ndarray, way: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) after a turn about a centre [m] and a way, (B, 3) each."""
    rotation, found = rotations(turn), poses.copy()
    found[:, :3, :3] = rotation @ poses[:, :3, :3]
    found[:, :3, 3] = centre + way + np.einsum("bij,bj->bi", rotation, poses[:, :3, 3] - centre)
    return found


def _is_still(mover: Mover) -> bool:
    return np.array_equal(mover.start, mover.end)
