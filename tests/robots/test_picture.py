"""The robots in MuJoCo's own renderer, where a machine can render without a display."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_SCRIPT = """
import sys
import mujoco, numpy as np
from raytac.robots.panda import READY, one_sensor_panda, two_finger_panda
try:
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
except Exception as error:
    print(error)
    sys.exit(77)
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
    """In a process of its own: the GL backend is chosen when MuJoCo is imported."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    environment.setdefault("MUJOCO_GL", "egl")
    done = subprocess.run([sys.executable, "-c", _SCRIPT], env=environment, capture_output=True, text=True, timeout=120)
    if done.returncode == 77 or "EGL" in done.stderr or "OpenGL" in done.stderr:
        pytest.skip(f"no offscreen OpenGL here: {(done.stdout + done.stderr).strip()[-200:]}")
    assert done.returncode == 0, done.stderr
