"""A session without physics, whose every number is known: what the player and the page are tested with."""

from __future__ import annotations

import threading
from collections.abc import Mapping

import numpy as np

from raytac.errors import RaytacError
from raytac.view.session import CameraPlace, Control, Handle, HandlePlace, Lines, Pad, PadView, Snapshot, Solid

LENGTH = 5
"""States of its own motion."""


class StillSession:
    """Counts: ``at`` goes up by one a state, or one towards ``target``; ``reach`` is driven, 13 cannot be reached."""

    title = "still · nothing"
    units_per_metre = 100.0
    camera = CameraPlace((0.02, -0.03, 0.02), (0.0, 0.0, 0.0))
    controls: tuple[Control, ...] = (
        Control("reach", "reach [mm]", 0.0, 100.0, 0.5),
        Control("push", "push [N]", 0.0, 10.0, 0.5, instead_of="reach"),
    )
    solids = (Solid("block", np.eye(3) * 1e-2, np.array([[0, 1, 2]]), (200, 100, 50), hides_pads=True),)
    lines = (Lines("axis", np.zeros((1, 2, 3)), (10, 20, 30)),)
    pads = (Pad("left", np.array([[0, 1, 2]]), ("indentation", "pressure")),)
    handle: Handle | None = Handle(("reach", "", "-push"))

    def __init__(self, *, is_driven_at_rest: bool = True) -> None:
        self.is_driven_at_rest = is_driven_at_rest
        self.at, self.target, self.calls = 0.0, None, []
        self.gate = threading.Event()
        """Closed, ``advance`` waits: what arrives meanwhile must be coalesced."""
        self.gate.set()

    def reset(self) -> None:
        self.calls.append("reset")
        self.at, self.target = 0.0, None

    def resume(self) -> None:
        self.calls.append("resume")
        if self.target is not None or self.at >= LENGTH:
            self.at, self.target = 0.0, None

    def drive(self, targets: Mapping[str, float]) -> None:
        self.calls.append(dict(targets))
        if 13.0 in targets.values():
            raise RaytacError("13 cannot be reached")
        if 14.0 in targets.values():
            raise ZeroDivisionError("fourteen")
        self.target = list(targets.values())[-1]

    def advance(self) -> bool:
        assert self.gate.wait(10.0)
        if self.target is not None:
            if self.at == self.target:
                return False
            self.at += np.clip(self.target - self.at, -1.0, 1.0)
            return True
        if self.at >= LENGTH:
            return False
        self.at += 1.0
        return True

    def snapshot(self) -> Snapshot:
        value = 1e-3 * self.at
        flat = np.array([[0.0, 0.0, 0.0], [1e-2, 0.0, 0.0], [0.0, 1e-2, 0.0]])
        view = PadView(
            np.eye(4),
            flat - [0.0, 0.0, value],
            {"indentation": np.full(3, value), "pressure": np.full(3, 1e6 * value)},
            rgb=np.full((6, 8, 3), int(10 * self.at) % 256, np.uint8),
            wrench=np.array([0.0, 0.0, -self.at, 0.0, 0.0, 1e-3 * self.at]),
            rest_rgb=np.zeros((6, 8, 3), np.uint8),
            height=np.full((6, 8), -value),
            normals=np.broadcast_to([0.0, 0.0, -1.0], (6, 8, 3)),
        )
        values, pose = {"reach": self.at, "push": 0.1 * self.at}, np.eye(4)
        pose[0, 3], pose[2, 3] = value, -1e-4 * self.at
        place = HandlePlace(pose, values)
        return Snapshot({"left": view}, controls=values, facts={"at": f"{self.at:g}"}, handle=place)
