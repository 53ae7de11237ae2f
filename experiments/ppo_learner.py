"""Recipes, networks, environments with their normaliser, checkpoints and evaluation of a training by PPO."""

# pyright: reportMissingImports=false
# (stable-baselines3 and PyTorch belong to the extra "rl", which the tests do without.)

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

from raytac.checks import check_known, check_number, check_numbers, check_seed, check_whole
from raytac.envs import ProcessVectorEnv, TactileVecEnv, TactileVectorEnv
from raytac.errors import InputError
from raytac.io import write_atomic
from raytac.learn import KINDS, Evaluation, Outcome, evaluate, shown_beside
from raytac.observe import ObservationSettings
from raytac.physics import PHYSICS

__all__ = [
    "SMALLEST_SIDE",
    "Checkpoint",
    "CheckpointPlayer",
    "Learner",
    "LearnerEpisodes",
    "Recipe",
    "evaluate_learner",
    "tactile_settings",
]

SMALLEST_SIDE = 36
"""Smallest side of an image [px] for DQN's convolutions (``NatureCNN``, which ``MultiInputPolicy`` uses too)."""
_SMALL = 64
"""Greatest size of observations that go into the network unchanged."""


@dataclass(frozen=True)
class Recipe:
    """Settings of a training, with the names of stable-baselines3; a checkpoint holds them."""

    task: str
    tactile: str
    """``task``: as the environment has it; ``none``; or modalities joined by ``+``."""
    seed: int
    total_timesteps: int
    """Environment steps of the whole training; the learning rate falls to a tenth over them."""
    resolution: str = "48x36"
    """WIDTHxHEIGHT of images [px], where ``rgb`` is felt; by default the smallest of 4:3, the shape of the sensors' view."""
    num_envs: int = 16
    processes: int = 1
    history: int = 1
    """Last observations that the policy is given."""
    n_steps: int = 64
    """Steps of each environment between two updates."""
    segment: int = 20
    """Rollouts between two checkpoints."""
    n_epochs: int = 10
    batch_size: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.98
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    log_std_init: float = -0.5
    """Logarithm of the initial standard deviation of an action."""
    ent_coef: float = 0.0
    hidden: int = 64
    imitation_steps: int = 0
    """Environment steps at the beginning that imitate the scripted policy, which knows the state; 0 is PPO alone."""
    device: str = "cpu"
    """Of the network and of the sensors."""
    physics: str = "rigid"
    """Pads that it is trained on: ``rigid`` or ``ipc``."""

    def __post_init__(self) -> None:
        check_seed("seed", self.seed)
        for name in ("total_timesteps", "num_envs", "processes", "n_steps", "segment", "n_epochs", "batch_size"):
            check_whole(name, getattr(self, name))
        check_whole("imitation_steps", self.imitation_steps, 0)
        check_whole("history", self.history, 1, 1000)
        check_whole("hidden", self.hidden, 1, 65536)
        ranges = {"learning_rate": "(0, inf)", "gamma": "[0, 1]", "gae_lambda": "[0, 1]", "clip_range": "(0, inf)"}
        for name, interval in (ranges | {"log_std_init": "(-inf, inf)", "ent_coef": "[0, inf)"}).items():
            check_number(name, getattr(self, name), interval)
        check_known("physics", self.physics, PHYSICS.names)
        for name in ("task", "tactile", "device"):
            if not isinstance(getattr(self, name), str):
                raise InputError(name, value=getattr(self, name), rule="must be a name")


def tactile_settings(name: str, resolution: str) -> ObservationSettings | str | None:
    """What ``TaskBatch`` takes for a name such as ``none``, ``markers`` or ``rgb+wrench``, images of WIDTHxHEIGHT ``resolution``.

    Raises:
        InputError: an unknown modality, or images that are too small for the network.
    """
    if name == "none":
        return None
    if name == "task":
        return "task"
    if "rgb" not in name.split("+"):
        return ObservationSettings(tuple(name.split("+")))
    settings = ObservationSettings(tuple(name.split("+")), resolution=resolution)
    assert isinstance(settings.resolution, tuple)
    _check_image(*settings.resolution)
    return settings


def _check_image(width: int, height: int) -> None:
    if min(width, height) < SMALLEST_SIDE:
        rule = f"is too small an image for the policy's network, which takes {SMALLEST_SIDE}x{SMALLEST_SIDE} pixels or more"
        raise InputError("resolution", value=f"{width}x{height}", rule=rule)


