"""A press scene as a session: its trajectory, and sliders to press, shear and twist.

No slider tilts; a tilt that the scene has made stays while the sliders drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np

from raytac.errors import RaytacError
from raytac.frame import TactileFrame
from raytac.physics.base import PadReading
from raytac.physics.press import twist_of
from raytac.physics.soft.bodies import OBJECT, PAD
from raytac.physics.soft.pad import SoftPad
from raytac.sensor import TactileSensor
from raytac.shapes.triangulate import object_surface
from raytac.specs import PressScene, validate_press
from raytac.specs.press import StageSpec
from raytac.view.sensor_view import (
    coat_edges,
    coat_lines,
    coat_pad,
    narrow_warning,
    pad_view,
    rest_image,
    sensor_lines,
    sensor_solids,
    square,
    strided,
)
from raytac.view.session import CameraPlace, Control, Handle, HandlePlace, Snapshot, Solid, check_targets, reaching, turned_by

_STRIDE_MM, _TURN_DEG, _PUSH = 0.1, 2.0, 0.25
"""Largest change from one state to the next towards a slider's value: [mm], [degrees], [N]."""
_NEAR = {"depth": 0.004, "force": 0.02, "shear_x": 0.004, "shear_y": 0.004, "twist": 0.1}
"""A control is there when it is this close, in its unit."""
_DEEPEST = 0.4
"""Share of the pad's thickness that the depth slider reaches, more if the scene goes deeper."""
_STRONGEST, _FARTHEST, _WIDEST = 20.0, 2.0, 30.0
"""Ends of the sliders for force [N], shear [mm] and twist [degrees], until exceeded."""
_STATES, _SIMULATED_STATES = 20, 10
"""States that show a stage of a trajectory; a soft pad's cost a solver step each, at least."""
_SAG = 1e-5
"""Largest depth of the drawn facets below a curved object's true surface [m]."""
_OBJECT_COLOUR = (150, 156, 166)


