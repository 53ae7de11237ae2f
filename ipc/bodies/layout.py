"""Lay the bodies of a world out in flat arrays that every environment shares.

Unknowns are *nodes*. A soft body's nodes are its vertices; an affine body has four, the corners of a tetrahedron around it, so that
its twelve unknowns are positions too: x(X) = Σ_k w_k(X) u_k with barycentric w. Nodes live in their body's frame. *Vertices* are the
surface points that touch: a soft vertex follows one node, an affine one four, a kinematic one none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipc.bodies.body import AffineBody, Body, HalfSpace, KinematicBody, SoftBody
from ipc.bodies.material import MODEL_CODES
from ipc.errors import IpcError
from ipc.meshes.mesh import TriMesh, surface_of, surface_topology

__all__ = ["Layout", "build_layout", "rotation_matrix"]

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]


def rotation_matrix(quaternion: Sequence[float] | Floats) -> Floats:
    """Rotation matrices of unit quaternions (w, x, y, z), shape (..., 4) to (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class Layout:
    """The flat arrays; sizes: bodies, N nodes, T elements, K matrix blocks, V vertices, E edges, F faces, P body pairs.

    Attributes:
        names: body names, in order.
        frame_names: names of the frames: one a body, in order, then grips and aims of driven affine bodies, ``"<body>.<grip>"`` and
            ``"<body>.aim"``.
        framed: frame is driven (kinematic, half-space, soft with bonded vertices, grip, aim), shape (frames,).
        frame_body: (frames,).    frame_moves: 1 where a frame carries something rigidly, 0 for bodies without one and aims (frames,).
        frame_pose: position [m] and quaternion (w, x, y, z) at the start (frames, 7).
        node_start, vert_start, edge_start, face_start, tet_start: first index of each body, with the total at the end.
        node_rest: start positions in the body's frame [m] (N, 3).    node_free: 1 for an unknown, 0 for a bonded node (N,).
        node_body: (N,).    node_damping: α m [kg/s] (N,).
        grip_node, grip_frame (G,): gripped nodes and their frames.    grip_local: their positions there [m] (G, 3).
        node_drive: strength s of the drive (N,).    node_aim: its frame, −1 without (N,).    aim_local: position there [m] (N, 3).
        tets: nodes (T, 4).    grads: ∇w of each corner [1/m] (T, 4, 3).    volume: [m³] (T,).
        model, mu, lam: energy code and coefficients [Pa] (T,).
        row_start (N+1,), col (K,): block pattern of the matrix.    mass: [kg] (K,).
        part_start (K+1,), part: 16·element + 4·a + b for each contribution to a block.
        corner_start (N+1,), corner: 4·element + a for each element at a node.
        vert_body (V,), vert_count (V,): nodes a vertex follows, 0, 1 or 4.    vert_nodes, vert_weight: (V, 4).
        vert_local: kinematic position in the body's frame [m] (V, 3).    vert_area: [m²] (V,).
        node_vert_start (N+1,), node_vert, node_vert_weight: the vertices that follow a node.
        edges (E, 2), edge_area (E,), faces (F, 3), edge_rest2: squared rest length [m²] (E,).
        pairs (P, 2): bodies that may touch; a half-space comes second.    friction (P,): μ of each.
        half_space: body is a half-space, shape (bodies,).
        min_edge: shortest edge on the deformable or affine surfaces [m]; of all surfaces without one.
        max_young: largest Young's modulus of the soft bodies [Pa]; 0 without one.
    """

    names: tuple[str, ...]
    frame_names: tuple[str, ...]
    framed: NDArray[np.bool_]
    frame_body: Ints
    frame_moves: Ints
    frame_pose: Floats
    half_space: NDArray[np.bool_]
    node_start: Ints
    vert_start: Ints
    edge_start: Ints
    face_start: Ints
    tet_start: Ints
    node_rest: Floats
    node_free: Ints
    node_body: Ints
    node_damping: Floats
    grip_node: Ints
    grip_frame: Ints
    grip_local: Floats
    node_drive: Floats
    node_aim: Ints
    aim_local: Floats
    tets: Ints
    grads: Floats
    volume: Floats
    model: Ints
    mu: Floats
    lam: Floats
    row_start: Ints
    col: Ints
    mass: Floats
    part_start: Ints
    part: Ints
    corner_start: Ints
    corner: Ints
    vert_body: Ints
    vert_count: Ints
    vert_nodes: Ints
    vert_weight: Floats
    vert_local: Floats
    vert_area: Floats
    node_vert_start: Ints
    node_vert: Ints
    node_vert_weight: Floats
    edges: Ints
    edge_area: Floats
    edge_rest2: Floats
    faces: Ints
    pairs: Ints
    friction: Floats
    min_edge: float
    max_young: float


def _groups(keys: NDArray, count: int) -> tuple[Ints, Ints]:
    """Starts and members of the groups of equal keys 0..count−1, members in rising order."""
    order = np.argsort(keys, kind="stable")
    return np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=count))]).astype(np.int32), order.astype(np.int32)


