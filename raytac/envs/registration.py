"""Names of the environments in Gymnasium's registry."""

from __future__ import annotations

from typing import Final

from raytac.errors import BackendError

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise BackendError("Gymnasium is not installed: pip install 'raytac[rl]'") from error

_MODULES: Final = {
    "PushCube": "push_cube",
    "BalancePole": "balance_pole",
    "LiftCube": "lift_cube",
    "RollBall": "roll_ball",
    "InsertPeg": "insert_peg",
    "OpenDrawer": "open_drawer",
}
IDS: Final = tuple(f"raytac/{name}-v0" for name in _MODULES)
"""Names that ``gymnasium.make`` and ``gymnasium.make_vec`` take once ``raytac.envs`` is imported."""


def register_envs() -> None:
    """Register all, each as one environment and as a vector. Episodes end by themselves, so there is no time limit around them."""
    for name, module in _MODULES.items():
        if f"raytac/{name}-v0" not in gymnasium.registry:
            where = f"raytac.envs.{module}:{name}"
            gymnasium.register(f"raytac/{name}-v0", entry_point=f"{where}Env", vector_entry_point=f"{where}VectorEnv")
