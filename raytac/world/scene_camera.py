"""Pictures of a world by MuJoCo's renderer, of robot and bodies, not of a sensor."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from copy import copy

import mujoco
import numpy as np

from raytac.errors import BackendError, InputError
from raytac.robots.looks import Looks, robot_looks
from raytac.se3 import pose, pose_of
from raytac.world.world import TactileWorld

_SHARP = 2
"""Samples of a pixel along each side."""
_SHADOWS = 2048
"""Texels along a side of the map of shadows; a CPU still draws it quickly."""
_SKY = np.array((238.0, 241.0, 245.0), np.float32)
"""Colour of the background: one, since a GIF has few."""
_FLOOR, _LINES = (0.83, 0.84, 0.85, 1.0), (0.70, 0.71, 0.73, 1.0)
_TILE, _REACH = 0.1, 1.2
"""Spacing of a floor's lines, and their reach from the centre [m]."""
_LINE, _LIFT = 0.8e-3, 0.2e-3
"""Half the width of these lines, and their height over the floor [m]."""
_TO_LAMP = np.array([-0.35, 0.45, 1.0])
"""Direction to the lamp; its components are to the right of the picture, to the eye, and up."""
_LAMP = 1.6
"""Distance of the lamp from the centre of the picture [m]."""
_BALL = 4e-3
"""Radius of the balls that mark points [m]."""
_GREEN = np.array([0.1, 0.7, 0.2, 0.8], np.float32)


