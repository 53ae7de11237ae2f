"""A model of the shape that users have: six axes with meshes, position servos, a parallel gripper, and free objects on a table."""

from __future__ import annotations

import mujoco
import numpy as np

from raytac.robots.mount import MountedSensor, mount
from raytac.se3 import pose

__all__ = ["arm6", "with_sensors"]

_LINK = "-.03 -.03 0  .03 -.03 0  .03 .03 0  -.03 .03 0  -.02 -.02 .28  .02 -.02 .28  .02 .02 .28  -.02 .02 .28"
"""A tapered link, of which MuJoCo makes the hull."""
_ANGLE = np.array([[-20, 0], [20, 0], [20, 10], [-8, 10], [-8, 30], [-20, 30]]) * 1e-3
"""Section of a bracket along x and z [m], counter-clockwise: an L."""


def _bracket() -> tuple[str, str]:
    """Vertices and faces of the L, 20 mm wide: 0 is the reflex corner's column, from which both ends are fanned."""
    ends = [np.insert(_ANGLE, 1, y, axis=1) for y in (-0.01, 0.01)]
    n, corner = len(_ANGLE), 3
    fan = [(corner, (corner + k) % n, (corner + k + 1) % n) for k in range(1, n - 1)]
    faces = [*fan, *((a + n, c + n, b + n) for a, b, c in fan)]
    for k in range(n):
        after = (k + 1) % n
        faces += [(k, k + n, after), (after, k + n, after + n)]
    text = [" ".join(f"{v:g}" for v in np.ravel(values)) for values in (np.concatenate(ends), faces)]
    return text[0], text[1]


def arm6(objects: str | None = None) -> mujoco.MjSpec:
    """The arm, hand down over a table, with a cube between its fingers and a bracket beside; ``objects`` in place of both."""
    vertices, faces = _bracket()
    if objects is None:
        objects = """
        <body name="cube" pos=".3 0 .262"><freejoint/><geom name="cube" type="box" size=".012 .012 .012" mass=".05" friction="1"/></body>
        <body name="bracket" pos=".42 .12 .2501"><freejoint/><geom name="bracket_hull" type="mesh" mesh="bracket" mass=".06"/>
        <geom name="bracket_shown" type="mesh" mesh="bracket" contype="0" conaffinity="0" group="2" mass="0"/></body>
        """
    servo = 'kp="2000" dampratio="1"'
    return mujoco.MjSpec.from_string(
        f"""
        <mujoco model="arm6"><option timestep="0.002" cone="elliptic" integrator="implicitfast"/>
        <default><geom friction="0.8"/><joint armature=".1" damping="2"/></default>
        <asset><mesh name="link" vertex="{_LINK}"/><mesh name="bracket" vertex="{vertices}" face="{faces}"/>
        <mesh name="open" vertex="{vertices}" face="{" ".join(faces.split()[:-3])}" inertia="shell"/></asset>
        <worldbody><geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.01"/>
        <geom name="table" type="box" size=".2 .2 .125" pos=".4 0 .125"/>
        <body name="link1" pos="0 0 .15" gravcomp="1"><joint name="j1" axis="0 0 1"/><geom type="cylinder" size=".04 .04" mass="2"/>
        <body name="link2" gravcomp="1"><joint name="j2" axis="0 1 0"/><geom type="mesh" mesh="link" mass="2"/>
        <body name="link3" pos="0 0 .3" gravcomp="1"><joint name="j3" axis="0 1 0"/>
        <geom type="mesh" mesh="link" mass="1" euler="0 90 0"/>
        <body name="link4" pos=".3 0 0" gravcomp="1"><joint name="j4" axis="1 0 0"/><geom type="sphere" size=".03" mass=".5"/>
        <body name="link5" gravcomp="1"><joint name="j5" axis="0 1 0"/>
        <geom type="cylinder" size=".02 .03" pos="0 0 -.04" mass=".4"/>
        <body name="link6" pos="0 0 -.08" gravcomp="1"><joint name="j6" axis="0 0 1"/>
        <geom name="palm" type="box" size=".02 .07 .01" mass=".3"/><site name="tool" pos="0 0 -.1"/>
        <body name="left_finger" pos="0 .05 -.1" gravcomp="1"><joint name="left" type="slide" axis="0 1 0" range="-.03 .03"/>
        <geom name="left_bar" type="box" size=".01 .004 .04" pos="0 .005 .05" mass=".03"/><site name="left_tip" zaxis="0 -1 0"/></body>
        <body name="right_finger" pos="0 -.05 -.1" gravcomp="1"><joint name="right" type="slide" axis="0 -1 0" range="-.03 .03"/>
        <geom name="right_bar" type="box" size=".01 .004 .04" pos="0 -.005 .05" mass=".03"/></body>
        </body></body></body></body></body></body>{objects}</worldbody>
        <actuator>{"".join(f'<position name="j{i}" joint="j{i}" {servo}/>' for i in range(1, 7))}
        <position name="left" joint="left" kp="500" dampratio="1"/><position name="right" joint="right" kp="500" dampratio="1"/></actuator>
        </mujoco>
        """
    )


def with_sensors(spec: mujoco.MjSpec, collide: bool = False) -> tuple[MountedSensor, MountedSensor]:
    """Two different sensors on the fingers, pads facing each other, 14 and 20 mm from the middle where the fingers' joints are 0."""
    left = mount(spec, "gelsight_mini_9x11", site="left_tip", name="left", collide=collide)
    facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # pad's z along the finger's y
    right = mount(
        spec, "gelsight_dome", body="right_finger", pose=pose(facing, np.array([0.0, 0.03, 0.0])), name="right", collide=collide
    )
    return left, right
