"""``Engine``: stepper of B environments with room for the contacts of gels in a step.

``RigidPads`` is the order of a step for engines that the host steps; ``MujocoWarp.advance`` is the same order for one that it does not::

    contact.choose(envs, done)      # the environments of this step
    engine.begin_step()             # positions, collision, velocities
    drive(envs)                     # controllers read the state and write controls
    engine.free_acceleration()      # what everything but constraints gives
    engine.read_frames()            # -> contact.frames
    contact.begin()                 # contact.frames -> contact.steps, contact.slots
    engine.put_contacts()           # contact.slots -> constraint rows
    engine.end_step()               # solve and integrate, by the length of each environment's step
    engine.read_rows()              # -> contact.force, contact.velocity, contact.steps.lost
    contact.end()                   # the gels shear

An engine is made for one ``GelContact``, whose arrays it reads and writes on one device. These are float64 for every engine.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class Engine(Protocol):
    """States of B environments of one model that MuJoCo steps.

    ``contact.steps.envs`` names the environments of a step, one a row; row i of ``frames``, ``steps``, ``slots``, ``force`` and
    ``velocity`` is of environment ``envs[i]``, and −1 is no environment. An environment that is ``lost`` is not stepped: its state is
    that of the beginning of the step, and its rows are not read.

    Attributes:
        divides: True if the host names the environments of every step, those that are not named stand still at no cost, and rows are
            compact: what ``RigidPads`` needs. If False row i is environment i, and the engine has the order of a step itself, so that
            nothing waits for the host.
        device: of all arrays.
    """

    @property
    def divides(self) -> bool: ...

    @property
    def device(self) -> Any: ...

    def begin_step(self) -> None:
        """Positions, velocities, collision and bias forces of the environments of this step."""
        ...

    def free_acceleration(self) -> None:
        """Accelerations by the controls, without contacts and other constraints."""
        ...

    def read_frames(self) -> object:
        """Write ``contact.frames``: frames of pads and bodies, velocities, free accelerations.

        It launches kernels only, the same ones each time, so that it can be recorded with ``contact.begin``. Before ``free_acceleration``
        the accelerations are those of an earlier step.
        """
        ...

    def put_contacts(self, *, own_step: bool = True) -> None:
        """Put the contacts of ``contact.slots`` among MuJoCo's own.

        They keep their regularisation and reference accelerations.
        Where a slide may begin or end (``contact.steps.slides``), the lift of MuJoCo's cone is solved for. An environment whose memory
        for contacts is full is lost. ``own_step``: ``end_step`` follows, not a step of somebody else.
        """
        ...

    def end_step(self) -> None:
        """Solve for forces, and integrate."""
        ...

    def read_rows(self) -> object:
        """Write ``contact.force`` and ``contact.velocity`` of the gels' rows at the step's end.

        Environments are lost in which a number is not finite, or a joint is far too fast. It launches kernels only, as ``read_frames``.
        """
        ...

    def update_poses(self) -> None:
        """Poses of the present positions, of the environments of this step."""
        ...

    def read_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """``world_from_pad`` (B, pads, 4, 4) and ``world_from_body`` (B, bodies, 4, 4), on the host.

        They are those that the last ``begin_step`` or ``update_poses`` computed.
        """
        ...

    def prepare(self) -> None:
        """Take over models that a variation changed; once before the steps of a call.

        Raises ``InputError``: a model was changed so that pads cannot act, or contacts were lost for want of memory.
        """
        ...

    def invalid(self) -> np.ndarray:
        """True (B,) on the host for states not finite or with a joint far too fast."""
        ...
