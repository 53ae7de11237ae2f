"""What the commands that may use the contact solver share."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.io.options import CommonOptions
from raytac.physics.soft.availability import check_solver, quiet_solver

__all__ = ["SolverOptions"]


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
            quiet_solver()
