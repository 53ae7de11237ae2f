"""Names of the environments in Gymnasium's registry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from raytac.errors import BackendError

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise BackendError("Gymnasium is not installed: pip install 'raytac[envs]'") from error

LEARNERS: Final = {"torch": "PyTorch", "tensordict": "tensordict", "rsl_rl": "rsl_rl", "stable_baselines3": "stable-baselines3"}
"""Libraries of the extra ``rl`` by package."""

_MODULES: Final = {
    "PushCube": "push_cube",
    "BalancePole": "balance_pole",
    "LiftCube": "lift_cube",
    "RollBall": "roll_ball",
    "InsertPeg": "insert_peg",
    "OpenDrawer": "open_drawer",
}
_VERSIONS: Final = {"PushCube": 0, "BalancePole": 1, "LiftCube": 2, "RollBall": 2, "InsertPeg": 0, "OpenDrawer": 0}
"""Version of each task, named by Gymnasium to who asks for an older one; see its docstring."""
TASKS: Final = tuple(_VERSIONS)
"""Names of the tasks."""
_NAMES: Final = {name: f"raytac/{name}-v{version}" for name, version in _VERSIONS.items()}
IDS: Final = tuple(_NAMES.values())
"""Names for ``gymnasium.make`` and ``make_vec`` once ``raytac.envs`` is imported."""
_WARP_NAMES: Final = {name: f"raytac/{name}Warp-v{version}" for name, version in _VERSIONS.items()}
WARP_IDS: Final = tuple(_WARP_NAMES.values())
"""Names for ``gymnasium.make_vec`` of the same tasks on MuJoCo Warp, with PyTorch tensors."""


def register_envs() -> None:
    """Register all, alone, as a vector and as one of tensors, without a time limit around it."""
    for name, module in _MODULES.items():
        if _NAMES[name] not in gymnasium.registry:
            where = f"raytac.envs.{module}:{name}"
            gymnasium.register(_NAMES[name], entry_point=f"{where}Env", vector_entry_point=f"{where}VectorEnv")
            vector = "raytac.envs:WarpVectorEnv"  # which names what is not installed
            gymnasium.register(_WARP_NAMES[name], vector_entry_point=vector, kwargs={"task": name})


def public_names(attribute: Callable[[str], Any]) -> Callable[[str], Any]:
    """Make a package's ``__getattr__`` from that of its stub.

    It raises ``BackendError`` where a name needs a learner's library that is absent.
    """

    def get(name: str) -> Any:
        try:
            return attribute(name)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in LEARNERS:
                raise
            raise BackendError(f"{name} needs {LEARNERS[package]}, which is not installed: pip install 'raytac[rl]'") from error

    return get
