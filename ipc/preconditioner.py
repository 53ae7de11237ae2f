"""Which preconditioner a world uses."""

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.errors import IpcError
from ipc.layout import Layout
from ipc.linear import BlockJacobi, Preconditioner
from ipc.rest_inverse import RestInverse
from ipc.rest_stiffness import bonded_bodies
from ipc.settings import Settings
from ipc.substructure import choose_partition, entries

__all__ = ["AUTOMATIC", "MAX_ENTRIES", "make_preconditioner"]

MAX_ENTRIES = 60_000_000
"""Numbers of four bytes up to which the rest inverse of a body is built; the host needs a minute for that many, and more for more."""
AUTOMATIC = {"cpu": "block_jacobi", "cuda": "block_jacobi"}
"""What ``"auto"`` means: measured on the CPU (``docs/ipc-preconditioners.md``), not yet on CUDA."""


def make_preconditioner(layout: Layout, settings: Settings, batch: int, lanes: int, device: wp.Device) -> Preconditioner:
    """The one that ``settings.preconditioner`` names; ``"auto"`` is block-Jacobi wherever the rest inverse cannot be had.

    Raises:
        IpcError: if the rest inverse is asked for and no body is bonded, one is too large, or too ill-conditioned.
    """
    wanted, must = settings.preconditioner, settings.preconditioner != "auto"
    if (wanted if must else AUTOMATIC["cuda" if device.is_cuda else "cpu"]) == "rest_inverse":
        sizes = [entries(layout, *choose_partition(layout, body)) for body in bonded_bodies(layout)]
        rule = f"no body is bonded, or one is too large (inverses of {sizes} numbers, at most {MAX_ENTRIES})"
        if sizes and max(sizes) <= MAX_ENTRIES:
            try:
                return RestInverse(layout, settings, batch, lanes, device)
            except np.linalg.LinAlgError:
                rule = "a rest matrix is too ill-conditioned to be inverted in single precision"
        if must:
            raise IpcError(f"preconditioner = {wanted!r}: {rule}; choose 'block_jacobi' or 'auto'")
    return BlockJacobi(batch, len(layout.node_rest), lanes, device)
