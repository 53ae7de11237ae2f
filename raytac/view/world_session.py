"""A task scene as a session: time runs while it plays, and sliders steer the robot."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np

from raytac.errors import RaytacError
from raytac.frame import TactileFrame
from raytac.physics.geoms import geom_part
from raytac.robots.looks import robot_looks
from raytac.shapes.triangulate import part_surface
from raytac.view.sensor_view import (
    coat_edges,
    coat_lines,
    coat_pad,
    gel_solid,
    narrow_warning,
    pad_view,
    rest_image,
    square,
    strided,
)
from raytac.view.session import CameraPlace, Colour, Control, Snapshot, Solid, check_targets
from raytac.view.steering import Driver, Steering
from raytac.world.world import TactileWorld
from raytac.world.world_state import WorldState

_SHOWN_GROUPS = 3
"""Geoms of MuJoCo's first groups are shown, as its own viewer does."""
_PLANE = 1.5
"""A half-space is drawn as a square of this size [m]."""
_ROUND = 1.5e-3
"""Depth of facets inside a curved geom, over its size."""
_SOFT_COLOUR = (200, 190, 120)
_NEAREST, _FARTHEST = 0.12, 0.6
"""Least and greatest distance of the eye from the sensors [m], over 2.5."""


class WorldSession:
    """One environment of a world, shown every ``steps`` control steps: images cost most."""

    units_per_metre = 10.0
    is_driven_at_rest = False

    def __init__(self, world: TactileWorld, *, steps: int = 1, driver: Driver | None = None, title: str = "") -> None:
        """Take the world as it is at its start.

        Args:
            world: with ``num_envs = 1``.
            steps: control steps from one shown state to the next. Markers that follow a contact's history (``fots``) see only
                the states that are shown.
            driver: moves the world; None is sliders (``Steering``).
            title: line above the page's controls; empty is scene, robot and sensor.
        """
        self._world, self._steps = world, steps
        self._driver: Driver = Steering(world) if driver is None else driver
        self._state: WorldState = self._driver.reset()
        self._sensors = world.sensors
        self._grids = {name: strided(sensor.grid) for name, sensor in self._sensors.items()}
        label = next(iter(self._sensors.values())).label
        scene = world.scene
        self.title = f"{scene.name} · {scene.robot.model.rsplit('/', 1)[-1]} · {label}" if scene is not None else label
        self.title = title or self.title
        self.controls: tuple[Control, ...] = self._driver.controls
        self.handle = self._driver.handle
        self._rest = {name: rest_image(sensor) for name, sensor in self._sensors.items()}
        self.pads = tuple(coat_pad(name, sensor, self._grids[name]) for name, sensor in self._sensors.items())
        self._body_of: dict[str, int] = {}
        """Body of the model that carries a solid, by the solid's name."""
        self._soft = [] if scene is None else [body for body in scene.bodies if body.dynamics == "soft"]
        gels = (gel_solid(sensor.spec, f"{name}_gel") for name, sensor in self._sensors.items())
        self.solids = (*self._geoms(), *gels, *self._soft_bodies())
        self.camera = self._camera()
        self.lines = tuple(coat_lines(f"{name}_coat_mesh") for name in (self._sensors if world.physics.is_simulated else ()))
        self._physics_ms = 0.0
        self._shot: Snapshot | None = None

    def reset(self) -> None:
        self._state = self._driver.reset()
        self._shot = None

    def resume(self) -> None:
        self._driver.resume()

    def drive(self, targets: Mapping[str, float]) -> None:
        check_targets(self.controls, targets)
        self._driver.aim(targets)

    def advance(self) -> bool:
        began = time.perf_counter()
        for _ in range(self._steps):
            state = self._driver.step()
            if state is None:
                return False
            self._state = state
            if self._state.failed[0]:
                raise RaytacError(f"the physics broke down {self._state.time[0]:.3f} s after the start; reset, and go slower")
        self._physics_ms = 1e3 * (time.perf_counter() - began)
        self._shot = None
        return True

    def snapshot(self) -> Snapshot:
        if self._shot is None:
            self._shot = self._drawn(self._world.observe())
        return self._shot

    def _geoms(self) -> Iterator[Solid]:
        model = self._world.model
        looks = robot_looks(model)
        gels = {int(model.geom(mounted.gel).id) for mounted in self._world.composed.sensors}
        objects = {member for body in self._world.composed.bodies.values() for member in body.members}
        for geom in range(model.ngeom):
            red, green, blue, alpha = (float(v) for v in model.geom_rgba[geom])
            if geom in gels or geom in looks.hidden or int(model.geom_group[geom]) >= _SHOWN_GROUPS or alpha == 0.0:
                continue
            body = int(model.geom_bodyid[geom])
            part = geom_part(model, geom)
            if part.kind == "plane":
                vertices, faces = square(_PLANE)
                faces = faces[:2]  # seen from above
            else:
                surface = part_surface(part, _ROUND * max(part.size, default=0.05))
                vertices, faces = surface.vertices, surface.faces
            pose = part.object_from_part
            name = f"{model.body(body).name or 'world'}/{geom}"
            self._body_of[name] = body
            colour: Colour = (round(255 * red), round(255 * green), round(255 * blue))
            hides = body in objects and part.kind != "plane"
            yield Solid(name, vertices @ pose[:3, :3].T + pose[:3, 3], faces, colour, alpha, hides)
        for number, (body, mesh) in enumerate(looks.meshes):
            vertices, faces = mesh.surface()
            name = f"{model.body(body).name}/looks{number}"
            self._body_of[name] = body
            red, green, blue = (round(255 * value) for value in mesh.rgba[:3])
            yield Solid(name, vertices, faces, (red, green, blue), mesh.rgba[3])

    def _soft_bodies(self) -> Iterator[Solid]:
        for body in self._soft:
            vertices, faces = self._world.mesh(body.name)
            shown = _SOFT_COLOUR if body.colour is None else tuple(round(255 * v) for v in body.colour)
            yield Solid(f"soft/{body.name}", vertices[0], faces, shown, hides_pads=True)  # type: ignore[arg-type]

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
        reshaped = {f"soft/{body.name}": self._world.mesh(body.name)[0][0] for body in self._soft}
        pads = {
            name: pad_view(frame, self._grids[name], state.world_from_pad[name][0], rest_rgb=self._rest[name])
            for name, frame in frames.items()
        }
        time_ms = {"physics": self._physics_ms}  # of frames whose images were waited for
        for name, frame in frames.items():
            poses[f"{name}_gel"] = poses[f"{name}_coat_mesh"] = state.world_from_pad[name][0]
            if frame.surface.coat is not None:
                reshaped[f"{name}_coat_mesh"] = coat_edges(frame.surface, self._grids[name])
            for part, value in frame.time_ms.items():
                time_ms[part] = time_ms.get(part, 0.0) + value
        return Snapshot(
            pads=pads,
            poses=poses,
            reshaped=reshaped,
            controls=self._driver.asked,
            facts={**self._facts(), **self._driver.facts},
            time=float(state.time[0]),
            handle=self._driver.place,
            warning=self._driver.missing or next(filter(None, map(narrow_warning, frames.values())), ""),
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
