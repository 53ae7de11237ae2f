"""A surface patch of a bonded body that moves as a whole: its support and its mass.

The linear body at rest: with C the compliance between the patch's nodes and R their rigid motions about the patch's centre (6 columns),
K = Rᵀ C⁻¹ R. The rest of the body follows by the deflection that K belongs to, u = C_:P C⁻¹ R, and moves with the mass uᵀ M u (R. J. Guyan,
Reduction of stiffness and mass matrices, AIAA Journal 3, 1965). A deformed body is taken to be as stiff as at rest, turned with the patch,
and as a string besides: under a force T its energy grows by T (6/5 x²/L + 2/15 L θ² ± 1/5 x θ) / 2 across it (the geometric stiffness
of a beam, J. S. Przemieniecki, Theory of Matrix Structural Analysis, 1968). Here that is bounded by 1.3 T/L and 7/30 T L along and about
all axes, with L the least distance from the bonded nodes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipc.bodies.layout import Layout
from ipc.errors import IpcError
from ipc.report import PatchMotion
from ipc.settings import Settings
from ipc.solver.potential import Potential
from ipc.solver.preconditioners.rest_stiffness import rest_blocks
from ipc.solver.preconditioners.substructure import MAX_ENTRIES, choose_partition, condense, entries

Floats = NDArray[np.float64]

_STATIC = 1e3
"""A step so long [s] that inertia has no part in the matrix."""
_LEAST_RADIUS = 1e-4
"""Of gyration [m]: nodes on a line have no inertia about it."""


class RestPatches:
    """Patches of one bonded soft body; making it inverts the body's rest matrix once."""

    def __init__(self, layout: Layout, settings: Settings, body: int) -> None:
        """Invert the body's rest matrix; ``IpcError`` if too large or too ill-conditioned."""
        nodes, label = choose_partition(layout, body)
        name, size = layout.names[body], entries(layout, nodes, label)
        if size > MAX_ENTRIES:
            rule = f"the inverse of its rest matrix would have {size} numbers, at most {MAX_ENTRIES}; cut it more coarsely"
            raise IpcError(f"{name!r} has {len(nodes)} free vertices, too many for the stiffness of a patch: {rule}")
        blocks = rest_blocks(layout, replace(settings, dt=_STATIC))
        try:
            self._inner = condense(layout, blocks, nodes, label)
        except np.linalg.LinAlgError as error:
            rule = "its rest matrix is too ill-conditioned to be inverted in single precision"
            raise IpcError(f"{name!r}: {rule}; cut it into better shaped cells") from error
        self._body, self._layout = body, layout
        span = np.arange(layout.node_start[body], layout.node_start[body + 1])
        self._bonded = layout.node_rest[span[layout.node_free[span] == 0]]
        rows = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
        self._mass = np.bincount(rows, weights=layout.mass, minlength=len(layout.node_rest))

    def loaded(self, potential: Potential, env: int) -> PatchMotion | None:
        """Motion of the free nodes under contact forces of the last step; None without any."""
        layout = self._layout
        first, last = layout.vert_start[self._body : self._body + 2]
        forces = potential.vert_gradient.numpy()[env, first:last]
        nodes = layout.vert_nodes[first:last, 0][forces.any(axis=1)]
        nodes = nodes[layout.node_free[nodes] != 0]
        return self.motion(potential, env, nodes, float(np.linalg.norm(forces.sum(axis=0)))) if len(nodes) else None

    def motion(self, potential: Potential, env: int, patch: NDArray[np.integer], force: float = 0.0) -> PatchMotion:
        """Motion of the nodes ``patch`` (n,) of the layout in one environment, without bonded ones.

        ``force``: size of the force on the patch [N]. Raises ``ValueError`` where none of them is free to move.
        """
        inner, layout = self._inner, self._layout
        place = np.full(len(layout.node_rest), -1)
        place[inner.interface] = np.arange(len(inner.interface))
        patch = patch[place[patch] >= 0]
        if len(patch) == 0:
            raise ValueError("no node of the patch is free to move")
        rest, middle = layout.node_rest[patch], layout.node_rest[patch].mean(axis=0)
        rigid = _rigid(rest - middle)
        at = (3 * place[patch][:, None] + np.arange(3)).ravel()
        compliance = inner.inverse[np.ix_(at, at)].astype(np.float64)
        loads = np.linalg.solve(0.5 * (compliance + compliance.T), rigid)
        stiffness = rigid.T @ loads
        mass = self._moving_mass(inner.inverse[:, at].astype(np.float64) @ loads)
        # From the body's frame at rest to the world as it is.
        frame, origin = potential.R.numpy()[env, self._body], potential.t.numpy()[env, self._body]
        y, v = potential.y.numpy()[env, patch], potential.v.numpy()[env, patch]
        rotation = frame @ _rotation(rest - middle, y - y.mean(axis=0))
        turned = np.kron(np.eye(2), rotation)
        stiffness, mass = turned @ (0.5 * (stiffness + stiffness.T)) @ turned.T, turned @ mass @ turned.T
        length = float(np.linalg.norm(rest[:, None] - self._bonded, axis=2).min())
        stiffness += force * np.diag([1.3 / length] * 3 + [7.0 / 30.0 * length] * 3)
        arm = (y - y.mean(axis=0)) @ frame.T
        spread = _rigid(arm)
        motion: Floats = np.linalg.lstsq(spread, np.asarray(v, np.float64).reshape(-1), rcond=1e-9)[0].astype(np.float64)
        total = float(np.trace(mass[:3, :3])) / 3.0
        inertia = mass[3:, 3:] + total * _LEAST_RADIUS**2 * np.eye(3)
        return PatchMotion(total, inertia, frame @ y.mean(axis=0) + origin, motion, stiffness)

    def _moving_mass(self, interface: Floats) -> Floats:
        """uᵀ M u of the deflection u (3 Γ, 6) of the interface and of the nodes inside."""
        inner = self._inner
        parts = [(inner.interface, interface)]
        place = {int(node): k for k, node in enumerate(inner.interface)}
        for p in inner.patches:
            border = np.array([place[int(node)] for node in p.border])
            at = (3 * border[:, None] + np.arange(3)).ravel()
            parts.append((p.nodes, -p.extension.astype(np.float64) @ interface[at]))
        mass = np.zeros((6, 6))
        for nodes, u in parts:
            follows = u.reshape(-1, 3, 6)
            mass += np.einsum("nia,n,nib->ab", follows, self._mass[nodes], follows)
        return mass


def _rigid(arm: Floats) -> Floats:
    """Rigid motions of points (n, 3): three translations, three rotations; (3 n, 6)."""
    x, y, z = arm.T
    motions = np.zeros((len(arm), 3, 6))
    motions[:, :, :3] = np.eye(3)
    zero = np.zeros_like(x)
    # ω × arm
    motions[:, :, 3:] = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return motions.reshape(-1, 6)


def _rotation(before: Floats, after: Floats) -> Floats:
    """The rotation that best maps points (n, 3) to others; the identity for points on a line."""
    u, size, v = np.linalg.svd(after.T @ before)
    if size[1] <= 1e-6 * max(size[0], 1e-300):
        return np.eye(3)
    u[:, 2] *= np.sign(np.linalg.det(u @ v))
    return u @ v
