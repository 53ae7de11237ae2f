"""What the commands that may use the contact solver share."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.io.options import CommonOptions
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import PHYSICS, scene_physics
from raytac.physics.soft.availability import check_solver, hush_solver
from raytac.specs import PressScene, TaskScene

__all__ = ["SolverOptions", "chosen_physics"]


def chosen_physics(physics: str | None, level: str | None, scene: PressScene | TaskScene) -> PhysicsConfig:
    """Physics that ``--physics`` and ``--level`` name: with a level alone ``ipc``, with neither as the scene says, else ``rigid``.

    Raises:
        InputError: an unknown name, or a level of a physics that has none. SpecError: an unknown name in the scene.
    """
    if physics is None and level is None:
        return scene_physics(None, scene)
    return scene_physics(PHYSICS.config(physics or "ipc", **({} if level is None else {"level": level})), scene)


@dataclass(frozen=True, kw_only=True)
class SolverOptions(CommonOptions):
    """Options of a command that may use the contact solver."""

    verbose: bool = False
    """Let Warp, on which the contact solver runs, list devices and the kernels that it loads; warnings and errors only if not given."""

    def prepare_solver(self, user: str) -> None:
        """Call before the solver is first used; ``user`` is what needs it.

        Raises:
            BackendError: the solver is not installed.
        """
        check_solver(user)
        if not self.verbose:
            hush_solver()
