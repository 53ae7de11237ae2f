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

__all__ = ["MAX_ENTRIES", "make_preconditioner"]

MAX_ENTRIES = 60_000_000
"""Numbers of four bytes up to which the rest inverse of a body is built; it takes the host minutes above that."""


def make_preconditioner(layout: Layout, settings: Settings, batch: int, lanes: int, device: wp.Device) -> Preconditioner:
    """The one that ``settings.preconditioner`` names; ``"auto"`` takes what was measured to be fastest on the device.

    Raises:
        IpcError: if the rest inverse is asked for and no body is bonded, one is too large, or too ill-conditioned.
    """
    wanted = settings.preconditioner
    if wanted == "block_jacobi" or (wanted == "auto" and not device.is_cuda):
        return BlockJacobi(batch, len(layout.node_rest), lanes, device)
    sizes = [entries(layout, *choose_partition(layout, body)) for body in bonded_bodies(layout)]
    if sizes and max(sizes) <= MAX_ENTRIES:
        try:
            return RestInverse(layout, settings, batch, lanes, device)
        except np.linalg.LinAlgError as error:
            if wanted != "auto":
                rule = "a rest matrix is too ill-conditioned to be inverted in single precision"
                raise IpcError(f"preconditioner = {wanted!r}: {rule}; choose 'block_jacobi'") from error
    elif wanted != "auto":
        rule = f"no body is bonded, or one is too large (inverses of {sizes} numbers, at most {MAX_ENTRIES})"
        raise IpcError(f"preconditioner = {wanted!r}: {rule}; choose 'block_jacobi' or 'auto'")
    return BlockJacobi(batch, len(layout.node_rest), lanes, device)
