"""Sums over bodies and pairs in NumPy, contact after contact, for comparison with the kernels of ``ipc.sums``."""

from __future__ import annotations

import numpy as np

import ipc
from ipc.solver.forces import host


def pair_sums(world: ipc.World, env: int) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Normal force, place and wrench by names of two bodies, from the lists of contacts and of friction."""
    layout, potential = world.layout, world._potential
    x, start, eps = host(potential.x)[env], host(potential.x_start)[env], world.settings.friction_slip
    contacts, lagged = potential.collision.contacts, potential.collision.lagged
    rows = []
    for k in range(int(host(contacts.count)[env])):
        force = host(contacts.force)[env, k] * host(contacts.normal)[env, k]
        rows.append((host(contacts.pair)[env, k], host(contacts.verts)[env, k], host(contacts.coef)[env, k], force, True))
    for k in range(int(host(lagged.count)[env]) if potential.collision.friction else 0):
        verts, coef, n = host(lagged.verts)[env, k], host(lagged.coef)[env, k], host(lagged.normal)[env, k]
        u = sum((c * (x[i] - start[i]) for i, c in zip(verts, coef, strict=True) if i >= 0), np.zeros(3))
        w = host(lagged.slip)[env, k] + u - (u @ n) * n
        y = float(np.linalg.norm(w))
        ratio = 1.0 / y if y >= eps else (2.0 - y / eps) / eps
        rows.append((host(lagged.pair)[env, k], verts, coef, -host(lagged.limit)[env, k] * ratio * w, False))
    result = {}
    for p, (one, two) in enumerate(layout.pairs.tolist()):
        mine = []
        for pair, verts, coef, force, is_normal in rows:
            if pair != p:
                continue
            side = 1.0 if layout.vert_body[verts[0]] == one else -1.0
            weights = np.array([max(side * c, 0.0) if i >= 0 else 0.0 for i, c in zip(verts, coef, strict=True)])
            point = weights @ x[np.maximum(verts, 0)] / weights.sum()
            mine.append((side * force, point, is_normal))
        normals = [(f, at) for f, at, is_normal in mine if is_normal]
        if not normals:
            continue
        size = np.array([np.linalg.norm(f) for f, _ in normals])
        place = size @ np.array([at for _, at in normals]) / size.sum()
        wrench = sum(np.concatenate([f, np.cross(at - place, f)]) for f, at, _ in mine)
        result[layout.names[one], layout.names[two]] = (np.sum([f for f, _ in normals], axis=0), place, np.asarray(wrench))
    return result


def rigid_motion(world: ipc.World, name: str, env: int) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mass, centre, inertia, velocity and spin of a body from the whole mass matrix of its nodes."""
    layout, s, body = world.layout, world._potential, world.layout.names.index(name)
    first, last = layout.node_start[body : body + 2]
    row, end = layout.row_start[[first, last]]
    rows = np.repeat(np.arange(last - first), np.diff(layout.row_start[first : last + 1]))
    mass = np.zeros((last - first, last - first))
    mass[rows, layout.col[row:end] - first] = layout.mass[row:end]
    R, t = host(s.R)[env, body], host(s.t)[env, body]
    x = host(s.y)[env, first:last]
    if layout.framed[body]:
        x = x @ R.T + t
    v, total = host(s.v)[env, first:last], mass.sum()
    centre, velocity = mass.sum(axis=0) @ x / total, mass.sum(axis=0) @ v / total
    arm = x - centre
    second = arm.T @ mass @ arm
    inertia = np.trace(second) * np.eye(3) - second
    momentum = np.cross(arm, mass @ (v - velocity)).sum(axis=0)
    return float(total), centre, inertia, velocity, np.linalg.solve(inertia, momentum)
