"""``ContactTracker``: contacts of successive surfaces, with the object's motion at each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, chosen_envs
from raytac.markers.contact_history import ContactHistory
from raytac.markers.contacts import Contacts, ContactSamples, ContactSettings


class ContactTracker:
    """Contacts of each surface in turn, with the object's motion summed at each.

    A contact is a connected component of the contact mask. From one surface to the next the object moves by D = T_now T_before⁻¹ (pad
    frame). A contact at G, on the pressed gel, adds (D G − G)_xy to its shear and D's rotation about z to its twist. This is the motion
    of the object's material where it touches, which is zero in rolling. A contact is an earlier one if it lies where D carries that one,
    to within its radius and ``ContactSettings.reach``; otherwise it is new and starts from zero. Without contact the history is dropped.

    With ``slip`` c, what exceeds Δs_max = c h̄ A and Δθ_max = ``TWIST_SLIP`` c h̄ slips and is forgotten, so a reversal unloads first.
    The shear that the physics knows takes the place of the history of the contact that it belongs to.
    """

    def __init__(self, batch: int, settings: ContactSettings | None = None, *, slip: float | None = None) -> None:
        """``settings``: None is the default; ``slip`` [1/m]: None never slips."""
        self.batch, self._reach, self._slip = batch, (settings or ContactSettings()).reach, slip
        self._history: ContactHistory | None = None

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Drop the history of environments; ``envs`` as in ``chosen_envs``."""
        chosen = chosen_envs(envs, self.batch)
        if self._history is not None:
            self._history.forget(chosen)

    def update(
        self, surface: GelSurface, samples: ContactSamples, envs: Sequence[int] | None = None, shear: ContactShear | None = None
    ) -> Contacts:
        """Contacts of ``surface``; arguments and errors as of ``MarkerTracker.update``."""
        chosen = np.arange(self.batch) if envs is None else np.asarray(envs, int)
        if surface.batch != len(chosen):
            raise InputError("surface", value=surface.batch, rule=f"must have {len(chosen)} environments, as this tracker")
        if self._history is None:
            self._history = ContactHistory(samples.cells, self._reach, self._slip, num_envs=self.batch)
        # One that is named twice advances once.
        rows, of = np.arange(len(chosen)), None
        if envs is not None and len(set(envs)) < len(envs):
            _, rows, of = np.unique(chosen, return_index=True, return_inverse=True)
        poses = None if surface.pad_from_object is None else surface.pad_from_object[rows]
        some = None if shear is None else (shear.centre[rows], np.column_stack([shear.stretch, shear.spin])[rows])
        table = self._history.of(chosen[rows], samples, rows, poses, some)
        return Contacts(table if of is None else table[of])
