"""What a soft scene answers to MuJoCo after each of its steps: wrenches, and contacts with bounds of their stiffness."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from raytac.physics.soft.scene import SoftScene
from raytac.world.coupling import FreePartner, Touching

__all__ = ["STIFFENING", "Answer", "soft_answers"]

Answer = tuple[np.ndarray, list[Touching], dict[str, FreePartner]]
"""Wrenches (n, 6), contacts and partners of one environment, as ``Coupling.update`` takes them."""
STIFFENING = 2.0
"""How much stiffer than at rest a held soft body is taken to be: it stiffens as it is stretched, twisted or sheared (docs/coupling.md)."""
_HARD = 2e5
"""Stiffness of contact between bodies without gel [N/m], as hard as a gel's whole face (a guess)."""


def soft_answers(scene: SoftScene, links: Mapping[str, int]) -> list[Answer]:
    """Answers of every environment after a step of ``scene``.

    Args:
        links: MuJoCo's body under the frame of every pad and driven body that MuJoCo moves, by name; the order is that of the
            wrenches. Driven bodies left out stand still.
    """
    wrench = np.stack([scene.wrench(name) if name in scene.pads else scene.body_wrench(name) for name in links], axis=1)
    pressing = scene.world.pressing()
    bounds = {name: scene.stiffness(name) for name in scene.pads if any(name in pair for pair in pressing)}
    touched = {name: body for name, body in scene.bodies.items() if any(name in pair for pair in pressing)}
    free = {name: _partners(scene, name) for name, body in touched.items() if not body.is_driven}
    held = [name for name, body in touched.items() if body.is_driven and body.is_soft]
    answers: list[Answer] = []
    for b in range(scene.num_envs):
        contacts, partners = [], {name: motions[b] for name, motions in free.items()}
        for name in held:
            _hold(scene, name, b, contacts, partners)
        for (one, two), found in pressing.items():
            if one == two:  # folds of one gel
                continue
            sides = [links.get(name, name if name in partners else None) for name in (one, two)]
            if not found.normal[b].any() or sides == [None, None] or (None in sides and any(side in held for side in sides)):
                continue
            first, other, sign = sides[0], sides[1], 1.0
            if first is None:
                first, other, sign = sides[1], None, -1.0
            pads = [bounds[name][b] for name in (one, two) if name in bounds]
            stiffness = _weakest(pads) if pads else np.diag([_HARD] * 3 + [0.0] * 3)
            assert first is not None
            contacts.append(Touching(first, stiffness, found.place[b], other, sign * found.normal[b], sign * found.wrench[b]))
        answers.append((wrench[b], contacts, partners))
    return answers


def _weakest(bounds: list[np.ndarray]) -> np.ndarray:
    """Two pads against each other give way one after the other; one bound is enough, and safe."""
    return min(bounds, key=np.trace)


def _hold(scene: SoftScene, name: str, b: int, contacts: list[Touching], partners: dict[str, FreePartner]) -> None:
    """The stand-in of a soft body that is held somewhere: the patch that is touched, on the spring that the body is to it.

    What acts on it is in balance but for its inertia, which is taken for none.
    """
    patch = scene.world.held_patch(name, b)
    if patch is None:
        return
    partners[name] = FreePartner(patch.mass, patch.inertia, patch.centre, patch.velocity, np.zeros(6))
    contacts.append(Touching(name, STIFFENING * patch.stiffness, patch.centre))


def _partners(scene: SoftScene, name: str) -> list[FreePartner]:
    motion, gravity = scene.world.rigid_motion(name), scene.gravity
    wrench = scene.body_wrench(name)
    force = wrench[:, :3] + motion.mass * gravity
    torque = wrench[:, 3:] + np.cross(scene.pose(name)[:, :3, 3] - motion.centre, wrench[:, :3])
    return [
        FreePartner(
            motion.mass,
            motion.inertia[b],
            motion.centre[b],
            np.concatenate([motion.velocity[b], motion.spin[b]]),
            np.concatenate([force[b], torque[b]]),
        )
        for b in range(scene.num_envs)
    ]
