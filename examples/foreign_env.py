"""How do I add touch to an environment that steps MuJoCo itself, such as a ``MujocoEnv`` of Gymnasium?

Run: python examples/foreign_env.py (needs pip install 'raytac[envs]')

``Close`` knows nothing of raytac: it gets a model file with sensors in it, and what they feel is read from its states. Other libraries
have the model and its state too: dm_control as ``physics.model.ptr`` and ``physics.data.ptr``.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

import raytac
from raytac.observe import AddTactile, ObservationSettings, TactileObserver


class Close(MujocoEnv):
    """A gripper whose action is how far its servos shall close."""

    def __init__(self, path: str) -> None:
        self.metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 50}
        super().__init__(path, 10, gymnasium.spaces.Box(-np.inf, np.inf, (2,)))

    def reset_model(self):
        self.set_state(self.init_qpos, self.init_qvel)
        return self.data.qpos[1:3].copy()

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.data.qpos[1:3].copy(), 0.0, False, False, {}


spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("gripper.xml")))
for side in ("left", "right"):
    raytac.mount(spec, "gelsight_mini", site=f"{side}_tip", name=side, collide=True)
spec.compile()
with TemporaryDirectory() as folder:
    path = Path(folder) / "gripper_with_touch.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    inner = Close(str(path))

settings = ObservationSettings(("rgb", "wrench"), resolution=(32, 32), optics="phong")
observers = {side: TactileObserver("gelsight_mini", settings, seed=i) for i, side in enumerate(("left", "right"))}
reader = raytac.TactileReader(inner.model, touches=["cube"], **observers["left"].sensor_options())
env = AddTactile(inner, observers, lambda: reader.read(inner.data))

env.reset(seed=0)
for step in range(80):
    closed = -0.012 * min(step / 20, 1.0)
    observation, *_ = env.step(np.array([0.0, closed, closed]))
print({name: values.shape for name, values in observation.items()})
for side, servo in zip(("left", "right"), inner.data.actuator_force[1:3], strict=True):
    print("%s: pad pressed by %.2f N, servo by %.2f N" % (side, -reader.read(inner.data)[side].force[0, 2], -servo))