class KeyedExtractor(BaseFeaturesExtractor):
    """Features of a dictionary: few numbers as they are, many through one layer to 32, images through DQN's convolutions to 64.

    Without it a thousand numbers of markers would drown the dozen of the arm in the first layer.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        ways: dict[str, torch.nn.Module] = {}
        size = 0
        for name, space in observation_space.spaces.items():
            assert isinstance(space, spaces.Box)
            count = int(np.prod(space.shape))
            if space.dtype == np.uint8:
                ways[name], n = NatureCNN(space, 64), 64
            elif count <= _SMALL:
                ways[name], n = torch.nn.Flatten(), count
            else:
                ways[name], n = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(count, 32), torch.nn.Tanh()), 32
            size += n
        super().__init__(observation_space, size)
        self.ways = torch.nn.ModuleDict(ways)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        return torch.cat([way(observations[name]) for name, way in self.ways.items()], dim=1)


class _Without(VecEnvWrapper):
    """Takes modalities away from what is observed."""

    def __init__(self, venv: VecEnv, hidden: Sequence[str]) -> None:
        assert isinstance(venv.observation_space, spaces.Dict)
        self._kept = [name for name in venv.observation_space.spaces if not name.endswith(tuple(f"_{m}" for m in hidden))]
        super().__init__(venv, spaces.Dict({name: venv.observation_space[name] for name in self._kept}))

    def reset(self) -> dict[str, np.ndarray]:
        return self._cut(self.venv.reset())

    def step_wait(self) -> Any:
        observation, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = self._cut(info["terminal_observation"])
        return self._cut(observation), reward, done, infos

    def _cut(self, observation: Any) -> dict[str, np.ndarray]:
        return {name: observation[name] for name in self._kept}


@dataclass(frozen=True)
class Checkpoint:
    """A recipe, how far it is, and every number that training changes. On disk: tensors, numbers and names, no code."""

    recipe: Recipe
    steps: int
    policy: dict[str, Any]
    optimizer: dict[str, Any]
    normaliser: dict[str, Any]

    def save(self, path: Path, *, resumable: bool = True) -> None:
        """Write it; never half. Without the optimiser's state (``resumable=False``) it is a third as large and good for playing."""
        values = {
            "recipe": asdict(self.recipe),
            "steps": self.steps,
            "policy": self.policy,
            "optimizer": self.optimizer if resumable else {},
            "normaliser": self.normaliser,
        }
        stream = io.BytesIO()
        torch.save(values, stream)
        write_atomic(path, stream.getvalue())

    @classmethod
    def load(cls, path: Path) -> Checkpoint:
        """Raises ``InputError`` for a file that is none."""
        try:
            values = torch.load(path, map_location="cpu", weights_only=True)
            recipe, saved = Recipe(**values["recipe"]), {name: values[name] for name in ("policy", "optimizer", "normaliser")}
            for name, value in saved.items():
                if not isinstance(value, dict):
                    raise InputError(name, value=type(value).__name__, rule="must be a dictionary")
            for name, tensor in saved["policy"].items():
                if not isinstance(tensor, torch.Tensor) or not torch.isfinite(tensor).all():
                    raise InputError(f"policy[{name!r}]", value=type(tensor).__name__, rule="must be a tensor of finite numbers")
            return cls(recipe, check_whole("steps", values["steps"], 0), **saved)
        except FileNotFoundError as error:
            raise InputError("checkpoint", value=path, rule="must be a file that exists") from error
        except Exception as error:
            rule = f"must be a checkpoint of train_ppo ({error})"
            raise InputError("checkpoint", value=path, rule=rule) from error


