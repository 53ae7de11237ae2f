"""``--shadows`` and ``--no-shadows``: cast shadows or none, whatever the sensor file says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from raytac.errors import InputError

__all__ = ["ShadowOptions"]


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast shadows, of a sensor whose file says otherwise too."""
    no_shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast none; as the sensor file says ([optics] shadows) if neither is given."""

    def chosen_shadows(self) -> dict[str, bool]:
        """``{"shadows": …}`` for the optical mode; empty if the sensor decides.

        Raises:
            InputError: both flags.
        """
        if self.shadows and self.no_shadows:
            raise InputError("shadows, no_shadows", value=(True, True), rule="contradict each other: give one")
        return {"shadows": self.shadows} if self.shadows or self.no_shadows else {}
