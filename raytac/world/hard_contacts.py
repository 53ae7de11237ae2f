"""Contacts between rigid bodies beside rigid pads.

A gap is closed by a step exactly, and a penetration is taken back slowly.

MuJoCo finds a contact when bodies overlap already. With long steps a body falls into a table, a corner that lifts by a micrometre has no
contact for a step and falls again, and what rests chatters. Here contacts are known up to a margin before they close, and the constraint
asks for the speed at the end of a step by which a gap is just closed, v = −gap / Δt. A penetration is taken back by a tenth in a step, so
that bodies do not bounce off it. Both hold for steps of any length.

The gap that MuJoCo tells of two boxes is that along one direction. Where the boxes pass each other, its points lie beside one of them, or
will when the gap is closed, and nothing is to be stopped there.

MuJoCo's convex cone lifts what slides by μ |v_t| Δt (M. Anitescu, Math. Program. 105, 2006): by 0.2 mm at 0.1 m/s, μ = 0.2 and 10 ms. It
would push a body away from one that it slides past. So a contact whose gap is there before and after a step has no friction in it.

``write_references`` of ``engine.c_kernels`` and ``write_hard_references`` of ``engine.mjwarp_kernels`` set all this.
"""

from __future__ import annotations

import mujoco
import numpy as np

HARD_MARGIN = 3e-3
"""Margin of such geoms [m]: largest approach in a step that leaves no overlap at its end."""


def is_hard(model: mujoco.MjModel) -> np.ndarray:
    """True (ngeom,) for geoms of bodies that a task scene names, which alone follow this law."""
    return (model.geom_margin == HARD_MARGIN) & (model.geom_priority == 1)


def box_sizes(model: mujoco.MjModel) -> np.ndarray:
    """Half edges [m] of geoms that are boxes, else 0, (ngeom, 3)."""
    return np.where((model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)[:, None], model.geom_size, 0.0)