class Learner:
    """Environments, their normaliser and PPO's networks, by a recipe."""

    def __init__(self, recipe: Recipe, *, hidden: Sequence[str] = (), **overrides: Any) -> None:
        """Make all.

        Args:
            recipe: what is trained.
            hidden: modalities that ``overrides`` make the environments observe for a picture, but that the policy is not given.
            overrides: options of ``TactileVectorEnv`` in place of those of the recipe.

        Raises:
            InputError: an unknown task or modality, images that are too small, or several processes while a scripted policy teaches.
        """
        if recipe.task not in KINDS:
            raise InputError("task", value=recipe.task, rule="must be a known task", choices=tuple(KINDS))
        if recipe.imitation_steps and recipe.processes > 1:
            rule = "must be 1 while a scripted policy teaches: it sees the state, which other processes keep"
            raise InputError("processes", value=recipe.processes, rule=rule)
        self.recipe = recipe
        tactile = tactile_settings(recipe.tactile, recipe.resolution)
        options: dict[str, Any] = {"tactile": tactile, "device": recipe.device, "physics": recipe.physics, **overrides}
        kind, count = KINDS[recipe.task], recipe.num_envs
        if recipe.processes > 1:
            self.base = TactileVecEnv(ProcessVectorEnv(kind, count, processes=recipe.processes, seed=recipe.seed, **options))
        else:
            self.base = TactileVecEnv(kind(count, seed=recipe.seed, **options))
        seen: VecEnv = _Without(self.base, hidden) if hidden else self.base
        stacked: VecEnv = VecFrameStack(seen, recipe.history) if recipe.history > 1 else seen
        space = stacked.observation_space
        assert isinstance(space, spaces.Dict)
        for box in space.spaces.values():
            if box.dtype == np.uint8:
                assert box.shape is not None
                _check_image(box.shape[1], box.shape[0])
        numbers = [name for name, box in space.spaces.items() if box.dtype == np.float32]
        watched = VecMonitor(stacked, info_keywords=("success",))
        self.normaliser = VecNormalize(watched, gamma=recipe.gamma, norm_obs_keys=numbers)
        torch.manual_seed(recipe.seed)
        self.model = PPO(
            "MultiInputPolicy",
            self.normaliser,
            learning_rate=self._rate,
            n_steps=recipe.n_steps,
            batch_size=min(recipe.batch_size, recipe.n_steps * count),
            n_epochs=recipe.n_epochs,
            gamma=recipe.gamma,
            gae_lambda=recipe.gae_lambda,
            clip_range=recipe.clip_range,
            ent_coef=recipe.ent_coef,
            policy_kwargs={
                "log_std_init": recipe.log_std_init,
                "net_arch": [recipe.hidden, recipe.hidden],
                "features_extractor_class": KeyedExtractor,
            },
            device=recipe.device,
        )

    def _rate(self, _: float) -> float:
        done = self.model.num_timesteps if hasattr(self, "model") else 0
        return self.recipe.learning_rate * max(0.1, 1.0 - done / self.recipe.total_timesteps)

    def checkpoint(self) -> Checkpoint:
        """As it is now."""
        obs, ret = self.normaliser.obs_rms, self.normaliser.ret_rms
        assert isinstance(obs, dict)
        normaliser = {"return": _moments(ret), "observation": {name: _moments(rms) for name, rms in obs.items()}}
        policy, optimizer = self.model.policy.state_dict(), self.model.policy.optimizer.state_dict()
        return Checkpoint(self.recipe, self.model.num_timesteps, policy, optimizer, normaliser)

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint of the same recipe (but for how the environments are spread).

        Raises ``InputError`` for a network or a normaliser of another shape; nothing is changed then.
        """
        assert isinstance(self.normaliser.obs_rms, dict)
        moments = {"return": (self.normaliser.ret_rms, saved.normaliser.get("return"))}
        observed = saved.normaliser.get("observation")
        for name, rms in self.normaliser.obs_rms.items():
            moments[f"observation.{name}"] = rms, observed.get(name) if isinstance(observed, dict) else None
        checked = [(rms, _checked_moments(name, rms, values)) for name, (rms, values) in moments.items()]
        own = {name: tuple(tensor.shape) for name, tensor in self.model.policy.state_dict().items()}
        other = {name: tuple(tensor.shape) for name, tensor in saved.policy.items()}
        if own != other:
            differ = sorted(name for name in {*own, *other} if own.get(name) != other.get(name))
            rule = (
                f"must be of this task and these observations: {differ[0]} is {other.get(differ[0])}, here {own.get(differ[0])}"
            )
            raise InputError("checkpoint", value=saved.recipe, rule=rule)
        try:
            self.model.policy.load_state_dict(saved.policy)
            if saved.optimizer:
                self.model.policy.optimizer.load_state_dict(saved.optimizer)
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                "checkpoint", value=saved.recipe, rule=f"must be of this task and these observations ({error})"
            ) from error
        for rms, (mean, var, count) in checked:
            rms.mean, rms.var, rms.count = mean, var, count
        self.model.num_timesteps = saved.steps

    def predict(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The deterministic policy's actions for observations that the normaliser has seen."""
        return self.model.predict(dict(observation), deterministic=True)[0]

    def close(self) -> None:
        """End what runs beside."""
        self.base.close()