class SceneCamera:
    """Camera at a fixed pose in every environment of a world.

    A scene without lamps of its own gets one that casts shadows, and its floor a grid of 0.1 m; neither is in the model. Our Panda is
    drawn by its visual meshes where a package with them is installed (docs/guide/robots.md), else by its collision shapes. It needs
    OpenGL without a display: MuJoCo reads the environment variable ``MUJOCO_GL`` (``egl`` or ``osmesa``) when it is imported.
    Soft pads are not drawn, since MuJoCo does not have their gel.

    Attributes:
        model: copy of the world's model whose colours and lights are drawn.
    """

    def __init__(
        self,
        world: TactileWorld,
        *,
        resolution: tuple[int, int] = (320, 240),
        distance: float = 0.75,
        azimuth: float = 120.0,
        elevation: float = -15.0,
        lookat: np.ndarray | None = None,
    ) -> None:
        """Open the renderer.

        Args:
            world: world to draw.
            resolution: (width, height) [px], at most 640 x 480.
            distance: from the camera to ``lookat`` [m].
            azimuth, elevation: direction of the view [°].
            lookat: point (3,) in the centre of the picture [m]; None is the mean position of the pads.

        Raises:
            InputError: a resolution out of range.
            BackendError: there is no OpenGL here.
        """
        width, height = resolution
        largest = world.model.vis.global_.offwidth, world.model.vis.global_.offheight
        if not (1 <= width <= largest[0] and 1 <= height <= largest[1]):
            raise InputError("resolution", value=resolution, rule=f"must be from 1x1 to {largest[0]}x{largest[1]} pixels")
        self.world, self.resolution = world, (width, height)
        self.model = copy(world.model)
        self._has_lamp = world.model.nlight > 0
        light = self.model.vis.headlight
        light.ambient[:], light.diffuse[:], light.specular[:] = (0.35, 0.6, 0.1) if self._has_lamp else (0.45, 0.25, 0.0)
        self._drawn, self._looks = _with_meshes(world)
        self.model.geom_rgba[list(self._looks.hidden), 3] = 0.0  # MuJoCo leaves such geoms out
        self._drawn.vis.quality.shadowsize = _SHADOWS
        self._drawn.vis.global_.offwidth, self._drawn.vis.global_.offheight = _SHARP * width, _SHARP * height
        try:
            self._renderer = mujoco.Renderer(self._drawn, _SHARP * height, _SHARP * width)
        except Exception as error:
            rule = "set MUJOCO_GL=egl (or osmesa) before Python starts, and install libEGL (or libOSMesa)"
            raise BackendError(f"MuJoCo cannot draw here ({error}): {rule}") from error
        if lookat is None:
            lookat = np.mean([poses[0, :3, 3] for poses in world.state().world_from_pad.values()], axis=0)
        self._camera, self._option = mujoco.MjvCamera(), mujoco.MjvOption()
        self._camera.lookat[:] = lookat
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, elevation

    def draw(self, env: int = 0, points: Sequence[np.ndarray] = ()) -> np.ndarray:
        """8-bit picture (H, W, 3) of an environment; small green balls mark ``points`` (3,) [m].

        Raises ``InputError`` for an environment that does not exist.
        """
        if not 0 <= env < self.world.num_envs:
            raise InputError("env", value=env, rule=f"must be from 0 to {self.world.num_envs - 1}")
        data, every = self.world.data[env], mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self._option, None, self._camera, every, self._renderer.scene)
        self._put_meshes(data)
        for point in points:
            self._add(mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, _BALL), np.asarray(point, float), np.eye(3), _GREEN)
        if not self._has_lamp:
            self._lay_floor()
            self._hang_lamp()
        width, height = self.resolution
        picture = self._renderer.render().astype(np.float32)
        is_empty = (picture == 0.0).all(axis=2, keepdims=True)  # MuJoCo leaves black what no geom covers
        picture = np.where(is_empty, _SKY, picture)
        return np.rint(picture.reshape(height, _SHARP, width, _SHARP, 3).mean(axis=(1, 3))).astype(np.uint8)

    def _add(self, kind: mujoco.mjtGeom, size: np.ndarray, at: np.ndarray, turn: np.ndarray, colour: np.ndarray) -> None:
        """Add a geom at a position [m] and a rotation (3, 3), if MuJoCo has room for it."""
        scene = self._renderer.scene
        if scene.ngeom < scene.maxgeom:
            mujoco.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, at, turn.ravel(), colour)
            scene.ngeom += 1

    def _put_meshes(self, data: mujoco.MjData) -> None:
        """Add the visual meshes, which are the last meshes of the renderer's model."""
        scene, drawn = self._renderer.scene, self._drawn
        for mesh, (body, look) in enumerate(self._looks.meshes, start=drawn.nmesh - len(self._looks.meshes)):
            body_from_mesh = pose_of(drawn.mesh_pos[mesh], drawn.mesh_quat[mesh])  # MuJoCo turns a mesh to its principal axes
            place = pose(data.xmat[body].reshape(3, 3), data.xpos[body]) @ body_from_mesh
            before = scene.ngeom
            kind, colour = mujoco.mjtGeom.mjGEOM_MESH, np.array(look.rgba, np.float32)
            self._add(kind, np.zeros(3), place[:3, 3], place[:3, :3], colour)
            if scene.ngeom > before:
                scene.geoms[before].dataid = 2 * mesh  # the odd numbers are convex hulls

    def _lay_floor(self) -> None:
        """Planes without a texture in a light grey, with a grid around the centre of the picture.

        Lines are planes too: boxes that thin would lie in their own shadow here and there.
        """
        scene, plane = self._renderer.scene, mujoco.mjtGeom.mjGEOM_PLANE
        for geom in [scene.geoms[k] for k in range(scene.ngeom) if scene.geoms[k].type == plane and scene.geoms[k].matid < 0]:
            geom.rgba[:], turn, at = _FLOOR, geom.mat.copy(), geom.pos.copy()
            middle = np.round(turn.T @ (self._camera.lookat - at) / _TILE) * _TILE
            edge = np.where(geom.size[:2] > 0.0, geom.size[:2], np.inf)
            for axis in (0, 1):
                span = np.clip(middle[1 - axis] + np.array([-_REACH, _REACH]), -edge[1 - axis], edge[1 - axis])
                for line in np.arange(-_REACH, _REACH + 0.5 * _TILE, _TILE) + middle[axis]:
                    if abs(line) > edge[axis] or span[1] <= span[0]:
                        continue
                    place, size = np.full(3, _LIFT), np.full(3, _TILE)
                    place[axis], place[1 - axis], size[axis], size[1 - axis] = line, span.mean(), _LINE, 0.5 * np.ptp(span)
                    self._add(plane, size, at + turn @ place, turn, np.array(_LINES, np.float32))

    def _hang_lamp(self) -> None:
        """One lamp over the camera's left shoulder, so that shadows fall to the right and back."""
        scene, azimuth = self._renderer.scene, np.radians(self._camera.azimuth)
        forward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        right, up = np.array([forward[1], -forward[0], 0.0]), np.array([0.0, 0.0, 1.0])
        to_lamp = _TO_LAMP[0] * right - _TO_LAMP[1] * forward + _TO_LAMP[2] * up
        to_lamp /= np.linalg.norm(to_lamp)
        lamp = scene.lights[scene.nlight]
        lamp.pos[:], lamp.dir[:] = self._camera.lookat + _LAMP * to_lamp, -to_lamp
        lamp.type, lamp.headlight, lamp.castshadow = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL), 0, 1
        lamp.attenuation[:] = 1.0, 0.0, 0.0
        lamp.ambient[:], lamp.diffuse[:], lamp.specular[:] = 0.0, 0.5, 0.15
        scene.nlight += 1

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def _with_meshes(world: TactileWorld) -> tuple[mujoco.MjModel, Looks]:
    """Model for a renderer: the world's, with the visual meshes of its robot behind its own."""
    looks, spec = robot_looks(world.model), world.composed.spec
    if spec is None or not looks.meshes:
        return copy(world.model), Looks()
    spec = spec.copy()
    added = [f"looks/{number}" for number in range(len(looks.meshes))]
    for name, (_, mesh) in zip(added, looks.meshes, strict=True):
        mesh.add_to(spec, name)
    own = [world.model.mesh(number).name for number in range(world.model.nmesh)]
    try:
        drawn = spec.compile()
        if [drawn.mesh(number).name for number in range(drawn.nmesh)] == own + added:
            return drawn, looks
        reason = "the model's compiler drops meshes that no geom uses (discardvisual)"
    except ValueError as error:
        reason = " ".join(str(error).split())
    logging.getLogger("raytac").warning("the robot is drawn as its collision shapes: %s", reason)
    return copy(world.model), Looks()
