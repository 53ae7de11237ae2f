"""Pictures of a world by MuJoCo's renderer, of robot and bodies, not of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.errors import BackendError, InputError
from raytac.world.world import TactileWorld

_BACKGROUND = 235
_BALL = 4e-3
"""Radius of the balls that mark points [m]."""
_GREEN = np.array([0.1, 0.7, 0.2, 0.8], np.float32)


class SceneCamera:
    """Camera at a fixed pose in every environment of a world.

    Needs OpenGL without a display: MuJoCo reads the environment variable ``MUJOCO_GL`` (``egl`` or ``osmesa``) when it is imported.
    Soft pads are not drawn, since MuJoCo does not have their gel.
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
            world: world to draw. The headlight of its model is made brighter, which only pictures show.
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
        light = world.model.vis.headlight
        light.ambient[:], light.diffuse[:] = 0.35, 0.6
        try:
            self._renderer = mujoco.Renderer(world.model, height, width)
        except Exception as error:
            rule = "set MUJOCO_GL=egl (or osmesa) before Python starts, and install libEGL (or libOSMesa)"
            raise BackendError(f"MuJoCo cannot draw here ({error}): {rule}") from error
        if lookat is None:
            lookat = np.mean([poses[0, :3, 3] for poses in world.state().world_from_pad.values()], axis=0)
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = lookat
        self._camera.distance, self._camera.azimuth, self._camera.elevation = distance, azimuth, elevation

    def draw(self, env: int = 0, points: Sequence[np.ndarray] = ()) -> np.ndarray:
        """8-bit picture (H, W, 3) of an environment; small green balls mark ``points`` (3,) [m].

        Raises ``InputError`` for an environment that does not exist.
        """
        if not 0 <= env < self.world.num_envs:
            raise InputError("env", value=env, rule=f"must be from 0 to {self.world.num_envs - 1}")
        self._renderer.update_scene(self.world.data[env], self._camera)
        scene = self._renderer.scene
        for point in points:
            geom = scene.geoms[scene.ngeom]
            size, turn = np.full(3, _BALL), np.eye(3).ravel()
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, np.asarray(point, float), turn, _GREEN)
            scene.ngeom += 1
        picture = self._renderer.render()
        picture[(picture == 0).all(axis=2)] = _BACKGROUND  # where no geom is: MuJoCo leaves it black
        return picture

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()
