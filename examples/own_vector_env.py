"""How do I add touch to a Gymnasium vector of my own MuJoCo model? Needs `pip install -e '.[rl]'`.

Run: python examples/own_vector_env.py
"""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np

import raytac
from raytac.observe import AddTactileVector, ObservationSettings, TactileObserver

SETTINGS = ObservationSettings(("rgb", "wrench"), resolution=(32, 32), optics="phong")


class Squeeze(gymnasium.vector.VectorEnv):
    """A gripper closes on a cube; the reward is the force on it, to 5 N."""

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, world: raytac.TactileWorld) -> None:
        self.world, self.num_envs, self.steps = world, world.num_envs, np.zeros(world.num_envs, int)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)

    def _fingers(self) -> np.ndarray:
        return np.array([data.qpos[1:3] for data in self.world.data], np.float32)

    def reset(self, *, seed=None, options=None):
        self.world.reset()
        self.steps[:] = 0
        return self._fingers(), {}

    def step(self, actions):
        closing = -6e-3 * (1.0 + np.repeat(np.asarray(actions), 2, axis=1))  # as much as both servos shall close
        state = self.world.step(np.concatenate([np.zeros((self.num_envs, 1)), closing], axis=1))
        self.steps += 1
        reward = np.minimum(-state.wrench["left"][:, 2], 5.0)
        ended = state.failed | (self.steps >= 20)
        if ended.any():
            self.world.reset(np.flatnonzero(ended))
            self.steps[ended] = 0
        return self._fingers(), np.nan_to_num(reward), np.zeros(self.num_envs, bool), ended, {}


spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("gripper.xml")))
for side in ("left", "right"):
    raytac.mount(spec, "gelsight_mini", site=f"{side}_tip", name=side)
observers = {side: TactileObserver("gelsight_mini", SETTINGS, num_envs=4, seed=i) for i, side in enumerate(("left", "right"))}
world = raytac.TactileWorld(spec, touches=["cube"], control_timestep=0.02, **observers["left"].sensor_options())
envs = AddTactileVector(Squeeze(world), observers, world.observe)
observation, info = envs.reset(seed=0)
for _ in range(10):
    observation, reward, *_ = envs.step(np.array([[-1.0], [0.0], [0.5], [1.0]]))
print({name: values.shape for name, values in observation.items()})
print("force on each cube [N]:", reward.round(2))
