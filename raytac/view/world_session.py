"""A task scene as a session: time runs while it plays, and sliders steer the robot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np

from raytac.errors import RaytacError
from raytac.frame import TactileFrame
from raytac.physics.geoms import geom_part
from raytac.shapes.triangulate import part_surface
from raytac.view.sensor_view import (
    MESH_COLOUR,
    MESH_WIDTH,
    coat_edges,
    gel_solid,
    grid_faces,
    narrow_warning,
    pad_view,
    strided,
)
from raytac.view.session import CameraPlace, Colour, Control, Lines, Pad, Snapshot, Solid, check_targets
from raytac.view.steering import Steering
from raytac.world.state import WorldState
from raytac.world.world import TactileWorld

__all__ = ["WorldSession"]

_SHOWN_GROUPS = 3
"""Geoms of MuJoCo's first groups are shown, as its own viewer does."""
_PLANE = 1.5
"""A half-space is drawn as a square of this size [m]."""
_ROUND = 1.5e-3
"""How far facets lie inside a curved geom, over its size."""
_SOFT_COLOUR = (200, 190, 120)
_NEAREST, _FARTHEST = 0.12, 0.6
"""Least and greatest distance of the eye from the sensors [m], over 2.5."""


class WorldSession:
    """One environment of a world (see ``Session``).

    A state that is shown is ``steps`` control steps after the last one: images cost more than steps.
    """

    units_per_metre = 10.0
    is_driven_at_rest = False

    def __init__(self, world: TactileWorld, *, steps: int = 1) -> None:
        """Take the world as it is at its start.

        Args:
            world: with ``num_envs = 1``.
            steps: control steps from one shown state to the next. Markers that follow a contact's history (``fots``) see only
                the states that are shown.
        """
        self._world, self._steps = world, steps
        self._steering = Steering(world)
        self._state: WorldState = world.reset()
        self._sensors = world.sensors
        self._grids = {name: strided(sensor.grid) for name, sensor in self._sensors.items()}
        label = next(iter(self._sensors.values())).label
        self.title = f"{world.scene.name} · {world.scene.robot.model.rsplit('/', 1)[-1]} · {label}"
        self.controls: tuple[Control, ...] = self._steering.controls
        self.pads = tuple(
            Pad(name, grid_faces(self._grids[name]), ("indentation", *(("pressure", "shear") if "traction" in s.outputs else ())))
            for name, s in self._sensors.items()
        )
        self._body_of: dict[str, int] = {}
        """Body of the model that carries a solid, by the solid's name."""
        self._soft = [body.name for body in world.scene.bodies if body.dynamics == "soft"]
        self.solids = (*self._geoms(), *self._gels(), *self._soft_bodies())
        self.camera = self._camera()
        # Their number of segments is known with the first frame, which computes images.
        simulated = self._sensors if world.physics.is_simulated else ()
        self.lines = tuple(Lines(f"{name}_coat_mesh", np.zeros((1, 2, 3)), MESH_COLOUR, MESH_WIDTH) for name in simulated)
        self._physics_ms = 0.0
        self._shot: Snapshot | None = None

    # --- what a player asks ----------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        self._state = self._world.reset()
        self._steering.reset()
        self._shot = None

    def resume(self) -> None:
        """Time has no end: nothing to do."""

    def drive(self, targets: Mapping[str, float]) -> None:
        check_targets(self.controls, targets)
        self._steering.aim(targets)

    def advance(self) -> bool:
        began = time.perf_counter()
        for _ in range(self._steps):
            self._steering.go()
            self._state = self._world.step(self._steering)
            if self._state.failed[0]:
                raise RaytacError(f"the physics broke down {self._state.time[0]:.3f} s after the start; reset, and go slower")
        self._physics_ms = 1e3 * (time.perf_counter() - began)
        self._shot = None
        return True

    def snapshot(self) -> Snapshot:
        if self._shot is None:
            self._shot = self._drawn(self._world.observe())
        return self._shot

    # --- drawing ---------------------------------------------------------------------------------------------------------------

    def _geoms(self) -> Iterator[Solid]:
        model = self._world.model
        gels = {int(model.geom(mounted.gel).id) for mounted in self._world.composed.sensors}
        objects = {body.index for body in self._world.composed.bodies.values()}
        for geom in range(model.ngeom):
            red, green, blue, alpha = (float(v) for v in model.geom_rgba[geom])
            if geom in gels or int(model.geom_group[geom]) >= _SHOWN_GROUPS or alpha == 0.0:
                continue
            body = int(model.geom_bodyid[geom])
            part = geom_part(model, geom)
            if part.kind == "plane":
                corners = 0.5 * _PLANE * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
                vertices, faces = corners, np.array([[0, 1, 2], [0, 2, 3]])
            else:
                surface = part_surface(part, _ROUND * max(part.size, default=0.05))
                vertices, faces = surface.vertices, surface.faces
            pose = part.object_from_part
            name = f"{model.body(body).name or 'world'}/{geom}"
            self._body_of[name] = body
            colour: Colour = (round(255 * red), round(255 * green), round(255 * blue))
            hides = body in objects and part.kind != "plane"
            yield Solid(name, vertices @ pose[:3, :3].T + pose[:3, 3], faces, colour, alpha, hides)

    def _gels(self) -> Iterator[Solid]:
        for name, sensor in self._sensors.items():
            yield gel_solid(sensor.spec, f"{name}_gel")

    def _soft_bodies(self) -> Iterator[Solid]:
        specs = {body.name: body for body in self._world.scene.bodies}
        for name in self._soft:
            vertices, faces = self._world.mesh(name)
            colour = specs[name].colour
            shown = _SOFT_COLOUR if colour is None else tuple(round(255 * v) for v in colour)
            yield Solid(f"soft/{name}", vertices[0], faces, shown, hides_pads=True)  # type: ignore[arg-type]

    def _camera(self) -> CameraPlace:
        pads = np.array([self._state.world_from_pad[name][0, :3, 3] for name in self._sensors])
        middle = pads.mean(axis=0)
        size = float(np.clip(np.linalg.norm(self._world.data[0].xpos - middle, axis=1).max(), _NEAREST, _FARTHEST))
        x, y, z = middle.tolist()
        return CameraPlace((x + 1.5 * size, y - 2.1 * size, z + 1.1 * size), (x - 0.25 * size, y, z + 0.35 * size))

    def _drawn(self, frames: Mapping[str, TactileFrame]) -> Snapshot:
        data, state = self._world.data[0], self._state
        bodies = {}
        for body in set(self._body_of.values()):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            bodies[body] = pose
        poses = {name: bodies[body] for name, body in self._body_of.items()}
        reshaped = {f"soft/{name}": self._world.mesh(name)[0][0] for name in self._soft}
        time_ms = {"physics": self._physics_ms}
        for name, frame in frames.items():
            poses[f"{name}_gel"] = poses[f"{name}_coat_mesh"] = state.world_from_pad[name][0]
            if frame.surface.coat is not None:
                reshaped[f"{name}_coat_mesh"] = coat_edges(
                    frame.surface.coat.mesh, frame.surface.coat.positions[0], frame.surface, self._grids[name]
                )
            for part, value in frame.time_ms.items():
                time_ms[part] = time_ms.get(part, 0.0) + value
        return Snapshot(
            pads={name: pad_view(f, self._grids[name], state.world_from_pad[name][0]) for name, f in frames.items()},
            poses=poses,
            reshaped=reshaped,
            controls=self._steering.asked,
            facts=self._facts(),
            warning=self._steering.missing or next(filter(None, map(narrow_warning, frames.values())), ""),
            time_ms=time_ms,
        )

    def _facts(self) -> dict[str, str]:
        state = self._state
        facts = {"time": f"{float(state.time[0]):.3f} s"}
        for name in self._sensors:
            force = state.wrench[name][0, :3]
            facts[f"{name}, force"] = f"{float(np.linalg.norm(force)):.3f} N"
        for name, label, factor, unit in (("min_gap", "least gap", 1e6, "µm"), ("min_det", "least det F", 1.0, "")):
            if name in state.report and np.isfinite(state.report[name][0]):
                facts[label] = f"{factor * float(state.report[name][0]):.3g} {unit}".strip()
        return facts