def _corner_gradients(x: Floats) -> Floats:
    """∇w of the corners of tetrahedra (T, 4, 3) [1/m]."""
    inverse = np.linalg.inv(x[:, 1:] - x[:, :1])  # columns are the gradients of w_1, w_2, w_3
    rest = np.swapaxes(inverse, 1, 2)
    return np.concatenate([-rest.sum(axis=1, keepdims=True), rest], axis=1, dtype=np.float64)


def _affine_parts(body: AffineBody) -> tuple[Floats, Floats, Floats, float]:
    """Corners of the reference tetrahedron (4, 3), barycentric weights of the vertices (V, 4), masses (4, 4) and volume."""
    v, f = body.surface.vertices, body.surface.faces
    low, high = v.min(axis=0), v.max(axis=0)
    middle, size = (low + high) / 2, (high - low).max()
    corners = middle + size * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 2
    if np.linalg.det(corners[1:] - corners[0]) < 0:
        corners = corners[[0, 2, 1, 3]]

    def weights(points: Floats) -> Floats:
        local = np.linalg.solve((corners[1:] - corners[0]).T, (points - corners[0]).T).T
        return np.concatenate([1 - local.sum(axis=1, keepdims=True), local], axis=1)

    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]).tolist()
    sides = {tuple(side) for side in directed}
    if len(sides) < len(directed) or any((b, a) not in sides for a, b in sides):
        raise IpcError(
            f"{body.name}: the surface of an affine body must be closed and orientable, every edge shared by two triangles"
        )
    apex = np.broadcast_to(middle, (len(f), 1, 3))
    cells = np.concatenate([apex, v[f]], axis=1)
    volumes = np.linalg.det(cells[:, 1:] - cells[:, :1]) / 6
    volume = float(volumes.sum())
    if not volume > 0:
        raise IpcError(
            f"{body.name}: the surface encloses {volume:.3g} m³: it must be closed, triangles counter-clockwise outside"
        )
    w = weights(cells.reshape(-1, 3)).reshape(-1, 4, 4)
    total = w.sum(axis=1)
    mass = np.einsum("t,tk,tl->kl", volumes / 20, total, total) + np.einsum("t,tik,til->kl", volumes / 20, w, w)
    return corners, weights(v), body.material.density * mass, volume


