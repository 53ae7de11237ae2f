"""Preconditioners of the conjugate gradients, and the choice of one for a world."""

from __future__ import annotations

import numpy as np
import warp as wp

from ipc.bodies.layout import Layout
from ipc.errors import IpcError
from ipc.settings import Settings
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.linear import Preconditioner
from ipc.solver.preconditioners.rest_inverse import RestInverse
from ipc.solver.preconditioners.rest_stiffness import bonded_bodies
from ipc.solver.preconditioners.substructure import MAX_ENTRIES, choose_partition, entries

__all__ = ["RestInverse", "make_preconditioner", "pays"]

_TIGHT = 1e-4
"""Linear tolerance up to which the number of iterations decides."""
_FEW_NODES, _MANY_NODES, _FEW_ENVIRONMENTS = 600, 3000, 16
_NEARLY_INCOMPRESSIBLE = 1 / (1 - 2 * 0.47)
"""λ/μ of the energy at ν = 0.47."""


def pays(layout: Layout, settings: Settings, batch: int, device: wp.Device) -> bool:
    """Expect the rest inverse to be faster than block-Jacobi.

    ``docs/concepts/preconditioners.md`` says when.

    On CUDA with a tight linear tolerance it does for pads of 600 free nodes or more, and for smaller ones in few environments. With a loose
    one it does for 600 to 3,000 free nodes, and for more from ν = 0.47 on, if no other body is free. On a CPU applying a dense inverse
    costs more than it saves.
    """
    bodies = bonded_bodies(layout)
    if not device.is_cuda or not bodies:
        return False
    spans = [slice(*layout.node_start[b : b + 2]) for b in bodies]
    nodes = max(int(layout.node_free[span].sum()) for span in spans)
    if settings.linear_tolerance <= _TIGHT:
        return nodes >= _FEW_NODES or batch < _FEW_ENVIRONMENTS
    if sum(span.stop - span.start for span in spans) < len(layout.node_rest):
        return False
    return nodes >= _FEW_NODES and (nodes <= _MANY_NODES or float((layout.lam / layout.mu).max()) >= _NEARLY_INCOMPRESSIBLE)


def make_preconditioner(layout: Layout, settings: Settings, batch: int, lanes: int, device: wp.Device) -> Preconditioner:
    """Make the preconditioner of ``settings``; ``"auto"`` takes the rest inverse where it pays.

    Its products of matrices add up in another order for another number of environments, so a deterministic world does without.

    Raises ``IpcError`` if the rest inverse is asked for and no body is bonded, one is too large, or too ill-conditioned.
    """
    name, must = settings.preconditioner, settings.preconditioner != "auto"
    if name == "rest_inverse" or (not must and not settings.deterministic and pays(layout, settings, batch, device)):
        sizes = [entries(layout, *choose_partition(layout, body)) for body in bonded_bodies(layout)]
        rule = f"no body is bonded, or one is too large (inverses of {sizes} numbers, at most {MAX_ENTRIES})"
        if sizes and max(sizes) <= MAX_ENTRIES:
            try:
                return RestInverse(layout, settings, batch, lanes, device)
            except np.linalg.LinAlgError:
                rule = "a rest matrix is too ill-conditioned to be inverted in single precision"
        if must:
            raise IpcError(f"preconditioner = {name!r}: {rule}; choose 'block_jacobi' or 'auto'")
    return BlockJacobi(layout, batch, lanes, device)
