"""How do I add touch to an environment like robosuite's: dictionaries, four or five values a step, MuJoCo behind ``env.sim``?

Run: python examples/foreign_robosuite.py (needs pip install 'raytac[envs]')

``Lift`` has the shape of a robosuite environment and knows neither Gymnasium nor raytac; ``AsGymnasium`` is all that it needs.
"""

from pathlib import Path
from types import SimpleNamespace as Namespace

import gymnasium
import mujoco
import numpy as np

import raytac
from raytac.observe import AddTactile, ObservationSettings, TactileObserver


class Lift:
    def __init__(self, model: mujoco.MjModel) -> None:
        self.sim = Namespace(model=Namespace(_model=model), data=Namespace(_data=mujoco.MjData(model)))

    def reset(self) -> dict:
        mujoco.mj_resetData(self.sim.model._model, self.sim.data._data)
        return {"robot0_joint_pos": self.sim.data._data.qpos[:3].copy()}

    def step(self, action: np.ndarray) -> tuple:
        self.sim.data._data.ctrl[:] = action * [0.05, 0.012, 0.012]
        mujoco.mj_step(self.sim.model._model, self.sim.data._data, 10)
        return {"robot0_joint_pos": self.sim.data._data.qpos[:3].copy()}, 0.0, self.sim.data._data.time >= 1.2, {}


class AsGymnasium(gymnasium.Env):
    def __init__(self, inner, actions: int) -> None:
        self.inner, self.action_space = inner, gymnasium.spaces.Box(-1.0, 1.0, (actions,))
        seen = [(name, gymnasium.spaces.Box(-np.inf, np.inf, np.shape(v), np.float64)) for name, v in inner.reset().items()]
        self.observation_space = gymnasium.spaces.Dict(seen)

    def reset(self, *, seed=None, options=None):
        return dict(self.inner.reset()), {}

    def step(self, action):
        observation, reward, *ends, info = self.inner.step(action)
        terminated, truncated = ends if len(ends) == 2 else (False, ends[0])  # robosuite's done is the end of its horizon
        return dict(observation), float(reward), bool(terminated), bool(truncated), info


spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("gripper.xml")))
for side in ("left", "right"):
    raytac.mount(spec, "gelsight_mini", site=f"{side}_tip", name=side, collide=True)
inner = Lift(spec.compile())
settings = ObservationSettings(("rgb", "wrench"), resolution=(32, 32), optics="phong")
observers = {side: TactileObserver("gelsight_mini", settings) for side in ("left", "right")}
reader = raytac.TactileReader(inner.sim.model._model, touches=["cube"], **observers["left"].sensor_options())
env = AddTactile(AsGymnasium(inner, 3), observers, lambda: reader.read(inner.sim.data._data))

observation, truncated = env.reset(seed=0)[0], False
while not truncated:
    observation, _, _, truncated, _ = env.step(-min(inner.sim.data._data.time / 0.4, 1.0) * np.array([0.0, 1.0, 1.0]))
print(sorted(observation), "left: pad pressed by %.2f N" % -reader.read(inner.sim.data._data)["left"].force[0, 2])
