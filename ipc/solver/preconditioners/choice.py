"""Which preconditioner a world uses."""

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.bodies.layout import Layout
from ipc.errors import IpcError
from ipc.settings import Settings
from ipc.solver.linear import BlockJacobi, Preconditioner
from ipc.solver.preconditioners.rest_inverse import RestInverse
from ipc.solver.preconditioners.rest_stiffness import bonded_bodies
from ipc.solver.preconditioners.substructure import MAX_ENTRIES, choose_partition, entries

__all__ = ["make_preconditioner", "pays"]

_FEW_NODES, _MANY_NODES = 700, 3000
_NEARLY_INCOMPRESSIBLE = 1 / (1 - 2 * 0.47)
"""λ/μ of the energy at ν = 0.47."""


def pays(layout: Layout, device: wp.Device) -> bool:
    """Whether the rest inverse is expected to make a step faster than block-Jacobi (``docs/ipc-preconditioners.md`` has the figures).

    On one H200 it did for pads of 1,428 vertices, and from ν = 0.47 on for 5,346 too, where block-Jacobi needs many iterations; below, and
    on a CPU, applying a dense inverse costs more than it saves. A free body in the world keeps block-Jacobi and its iterations.
    """
    bodies = bonded_bodies(layout)
    if not device.is_cuda or not bodies:
        return False
    spans = [slice(*layout.node_start[b : b + 2]) for b in bodies]
    held = sum(span.stop - span.start for span in spans)
    if held < len(layout.node_rest):
        return False
    nodes = max(int(layout.node_free[span].sum()) for span in spans)
    return nodes >= _FEW_NODES and (nodes <= _MANY_NODES or float((layout.lam / layout.mu).max()) >= _NEARLY_INCOMPRESSIBLE)


def make_preconditioner(layout: Layout, settings: Settings, batch: int, lanes: int, device: wp.Device) -> Preconditioner:
    """The one that ``settings.preconditioner`` names; ``"auto"`` takes the rest inverse where it pays and can be had.

    Its products of matrices add up in another order for another number of environments, so a deterministic world does without.

    Raises:
        IpcError: if the rest inverse is asked for and no body is bonded, one is too large, or too ill-conditioned.
    """
    wanted, must = settings.preconditioner, settings.preconditioner != "auto"
    if wanted == "rest_inverse" or (not must and not settings.deterministic and pays(layout, device)):
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
