"""State of the shear of all contacts of a world (see ``shear``)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.contact_shear import ContactShear
from raytac.physics.rigid.shear import MOST_RINGS
from raytac.physics.rigid.world_kernels import Shear


class _Member:
    """An array of ``ShearState`` as NumPy has it."""

    def __set_name__(self, _: type, name: str) -> None:
        self._name = name

    def __get__(self, state: ShearState, _: type) -> np.ndarray:
        view = state.views.get(self._name)
        if view is None:
            view = getattr(state.struct, self._name).numpy()
            view.flags.writeable = False  # a copy: what is written to it would be lost
        return view


class ShearState:
    """Stretch of all contacts, a row for each environment, pad and body.

    The arrays are views of the kernels'; on CUDA they are copies, made when one asks for them.

    Attributes:
        stretch: displacement [m] along two tangents and rotation [rad] about the normal, of both parts of every ring, from the middle
            outwards, (…, 2 MOST_RINGS, 3); 0 beyond the contact.
        inner: width of the inner part of every ring over the ring's, (…, MOST_RINGS).
        width: shear stiffness of a ring [N/m], (…).
        mean: of ``stretch`` by stiffness, (…, 3).
        stiffness: shear and twist stiffness at the last step [N/m, N m/rad], (…, 2); 0 out of contact.
        load: tangential force and torque at which the contact slips [N, N m], (…, 2).
        centre: of the contact [m], (…, 3).
        play: travel of the centre over the gel and over the body that does not count as rolling yet, along both tangents [m], (…, 2, 2).
        moved: displacement of the body over the gel in the last step, along both tangents [m], (…, 2).
        struct: the arrays for kernels.
        views: on the CPU, the arrays.
    """

    stretch = _Member()
    inner = _Member()
    width = _Member()
    mean = _Member()
    stiffness = _Member()
    load = _Member()
    centre = _Member()
    play = _Member()
    moved = _Member()

    def __init__(self, num_envs: int, pads: int, bodies: int, *, device: str = "cpu") -> None:
        shape = num_envs, pads, bodies
        struct: Any = Shear()
        for name, (inner, dtype) in _ARRAYS.items():
            setattr(struct, name, wp.zeros((*shape, *inner), dtype=dtype, device=device))
        self.struct = struct
        on_cpu = wp.get_device(device).is_cpu
        self.views: dict[str, np.ndarray] = {name: getattr(struct, name).numpy() for name in _ARRAYS} if on_cpu else {}

    def of(self, envs: np.ndarray, pad: int, body: np.ndarray) -> ContactShear:
        """Shear of one contact of each environment; body −1 is none."""
        rows = envs, pad, np.maximum(body, 0)
        load = self.load[*rows, 0]
        touched = (body >= 0) & (load > 0.0)
        mean = np.where(touched[:, None], self.mean[rows], 0.0)
        force = np.sqrt(mean[:, 0] ** 2 + mean[:, 1] ** 2) * self.stiffness[*rows, 0]
        share = np.minimum(force / np.where(touched, load, 1.0), 1.0)
        stuck = np.where(touched, np.cbrt(1.0 - share), 0.0)
        return ContactShear(mean[:, :2], mean[:, 2], stuck, np.where(touched[:, None], self.centre[rows], 0.0))


_ARRAYS: dict[str, tuple[tuple[int, ...], Any]] = {
    "stretch": ((2 * MOST_RINGS,), wp.vec3d),
    "inner": ((MOST_RINGS,), wp.float64),
    "width": ((), wp.float64),
    "mean": ((), wp.vec3d),
    "stiffness": ((), wp.vec2d),
    "load": ((), wp.vec2d),
    "centre": ((), wp.vec3d),
    "play": ((2,), wp.vec2d),
    "moved": ((), wp.vec2d),
}
