"""The robots in MuJoCo's own renderer, where a machine can render without a display."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from raytac.io.images import read_png
from tests.opengl import drawing_environment, run_drawing

ROOT = Path(__file__).parents[2]

_SCRIPT = """
from raytac.robots.panda import READY, one_sensor_panda, two_finger_panda
for make in (one_sensor_panda, two_finger_panda):
    robot = make()
    model = robot.spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = READY
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.2, 0.0, 0.45), 1.7, 135.0, -20.0
    with mujoco.Renderer(model, 240, 320) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera)
        geoms = renderer.render()[:, :, 0]
    seen = {model.body(model.geom_bodyid[g]).name for g in np.unique(geoms) if g >= 0}
    wanted = {f"link{i}" for i in range(8)} | {sensor.body for sensor in robot.sensors[:1]}
    assert wanted <= seen, wanted - seen
    assert 0.05 < (geoms >= 0).mean() < 0.6
"""


def test_every_link_and_a_sensor_are_seen():
    run_drawing(_SCRIPT)


def test_the_picture_of_both_robots_is_drawn(tmp_path: Path):
    command = [sys.executable, str(ROOT / "experiments/robot_picture.py"), "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, env=drawing_environment(), capture_output=True, text=True, timeout=120)
    if "MuJoCo cannot draw here" in done.stderr or "OpenGL" in done.stderr:
        pytest.skip(f"no offscreen OpenGL here: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stderr
    picture = read_png(tmp_path / "robots.png").astype(int)
    blue = (picture[..., 2] > picture[..., 0] + 60) & (picture[..., 2] > 100)  # the cube between the fingers, seen from near
    assert 0.002 < blue[:, 3 * picture.shape[1] // 4 :].mean() < 0.2 and not blue[:, : picture.shape[1] // 2].any()
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