def build_layout(
    bodies: Sequence[Body], friction: float, exceptions: Mapping[tuple[str, str], float], ignored: Sequence[tuple[str, str]]
) -> Layout:
    """Lay ``bodies`` out.

    Args:
        bodies: with unique names.
        friction: μ of every pair that ``exceptions`` does not name.
        exceptions: μ by pair of names, in either order.
        ignored: pairs of names that may pass through each other.

    Raises:
        IpcError: on repeated or unknown names, or a world without an unknown.
    """
    names = tuple(body.name for body in bodies)
    if len(set(names)) != len(names):
        raise IpcError(f"bodies are named {names}: every name must be unique")
    for pair in [*exceptions, *ignored]:
        for name in pair:
            if name not in names:
                raise IpcError(f"no body is named {name!r}: choose from {', '.join(names)}")

    node_rest, node_free, node_damping, tets, grads, volume, codes, mus, lams = ([] for _ in range(9))
    mass_rows, mass_cols, mass_values = [], [], []
    count, vert_nodes, vert_weight, vert_local, vert_area, edges, edge_area, edge_rest2, faces = ([] for _ in range(9))
    node_start, vert_start, edge_start, face_start, tet_start = ([0] for _ in range(5))
    shortest, fallback = np.inf, np.inf
    frame_names, frame_bodies, frame_moves = list(names), list(range(len(bodies))), []
    for body in bodies:
        frame_moves.append(
            int(isinstance(body, KinematicBody | HalfSpace) or (isinstance(body, SoftBody) and len(body.bonded) > 0))
        )
    grip_node, grip_frame, grip_local, node_drive, node_aim, aim_local = ([] for _ in range(6))

    for number, body in enumerate(bodies):
        nodes, verts = node_start[-1], vert_start[-1]
        surface: TriMesh | None = None
        if isinstance(body, SoftBody):
            x, t = body.mesh.vertices, body.mesh.tets
            placed = x if len(body.bonded) else x @ rotation_matrix(body.pose.rotation).T + body.pose.position
            vol = np.linalg.det(x[t][:, 1:] - x[t][:, :1]) / 6
            lumped = np.bincount(t.ravel(), weights=np.repeat(body.material.density * vol / 4, 4), minlength=len(x))
            if not (lumped > 0).all():
                raise IpcError(f"{body.name}: vertex {int(np.argmin(lumped))} belongs to no tetrahedron")
            free = np.ones(len(x), np.int32)
            free[body.bonded] = 0
            for grip, ids in body.grips.items():
                free[ids] = 0
                grip_node.append(ids + nodes)
                grip_frame.append(np.full(len(ids), len(frame_names)))
                grip_local.append(x[ids])
                frame_names.append(f"{body.name}.{grip}")
                frame_bodies.append(number)
                frame_moves.append(1)
            node_drive.append(np.zeros(len(x)))
            node_aim.append(np.full(len(x), -1))
            aim_local.append(np.zeros((len(x), 3)))
            node_rest.append(placed)
            node_free.append(free)
            node_damping.append(body.material.mass_damping * lumped)
            tets.append(t + nodes)
            grads.append(_corner_gradients(placed[t]))
            volume.append(vol)
            mu, lam = body.material.coefficients()
            codes.append(np.full(len(t), MODEL_CODES[body.material.model]))
            mus.append(np.full(len(t), mu))
            lams.append(np.full(len(t), lam))
            mass_rows.append(np.arange(len(x)) + nodes)
            mass_cols.append(np.arange(len(x)) + nodes)
            mass_values.append(lumped)
            boundary = surface_of(t)
            used, local = np.unique(boundary, return_inverse=True)
            surface = TriMesh(x[used], local.reshape(-1, 3).astype(np.int32))
            count.append(np.ones(len(used)))
            vert_nodes.append(np.stack([used + nodes] + [np.zeros(len(used))] * 3, axis=1))
            vert_weight.append(np.tile([1.0, 0, 0, 0], (len(used), 1)))
        elif isinstance(body, AffineBody):
            corners, w, m, vol = _affine_parts(body)
            node_rest.append(corners @ rotation_matrix(body.pose.rotation).T + body.pose.position)
            node_free.append(np.ones(4, np.int32))
            node_drive.append(np.full(4, body.drive))
            node_aim.append(np.full(4, len(frame_names) if body.drive else -1))
            aim_local.append(corners)
            if body.drive:
                frame_names.append(f"{body.name}.aim")
                frame_bodies.append(number)
                frame_moves.append(0)
            node_damping.append(np.zeros(4))
            tets.append(np.arange(4)[None] + nodes)
            grads.append(_corner_gradients(corners[None]))
            volume.append([vol])
            codes.append([MODEL_CODES["orthogonal"]])
            mus.append([body.material.stiffness])
            lams.append([0.0])
            a, b = np.meshgrid(np.arange(4), np.arange(4), indexing="ij")
            mass_rows.append(a.ravel() + nodes)
            mass_cols.append(b.ravel() + nodes)
            mass_values.append(m.ravel())
            surface = body.surface
            count.append(np.full(len(w), 4))
            vert_nodes.append(np.tile(np.arange(4) + nodes, (len(w), 1)))
            vert_weight.append(w)
        elif isinstance(body, KinematicBody):
            surface = body.surface
            count.append(np.zeros(len(surface.vertices)))
            vert_nodes.append(np.zeros((len(surface.vertices), 4)))
            vert_weight.append(np.zeros((len(surface.vertices), 4)))
        elif not isinstance(body, HalfSpace):
            raise IpcError(f"{body!r} is no body: choose SoftBody, AffineBody, KinematicBody or HalfSpace")
        if surface is not None:
            topology = surface_topology(surface.vertices, surface.faces)
            ends = surface.vertices[topology.edges]
            rest2 = ((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1)
            if not rest2.min() > 0:
                raise IpcError(f"{body.name}: the surface has an edge of no length")
            vert_local.append(surface.vertices)
            vert_area.append(topology.vertex_area)
            edges.append(topology.edges + verts)
            edge_area.append(topology.edge_area)
            edge_rest2.append(rest2)
            faces.append(surface.faces + verts)
            fallback = min(fallback, float(rest2.min()) ** 0.5)
            if not isinstance(body, KinematicBody):
                shortest = min(shortest, float(rest2.min()) ** 0.5)
        for start, parts in zip(
            (node_start, vert_start, edge_start, face_start, tet_start), (node_rest, vert_local, edges, faces, tets), strict=True
        ):
            start.append(sum(len(p) for p in parts))
    if node_start[-1] == 0:
        raise IpcError("nothing can move: a world needs a SoftBody or an AffineBody")

    def ints(parts: list, columns: int = 0) -> Ints:
        shape = (0, columns) if columns else (0,)
        return np.ascontiguousarray(np.concatenate([np.zeros(shape), *parts]), dtype=np.int32)

    def floats(parts: list, columns: int = 0) -> Floats:
        shape = (0, columns) if columns else (0,)
        return np.ascontiguousarray(np.concatenate([np.zeros(shape), *parts]), dtype=np.float64)

    all_tets, n = ints(tets, 4), node_start[-1]
    a, b = np.meshgrid(np.arange(4), np.arange(4), indexing="ij")
    rows = np.concatenate([all_tets[:, a.ravel()].ravel(), ints(mass_rows)]).astype(np.int64)
    cols = np.concatenate([all_tets[:, b.ravel()].ravel(), ints(mass_cols)]).astype(np.int64)
    blocks, which = np.unique(rows * n + cols, return_inverse=True)
    elements = 16 * len(all_tets)
    part_start, part = _groups(which[:elements], len(blocks))
    corner_start, corner = _groups(all_tets.ravel(), n)
    counts, follows = ints(count), ints(vert_nodes, 4)
    slots = np.arange(4)[None] < counts[:, None]
    followers, members = _groups(follows[slots], n)

    young = [body.material.young for body in bodies if isinstance(body, SoftBody)]
    movable = [isinstance(body, SoftBody | AffineBody) for body in bodies]
    mu_of = {frozenset(pair): mu for pair, mu in exceptions.items()}
    skip = {frozenset(pair) for pair in ignored}
    pairs, mu_list = [], []
    for i, first in enumerate(bodies):
        for j in range(i, len(bodies)):
            if frozenset((names[i], names[j])) in skip or not (movable[i] or movable[j]):
                continue
            if i == j and not (isinstance(first, SoftBody) and first.self_contact):
                continue
            pairs.append((j, i) if isinstance(first, HalfSpace) else (i, j))
            mu_list.append(mu_of.get(frozenset((names[i], names[j])), friction))
            if not mu_list[-1] >= 0:
                raise IpcError(f"friction of {names[i]!r} and {names[j]!r} is {mu_list[-1]}: it cannot be negative")
    lengths = np.diff(vert_start)
    framed = np.array([moves == 1 or i >= len(bodies) for i, moves in enumerate(frame_moves)])
    return Layout(
        names=names,
        frame_names=tuple(frame_names),
        framed=framed,
        frame_body=np.array(frame_bodies, np.int32),
        frame_moves=np.array(frame_moves, np.int32),
        frame_pose=np.array(
            [
                (*bodies[b].pose.position, *bodies[b].pose.rotation) if f else (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
                for b, f in zip(frame_bodies, framed, strict=True)
            ]
        ),
        half_space=np.array([isinstance(b, HalfSpace) for b in bodies]),
        node_start=np.array(node_start, np.int32),
        vert_start=np.array(vert_start, np.int32),
        edge_start=np.array(edge_start, np.int32),
        face_start=np.array(face_start, np.int32),
        tet_start=np.array(tet_start, np.int32),
        node_rest=floats(node_rest, 3),
        node_free=ints(node_free),
        node_body=np.repeat(np.arange(len(bodies)), np.diff(node_start)).astype(np.int32),
        node_damping=floats(node_damping),
        grip_node=ints(grip_node),
        grip_frame=ints(grip_frame),
        grip_local=floats(grip_local, 3),
        node_drive=floats(node_drive),
        node_aim=ints(node_aim),
        aim_local=floats(aim_local, 3),
        tets=all_tets,
        grads=np.ascontiguousarray(np.concatenate(grads), dtype=np.float64),
        volume=floats(volume),
        model=ints(codes),
        mu=floats(mus),
        lam=floats(lams),
        row_start=np.concatenate([[0], np.cumsum(np.bincount(blocks // n, minlength=n))]).astype(np.int32),
        col=(blocks % n).astype(np.int32),
        mass=np.bincount(which[elements:], weights=floats(mass_values), minlength=len(blocks)).astype(np.float64),
        part_start=part_start,
        part=part,
        corner_start=corner_start,
        corner=corner,
        vert_body=np.repeat(np.arange(len(bodies)), lengths).astype(np.int32),
        vert_count=counts,
        vert_nodes=follows,
        vert_weight=floats(vert_weight, 4),
        vert_local=floats(vert_local, 3),
        vert_area=floats(vert_area),
        node_vert_start=followers,
        node_vert=np.ascontiguousarray(np.nonzero(slots)[0][members], dtype=np.int32),
        node_vert_weight=np.ascontiguousarray(floats(vert_weight, 4)[slots][members]),
        edges=ints(edges, 2),
        edge_area=floats(edge_area),
        edge_rest2=floats(edge_rest2),
        faces=ints(faces, 3),
        pairs=np.array(pairs, np.int32).reshape(-1, 2),
        friction=np.array(mu_list, np.float64),
        min_edge=shortest if np.isfinite(shortest) else fallback,
        max_young=max(young, default=0.0),
    )
