"""Check of a world's start: which bodies may not overlap there."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.world.world_model import WorldModel

_OVERLAP = 1e-4
"""Greatest overlap of rigid bodies at the start [m]: rounding of a scene's lengths."""


def check_start(composed: WorldModel, data: mujoco.MjData, overlaps: Sequence[tuple[str, str, float]]) -> None:
    """Raise ``InputError`` for a start ``data`` in which bodies overlap.

    ``overlaps``: sensor, body and depth [m]. A user's own model may start in contact, but not through a pad.
    """
    model, scene = composed.model, composed.scene
    for contact in data.contact[: data.ncon]:
        if contact.dist < -_OVERLAP and scene is not None:
            names = [model.body(int(model.geom_bodyid[g])).name or "world" for g in contact.geom]
            rule = f"overlap by {-contact.dist * 1e3:.3g} mm at the start: move one of them in the scene"
            raise InputError("bodies", value=tuple(names), rule=rule)
    for sensor, body, depth in overlaps:
        if depth > (_OVERLAP if scene is not None else np.inf) or np.isinf(depth):
            rule = f"must not be pressed into the pad of {sensor!r} at the start; it is, by {depth * 1e3:.3g} mm"
            if np.isinf(depth):
                large = _size_if_large(composed, body)
                rule = f"must not start beyond the face that the gel of {sensor!r} is bonded to{large}"
            raise InputError("body", value=body, rule=rule)


def _size_if_large(composed: WorldModel, name: str) -> str:
    """End of a message: the diameter of a body's largest geom, if it is beyond 1 m."""
    geoms = list(composed.bodies[name].geoms)
    size = 2.0 * float(composed.model.geom_rbound[geoms].max(initial=0.0))
    return f"; it is {size:.3g} m large: are its units metres?" if size > 1.0 else ""
