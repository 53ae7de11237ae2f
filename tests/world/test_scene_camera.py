"""Pictures of a world: the lamp's shadow is dark and lies where the light says, and the floor around it is clean."""

from __future__ import annotations

from tests.opengl import run_drawing

_SCRIPT = """
from raytac import TactileWorld, mount
from raytac.world import SceneCamera

spec = mujoco.MjSpec.from_string('''<mujoco><option cone="elliptic"/><worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="post" pos="0 0 0.05"><freejoint/><geom type="box" size="0.01 0.01 0.05" mass="0.1"/></body>
    <body pos="0 1 0.5"><site name="tip"/></body>
</worldbody></mujoco>''')
mount(spec, "gelsight_mini", site="tip", name="pad")
world = TactileWorld(spec, touches=["post"])
width, height, distance, elevation, lookat = 320, 240, 0.4, np.radians(-35.0), np.array([0.0, 0.0, 0.03])
for degrees in (120.0, 30.0, -70.0):
    azimuth = np.radians(degrees)
    camera = SceneCamera(world, azimuth=degrees, elevation=-35.0, distance=distance, lookat=lookat)
    picture = camera.draw().mean(axis=2)
    lamp = camera._renderer.scene.lights[camera._renderer.scene.nlight - 1]
    light = np.array(lamp.dir, float)
    camera.close()
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    right = np.array([flat[1], -flat[0], 0.0])
    assert light @ right > 0.2 and light @ flat > 0.2 and light[2] < -0.5, ("over the left shoulder", degrees, light)
    forward = np.cos(elevation) * flat + np.array([0.0, 0.0, np.sin(elevation)])
    up = np.cross(right, forward)
    focal = 0.5 * height / np.tan(0.5 * np.radians(world.model.vis.global_.fovy))

    def around(point):
        away = point - (lookat - distance * forward)
        u, v = (focal * (away @ axis) / (away @ forward) for axis in (right, -up))
        row, column = round(0.5 * height + v - 0.5), round(0.5 * width + u - 0.5)
        return picture[row - 2 : row + 3, column - 2 : column + 3]

    floor = np.median(picture)
    for high in (0.06, 0.075, 0.09):  # points of the post's axis [m], and where their shadow falls on the floor
        fallen = high * light[:2] / -light[2]
        shadow, opposite = (np.median(around(np.array([*(sign * fallen), 0.0]))) for sign in (1.0, -1.0))
        assert shadow < 0.7 * floor, ("in the shadow", degrees, high, shadow, floor)
        assert opposite > 0.95 * floor, ("towards the lamp", degrees, high, opposite, floor)
    tip = 0.1 * light[:2] / -light[2]
    beyond = np.median(around(np.array([*(1.4 * tip), 0.0])))
    assert beyond > 0.95 * floor, ("beyond the shadow", degrees, beyond, floor)
    columns = np.arange(width) - 0.5 * width
    beside = picture[:, (columns < -20) | (columns > 45)]
    assert beside.min() > 0.75 * floor, ("lines of the floor are light", degrees, beside.min(), floor)
"""


def test_a_shadow_is_darker_than_the_floor_and_falls_away_from_the_lamp() -> None:
    run_drawing(_SCRIPT)
