"""What do the two Pandas look like? Each from afar and its sensors from near, in the scenes ``ball_rolling`` and ``lift_cube``.

MUJOCO_GL=egl python experiments/robot_picture.py --out runs/robot_picture
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import recorded, run
from raytac.io import CommonOptions
from raytac.world import SceneCamera, TactileWorld

SCENES = {"ball_rolling": "one sensor on the flange", "lift_cube": "two sensors as fingers"}
MIDDLE, ABOVE = np.array([0.25, 0.0, 0.36]), np.array([0.0, 0.0, 0.03])
"""What the view from afar looks at, world frame, and how far above the pads the other does [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Draw the robots of two task scenes with MuJoCo's renderer, which needs OpenGL without a display."""

    quick: bool = False
    """Small pictures: enough to see that all works."""


def pictures(quick: bool) -> list[tuple[str, np.ndarray]]:
    """Title and 8-bit picture (H, W, 3) of each view."""
    size = (120, 90) if quick else (480, 360)
    found = []
    for scene, title in SCENES.items():
        world = TactileWorld(scene, outputs=("wrench",))
        pads = np.mean([poses[0, :3, 3] for poses in world.state().world_from_pad.values()], axis=0)
        far = SceneCamera(world, resolution=size, distance=1.1, azimuth=225.0, elevation=-15.0, lookat=MIDDLE)
        near = SceneCamera(world, resolution=size, distance=0.27, azimuth=205.0, elevation=-12.0, lookat=pads + ABOVE)
        for camera, where in ((far, ""), (near, ", from near")):
            found.append((title + where, camera.draw()))
            camera.close()
    return found


def draw(views: list[tuple[str, np.ndarray]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.0 * len(views), 2.5), layout="constrained")
    for axes, (title, picture) in zip(figure.subplots(1, len(views)), views, strict=True):
        axes.imshow(picture)
        axes.set_title(title, fontsize="medium")
        axes.set_axis_off()
    figure.savefig(path, dpi=100)


def main(args: Args) -> None:
    with recorded(args, "robot_picture") as (folder, _):
        draw(pictures(args.quick), folder / "robots.png")


if __name__ == "__main__":
    run(main, Args)
