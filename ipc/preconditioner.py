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

__all__ = ["MAX_DENSE_NODES", "make_preconditioner"]

MAX_DENSE_NODES = 2500
"""Free nodes of a bonded body up to which its rest matrix is inverted: the inverse takes 36 bytes a node squared."""


def make_preconditioner(layout: Layout, settings: Settings, batch: int, device: wp.Device) -> Preconditioner:
    """The one that ``settings.preconditioner`` names; ``"auto"`` takes what was measured to be fastest on the device.

    Raises:
        IpcError: if the rest inverse is asked for and no body is bonded, one is too large, or too ill-conditioned.
    """
    wanted = settings.preconditioner
    if wanted == "block_jacobi" or (wanted == "auto" and not device.is_cuda):
        return BlockJacobi(batch, len(layout.node_rest), device)
    spans = [slice(*layout.node_start[b : b + 2]) for b in bonded_bodies(layout)]
    most = max((int((layout.node_free[span] != 0).sum()) for span in spans), default=0)
    if 0 < most <= MAX_DENSE_NODES:
        try:
            return RestInverse(layout, settings, batch, device)
        except np.linalg.LinAlgError as error:
            if wanted != "auto":
                rule = "a rest matrix is too ill-conditioned to be inverted in single precision"
                raise IpcError(f"preconditioner = {wanted!r}: {rule}; choose 'block_jacobi'") from error
    elif wanted != "auto":
        rule = f"the largest bonded body has {most} free nodes, and there must be 1 to {MAX_DENSE_NODES}"
        raise IpcError(f"preconditioner = {wanted!r}: {rule}; choose 'block_jacobi' or 'auto'")
    return BlockJacobi(batch, len(layout.node_rest), device)
