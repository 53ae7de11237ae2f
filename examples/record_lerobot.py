"""How do I record episodes of a task with touch, for a learner that reads LeRobot's data sets?

Run: python examples/record_lerobot.py (needs pip install 'raytac[rl,dataset]')

Any Gymnasium environment will do, as one with ``AddTactile`` around it, and any policy: a function of the observation.
"""

import gymnasium

from raytac.dataset import record_episode, write_lerobot
from raytac.envs import SCRIPTED
from raytac.observe import ObservationSettings

touch = ObservationSettings(("rgb", "wrench"), resolution=(64, 64), optics="phong")
env = gymnasium.make("raytac.envs:raytac/PushCube-v0", tactile=touch)
batch = env.get_wrapper_attr("batch")


def policy(observation):
    """The policy that comes with the task; it looks at the state of the world, yours at the observation."""
    return SCRIPTED["PushCube"](batch)[0]


def episodes():
    for seed in range(2):
        yield record_episode(env, policy, seed=seed, task="push the cube to the goal", max_steps=40)


folder = write_lerobot("push_cube_lerobot", episodes(), names={"state": "observation.state"})
print("wrote", sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*")))
print("with LeRobot: LeRobotDataset('me/push_cube', root=%r)" % str(folder))