class PressSession:
    """One sensor and the object of a press (see ``Session``); the world frame is the pad frame."""

    units_per_metre = 100.0
    is_driven_at_rest = True

    def __init__(self, sensor: TactileSensor, scene: PressScene) -> None:
        """Put the object before the sensor; nothing is imaged yet.

        Args:
            sensor: with ``num_envs = 1``; what it does not output is not shown.
            scene: of any physics. Without an object, or with one that lies free, there are no sliders.

        Raises:
            RaytacError: as ``TactileSensor.load``.
        """
        validate_press(sensor.spec, scene)
        self._sensor, self._stages = sensor, len(scene.trajectory)
        self._is_drivable = scene.object.kind != "none" and scene.object.dynamics != "affine"
        if self._is_drivable:
            # One more stage, never played: a soft pad then keeps as much of the object as the sliders can bring near the gel.
            scene = replace(scene, trajectory=(*scene.trajectory, StageSpec("indent", force=_STRONGEST)))
        self._pad = sensor.load(scene)
        self.title = f"{scene.name} · {sensor.spec.name} · {sensor.label}"
        size = max(sensor.spec.gelpad.size)
        self.camera = CameraPlace((0.9 * size, -1.75 * size, 1.35 * size), (0.0, 0.0, -0.15 * size))
        self._own_controls = self._make_controls(scene) if self._is_drivable else ()
        self.handle = Handle(("shear_x", "shear_y", "-depth"), ("", "", "twist")) if self._is_drivable else None
        self._grid = strided(self._pad.grid)
        self._rest = rest_image(sensor)
        self.pads = (coat_pad(sensor.spec.name, sensor, self._grid),)
        self.solids = (*sensor_solids(sensor.spec), *self._object_solids())
        coat = (coat_lines("coat_mesh"),) if isinstance(self._pad, SoftPad) else ()
        self.lines = (*sensor_lines(sensor.spec), *coat)
        self._targets: dict[str, float] = {}
        """Controls that were moved and hold the object, in their own unit."""
        self._states: Iterator[PadReading] = iter(())
        self.reset()

    def reset(self) -> None:
        self._targets = {}
        self.controls: tuple[Control, ...] = self._own_controls
        self._has_ended = False
        if self._sensor.markers is not None:
            self._sensor.reset_markers()
        self._states = self._pad.run(_SIMULATED_STATES if isinstance(self._pad, SoftPad) else _STATES)
        self._state = next(self._states)
        self._start = self._state.pad_from_object[0]
        self._shot: Snapshot | None = None

    def resume(self) -> None:
        if self._targets or self._has_ended:
            self.reset()

    def drive(self, targets: Mapping[str, float]) -> None:
        check_targets(self.controls, targets)
        for name, value in targets.items():
            control = next(c for c in self.controls if c.name == name)
            self._targets.pop(control.instead_of, None)
            self._targets[name] = value
        # In the order of a press, whatever slider was moved first: an object that is sheared before it is pressed feels nothing.
        stages = [self._stage_to(control.name) for control in self.controls if control.name in self._targets]
        self._states = chain.from_iterable(self._pad.follow(stage, steps) for stage, steps in stages if stage is not None)

    def advance(self) -> bool:
        state = next(self._states, None)
        if state is None or state.stage >= self._stages:
            self._has_ended = not self._targets
            return False
        if state.failed[0]:
            self._states, self._has_ended = iter(()), True
            text = "the physics broke down here: the state did not settle or is not finite; reset, or try smaller steps"
            raise RaytacError(text)
        self._state, self._shot = state, None
        self.controls = reaching(self.controls, self._places())
        return True

    def snapshot(self) -> Snapshot:
        if self._shot is None:
            self._shot = self._drawn(self._sensor.update(self._state))
        return self._shot

    def _make_controls(self, scene: PressScene) -> tuple[Control, ...]:
        thickness = 1e3 * self._sensor.spec.gelpad.thickness
        deepest = max([_DEEPEST * thickness, *(1e3 * (stage.depth or 0.0) for stage in scene.trajectory)])
        return (
            Control("depth", "depth [mm]", 0.0, round(deepest, 2), 0.01, "Below first touch; 0 lifts the object off", "force"),
            Control("force", "force [N]", 0.0, _STRONGEST, 0.05, "Normal force, kept through shear, twist and tilt", "depth"),
            Control("shear_x", "shear x [mm]", -_FARTHEST, _FARTHEST, 0.02),
            Control("shear_y", "shear y [mm]", -_FARTHEST, _FARTHEST, 0.02),
            Control("twist", "twist [°]", -_WIDEST, _WIDEST, 0.5),
        )

    def _stage_to(self, name: str) -> tuple[StageSpec | None, int]:
        """Stage and number of states to the target of the control ``name``; None if it is there."""
        now, target = self._places(), self._targets[name]
        change = target - now[name]
        if abs(change) <= _NEAR[name]:
            return None, 0
        if name in ("shear_x", "shear_y"):
            # Both are one stage; the one whose slider was not moved stays where it is.
            ends = tuple(self._targets.get(side, now[side]) for side in ("shear_x", "shear_y"))
            distance = np.hypot(ends[0] - now["shear_x"], ends[1] - now["shear_y"])
            return StageSpec("shear", shear=(1e-3 * ends[0], 1e-3 * ends[1])), _steps(distance / _STRIDE_MM)
        if name == "twist":
            return StageSpec("twist", twist=float(np.radians(target))), _steps(change / _TURN_DEG)
        steps = _steps(change / (_STRIDE_MM if name == "depth" else _PUSH))
        if target == 0.0:
            return StageSpec("release"), steps
        return (StageSpec("indent", depth=1e-3 * target) if name == "depth" else StageSpec("indent", force=target)), steps

    def _places(self) -> dict[str, float]:
        """Present value of each control, in its unit."""
        pose = self._state.pad_from_object[0]
        turned = pose[:3, :3] @ self._start[:3, :3].T
        x, y = 1e3 * (pose[:2, 3] - self._start[:2, 3])
        return {
            "depth": max(1e3 * float(self._state.depth[0]), 0.0),
            "force": float(self._state.normal_force[0]),
            "shear_x": float(x),
            "shear_y": float(y),
            "twist": float(np.degrees(twist_of(turned))),
        }

    def _object_solids(self) -> tuple[Solid, ...]:
        """The object as solids of its own frame; half-spaces as squares."""
        if not self._pad.parts:
            return ()
        soft = self._soft_object()
        if soft is not None:
            return (Solid("object", *soft, _OBJECT_COLOUR, hides_pads=True),)
        closed = [part for part in self._pad.parts if part.kind != "plane"]
        shapes = []
        if closed:
            surface = object_surface(closed, _SAG)
            shapes.append(Solid("object", surface.vertices, surface.faces, _OBJECT_COLOUR, hides_pads=True))
        corners, faces = square(2.0 * max(self._sensor.spec.gelpad.size))
        for k, part in enumerate(p for p in self._pad.parts if p.kind == "plane"):
            pose = part.object_from_part
            vertices = corners @ pose[:3, :3].T + pose[:3, 3]
            shapes.append(Solid(f"object_plane_{k}", vertices, faces, _OBJECT_COLOUR, 0.5))
        return tuple(shapes)

    def _soft_object(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Vertices (V, 3) [m], pad frame, and faces of a deforming object now; None if rigid."""
        solver = self._pad.solver if isinstance(self._pad, SoftPad) else None
        if solver is None or not solver.body.is_soft:
            return None
        vertices, faces = solver.scene.mesh(OBJECT, PAD)
        return vertices[0], faces

    def _drawn(self, frame: TactileFrame) -> Snapshot:
        """All that the page shows of a frame and of the present reading."""
        name, surface = self._sensor.spec.name, frame.surface
        pads = {name: pad_view(frame, self._grid, np.eye(4), rest_rgb=self._rest)}
        time_ms = frame.time_ms  # after ``pad_view``, which waits for the images
        poses = {solid.name: self._state.pad_from_object[0] for solid in self.solids if solid.name.startswith("object")}
        reshaped: dict[str, np.ndarray] = {}
        if isinstance(self._pad, SoftPad):
            if surface.coat is not None:
                reshaped["coat_mesh"] = coat_edges(surface, self._grid)
            soft = self._soft_object()
            if soft is not None:
                reshaped["object"], poses["object"] = soft[0], np.eye(4)
        controls = {name: self._targets.get(name, value) for name, value in self._places().items()} if self._is_drivable else {}
        return Snapshot(
            pads=pads,
            poses=poses,
            reshaped=reshaped,
            controls=controls,
            facts=self._facts(frame),
            warning=narrow_warning(frame),
            time_ms={"image": sum(time_ms.values()), **time_ms},
            handle=self._handle_place(),
        )

    def _handle_place(self) -> HandlePlace | None:
        if not self._is_drivable:
            return None
        values, pose = self._places(), np.eye(4)
        pose[:3, :3] = turned_by(np.radians([0.0, 0.0, values["twist"]]))
        pose[:3, 3] = self._state.pad_from_object[0, :3, 3]
        return HandlePlace(pose, {**values, "depth": 1e3 * float(self._state.depth[0])})

    def _facts(self, frame: TactileFrame) -> dict[str, str]:
        state, surface = self._state, frame.surface
        stage = "held by the sliders" if self._targets else f"{state.kind} {100.0 * state.fraction:.0f} %"
        facts = {"stage": stage}
        if self._is_drivable:
            facts["depth"] = f"{1e3 * float(state.depth[0]):.3f} mm"
        facts["deepest imprint"] = f"{1e3 * float(np.nanmax(surface.indentation[0])):.3f} mm"
        if "contact_area" in frame.outputs:
            facts["contact area"] = f"{1e6 * float(frame.contact_area[0]):.2f} mm²"
        return facts


def _steps(strides: float) -> int:
    """Whole number of states for so many of the largest changes, at least one."""
    return max(int(np.ceil(abs(strides))), 1)
