"""How do I use a task as a Gymnasium environment? Needs `pip install -e '.[rl]'`.

python examples/gym_env.py
"""

import gymnasium

# The part before the colon is the module that Gymnasium imports to find the environment.
env = gymnasium.make("raytac.envs:raytac/PushCube-v0", tactile=("wrench",))
observation, info = env.reset(seed=0)
print("observations:", env.observation_space)
print("actions:", env.action_space)

total = 0.0
for _ in range(5):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    total += float(reward)
print("return after five random actions: %.3f" % total)
env.close()
