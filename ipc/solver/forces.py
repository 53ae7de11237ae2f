"""Forces and motions after a step, by body and by pair; world frame, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.bodies.layout import Layout
from ipc.report import ContactPairs, Wrench
from ipc.solver.potential import Potential

Floats = NDArray[np.float64]
Ints = NDArray[np.integer]


def host(array: wp.array) -> NDArray[Any]:
    """An array of the device in NumPy: a view on the CPU, a copy from CUDA."""
    return array.numpy()


@dataclass(frozen=True)
class _Forces:
    """C forces between primitives, of all environments; coef · force acts on a vertex."""

    env: Ints
    pair: Ints
    verts: Ints
    """(C, 4), −1 unused."""
    coef: Floats
    """(C, 4)."""
    force: Floats
    """[N] (C, 3)."""


def _normal_forces(potential: Potential) -> _Forces:
    """Normal forces of the contacts at the end of the step."""
    contacts = potential.collision.contacts
    pair = host(contacts.pair)
    at = np.nonzero(np.arange(pair.shape[1]) < host(contacts.count)[:, None])
    force = host(contacts.force)[at][:, None] * host(contacts.normal)[at]
    return _Forces(at[0], pair[at], host(contacts.verts)[at], host(contacts.coef)[at], force)


def _friction_forces(potential: Potential) -> _Forces:
    """Friction forces −μ λ f1(|w|) w / |w| of the lagged contacts, w their elastic slip."""
    lagged = potential.collision.lagged
    pair = host(lagged.pair)
    at = np.nonzero(np.arange(pair.shape[1]) < host(lagged.count)[:, None])
    verts, coef, normal = host(lagged.verts)[at], host(lagged.coef)[at], host(lagged.normal)[at]
    moved = host(potential.x) - host(potential.x_start)
    u = np.einsum("cn,cni->ci", np.where(verts >= 0, coef, 0.0), moved[at[0][:, None], np.maximum(verts, 0)])
    w = host(lagged.slip)[at] + u - (u * normal).sum(axis=1, keepdims=True) * normal
    y, eps = np.linalg.norm(w, axis=1), potential.settings.friction_slip
    ratio = np.where(y >= eps, 1.0 / np.maximum(y, eps), (2.0 - y / eps) / eps)
    return _Forces(at[0], pair[at], verts, coef, -(host(lagged.limit)[at] * ratio)[:, None] * w)


def _all_forces(potential: Potential) -> list[_Forces]:
    return [_normal_forces(potential), *([_friction_forces(potential)] if potential.collision.friction else [])]


def bond_wrench(potential: Potential, body: int, frame: int, nodes: Ints) -> Wrench:
    """Force and torque of a body's bonded ``nodes`` on their frame, about its origin."""
    R, t = host(potential.R)[:, body], host(potential.t)
    forces = -np.einsum("bij,bnj->bni", R, host(potential.gradient)[:, nodes])
    points = np.einsum("bij,bnj->bni", R, host(potential.y)[:, nodes]) + t[:, None, body]
    return Wrench(forces.sum(axis=1), np.cross(points - t[:, None, frame], forces).sum(axis=1))


def contact_wrench(layout: Layout, potential: Potential, body: int) -> Wrench:
    """Contact and friction forces on a body (reactions of a half-space), own or world's origin."""
    x, t = host(potential.x), host(potential.t)
    if layout.half_space[body]:
        points, forces = x, np.zeros_like(x)
        for some in _all_forces(potential):
            mine = (some.verts[:, 1] < 0) & (layout.pairs[some.pair, 1] == body)
            np.add.at(forces, (some.env[mine], some.verts[mine, 0]), -some.force[mine])
    else:
        first, last = layout.vert_start[body : body + 2]
        points, forces = x[:, first:last], -host(potential.vert_gradient)[:, first:last]
    origin = t[:, None, body] if layout.framed[body] else 0.0
    return Wrench(forces.sum(axis=1), np.cross(points - origin, forces).sum(axis=1))


def contact_pairs(layout: Layout, potential: Potential, env: int) -> ContactPairs:
    """The contact pairs of one environment at the end of the last step."""
    contacts = potential.collision.contacts
    n = int(host(contacts.count)[env])
    pairs = layout.pairs[host(contacts.pair)[env, :n]]
    return ContactPairs(
        bodies=tuple((layout.names[a], layout.names[b]) for a, b in pairs),
        vertices=host(contacts.verts)[env, :n].copy(),
        weights=host(contacts.coef)[env, :n].copy(),
        normal=host(contacts.normal)[env, :n].copy(),
        gap=host(contacts.gap)[env, :n].copy(),
        force=host(contacts.force)[env, :n].copy(),
    )


def touching(layout: Layout, potential: Potential, body: int) -> dict[str, NDArray[np.bool_]]:
    """Masks (B,) of other bodies that were closer than d̂ at the end of the last step, by name."""
    contacts = potential.collision.contacts
    pair = host(contacts.pair)
    near = np.zeros((len(pair), len(layout.pairs)), bool)
    env, k = np.nonzero(np.arange(pair.shape[1]) < host(contacts.count)[:, None])
    near[env, pair[env, k]] = True
    mine = np.flatnonzero((layout.pairs == body).any(axis=1) & near.any(axis=0))
    other = layout.pairs[mine].sum(axis=1) - body
    return {layout.names[b]: near[:, p] for p, b in zip(mine, other, strict=True)}