def _moments(rms: RunningMeanStd) -> dict[str, Any]:
    return {"mean": torch.as_tensor(np.asarray(rms.mean)), "var": torch.as_tensor(np.asarray(rms.var)), "count": float(rms.count)}


def _checked_moments(name: str, rms: RunningMeanStd, saved: object) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean, variance and count of a normaliser as saved, of the shape that it has here."""
    if not isinstance(saved, Mapping) or not {"mean", "var", "count"} <= set(saved):
        raise InputError(f"normaliser.{name}", value=type(saved).__name__, rule="must have mean, var and count")
    mean, var = (
        check_numbers(f"normaliser.{name}.{key}", saved[key], np.shape(rms.mean), finite=True) for key in ("mean", "var")
    )
    if (var < 0.0).any():
        raise InputError(f"normaliser.{name}.var", value=float(var.min()), rule="must be >= 0")
    return mean, var, check_number(f"normaliser.{name}.count", saved["count"], "[0, inf)")


class LearnerEpisodes:
    """Held-out episodes of a learner's deterministic policy (``raytac.learn.ShownEpisodes``)."""

    def __init__(self, learner: Learner) -> None:
        """Freeze the normaliser."""
        env = learner.model.get_env()
        assert env is not None
        self._learner, self._env, self.num_envs = learner, env, env.num_envs
        learner.normaliser.training = False

    @property
    def control_timestep(self) -> float:
        return self._vector.batch.control_timestep

    @property
    def sensors(self) -> tuple[str, ...]:
        return tuple(self._vector.batch.observers)

    @property
    def _vector(self) -> TactileVectorEnv:
        base = self._learner.base
        assert isinstance(base, TactileVecEnv) and isinstance(base.env, TactileVectorEnv)
        return base.env

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._seen = self._env.reset()

    def step(self) -> Outcome:
        self._seen, _, done, infos = self._env.step(self._learner.predict(self._seen))  # type: ignore[arg-type]
        success, failed = (np.array([info[name] for info in infos], float) for name in ("success", "failed"))
        return Outcome(self._learner.normaliser.get_original_reward(), done, success, failed)

    def picture(self) -> np.ndarray:
        pictures = self._vector.render()
        assert pictures is not None
        return pictures[0]


def evaluate_learner(learner: Learner, count: int, *, first_seed: int = 0) -> Evaluation:
    """As ``raytac.learn.evaluate``, in the learner's own environments."""
    try:
        return evaluate(LearnerEpisodes(learner), count, first_seed=first_seed)
    finally:
        learner.normaliser.training = True


class CheckpointPlayer:
    """Policy of a checkpoint (``raytac.learn.Player``)."""

    def __init__(self, path: Path) -> None:
        """Load it. Raises ``InputError`` for a file that is none."""
        self._saved = Checkpoint.load(path)
        recipe = self._saved.recipe
        self.name, self.task, self.physics, self._recipe = path.stem, recipe.task, recipe.physics, recipe

    def episodes(self, num_envs: int, *, physics: str, device: str, shown: Any = None) -> LearnerEpisodes:
        """As ``Player``; of a policy that is given images, those are shown."""
        device = "cpu" if device == "auto" else device
        recipe, options = replace(self._recipe, processes=1, num_envs=num_envs, device=device), {"physics": physics}
        hidden: list[str] = []
        if shown is not None:
            settings = tactile_settings(recipe.tactile, recipe.resolution)
            felt = KINDS[recipe.task].task.tactile if settings == "task" else getattr(settings, "modalities", ())
            options["render_mode"] = "rgb_array"
            if "rgb" not in felt:
                tactile, hidden = shown_beside(felt, shown)
                options |= {"tactile": tactile, "pitch": 0.4e-3}
        learner = Learner(recipe, hidden=hidden, **options)
        learner.restore(self._saved)
        return LearnerEpisodes(learner)
