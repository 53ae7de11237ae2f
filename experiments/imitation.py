"""Imitation before reinforcement: the policy learns the actions of a scripted one, which knows the state."""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from experiments.ppo_learner import Learner
from raytac.envs import SCRIPTED, TactileVecEnv, TactileVectorEnv

__all__ = ["imitate", "regress"]


def imitate(learner: Learner) -> None:
    """Run a segment of imitation: the policy acts, and learns the actions of the scripted policy, which knows the state.

    Online DAgger (S. Ross, G. Gordon, D. Bagnell, AISTATS 2011) with a teacher that observes more than the pupil. The pupil acts, except in
    a share of environments, falling to 0 over the first third, in which the teacher acts. The loss is the mean
    square of the difference of actions; samples of a segment are kept until its end.
    """
    recipe, model = learner.recipe, learner.model
    assert isinstance(learner.base, TactileVecEnv)
    assert isinstance(learner.base.env, TactileVectorEnv)
    batch, teach, env = learner.base.env.batch, SCRIPTED[recipe.task], model.get_env()
    assert env is not None
    rng = np.random.default_rng((recipe.seed, model.num_timesteps))
    taught = rng.random(env.num_envs) < 1.0 - 3.0 * model.num_timesteps / recipe.imitation_steps
    observation, seen, actions = env.reset(), [], []
    for step in range(recipe.segment * recipe.n_steps):
        target = np.clip(teach(batch), -1.0, 1.0)
        seen.append({name: values.copy() for name, values in observation.items()})  # type: ignore[union-attr]
        actions.append(target)
        action = np.where(taught[:, None], target, learner.predict(observation))  # type: ignore[arg-type]
        observation = env.step(np.clip(action + 0.1 * rng.standard_normal(action.shape), -1.0, 1.0))[0]
        model.num_timesteps += env.num_envs
        if (step + 1) % recipe.n_steps == 0:
            regress(
                learner, {name: np.concatenate([row[name] for row in seen]) for name in seen[0]}, np.concatenate(actions), rng
            )


def regress(learner: Learner, seen: Mapping[str, np.ndarray], actions: np.ndarray, rng: np.random.Generator) -> None:
    """Take steps of Adam on minibatches of the observations ``seen`` and the teacher's ``actions``."""
    recipe, policy = learner.recipe, learner.model.policy
    policy.set_training_mode(True)
    for group in policy.optimizer.param_groups:
        group["lr"] = recipe.learning_rate
    for _ in range(recipe.n_epochs * recipe.n_steps * recipe.num_envs // recipe.batch_size):
        rows = rng.integers(len(actions), size=recipe.batch_size)
        given = {name: torch.as_tensor(values[rows], device=policy.device) for name, values in seen.items()}
        mean = policy.get_distribution(given).mode()  # of a Gaussian
        loss = torch.nn.functional.mse_loss(mean, torch.as_tensor(actions[rows], dtype=torch.float32, device=policy.device))
        policy.optimizer.zero_grad()
        loss.backward()
        policy.optimizer.step()
