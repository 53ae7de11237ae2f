"""The layout of the bodies of a world in flat arrays that every environment shares.

Unknowns are *nodes*. A soft body's nodes are its vertices; an affine body has four, the corners of a tetrahedron around it, so that
its twelve unknowns are positions too: x(X) = Σ_k w_k(X) u_k with barycentric w. Nodes live in their body's frame. *Vertices* are the
surface points that touch: a soft vertex follows one node, an affine one four, a kinematic one none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipc.bodies.body import AffineBody, Body, HalfSpace, KinematicBody, SoftBody, rotation_matrix
from ipc.bodies.material import MODEL_CODES
from ipc.errors import IpcError
from ipc.meshes.mesh import TriMesh, surface_of, surface_topology

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]
Arrays = dict[str, NDArray]
"""Arrays of one body by the names of :class:`Layout`; nodes count from its first."""


@dataclass(frozen=True)
class Layout:
    """Flat arrays of N nodes, T elements, K blocks, V vertices, E edges, F faces, P pairs.

    Attributes:
        names: body names, in order.    half_space: body is a half-space (bodies,).
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
        volume_block: number of the volume block that an element belongs to, −1 for none (T,).    own: λ' of elements [Pa] (T,).
        block_tet_start (Q+1,), block_tet: elements of each of Q volume blocks.    block_volume [m³], block_lam [Pa], block_rest (Q,): V_b,
            λ − λ' and a of ``ipc.solver.dilation``.
        pair_block, pair_node (S,): pairs of a volume block and a node of it, by block.    block_pair_start (Q+1,): first of each block.
            pair_corner_start (S+1,), pair_corner: 4·element + a for each element of the block at the node.
        node_pair_start (N+1,), node_pair: the pairs that a node is in.
        row_start (N+1,), col (K,): block pattern of the matrix.    mass: [kg] (K,).
        part_start (K+1,), part: 16·element + 4·a + b for each contribution to a block.
        corner_start (N+1,), corner: 4·element + a for each element at a node.
        vert_body (V,), vert_count (V,): nodes a vertex follows, 0, 1 or 4.    vert_nodes, vert_weight: (V, 4).
        vert_local: kinematic position in the body's frame [m] (V, 3).    vert_area: [m²] (V,).
        node_vert_start (N+1,), node_vert, node_vert_weight: the vertices that follow a node.
        edges (E, 2), edge_area (E,), faces (F, 3), edge_rest2: squared rest length [m²] (E,).
        pairs (P, 2): bodies that may touch; a half-space comes second.    friction (P,): μ of each.
        min_edge: shortest edge on soft or affine bodies [m].    max_young: largest of the soft bodies [Pa]; 0 without one.
        affine_inertia: ρ V^(2/3) (1 + s) of each affine body [kg/m] (A,).    affine_stiffness: their κ [Pa] (A,).
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
    volume_block: Ints
    own: Floats
    block_tet_start: Ints
    block_tet: Ints
    block_volume: Floats
    block_lam: Floats
    block_rest: Floats
    pair_block: Ints
    pair_node: Ints
    block_pair_start: Ints
    pair_corner_start: Ints
    pair_corner: Ints
    node_pair_start: Ints
    node_pair: Ints
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
    affine_inertia: Floats
    affine_stiffness: Floats


_NUMBERS = ("node_rest", "node_damping", "node_drive", "aim_local", "grads", "volume", "mu", "lam", "own")
"""Fields of :class:`Layout` that are those of the bodies, one after the other."""


def _groups(keys: NDArray, count: int) -> tuple[Ints, Ints]:
    """Starts and members of the groups of equal keys 0..count−1, members in rising order."""
    order = np.argsort(keys, kind="stable")
    return np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=count))]).astype(np.int32), order.astype(np.int32)


def _corner_gradients(x: Floats) -> Floats:
    """∇w of the corners of tetrahedra (T, 4, 3) [1/m]."""
    inverse = np.linalg.inv(x[:, 1:] - x[:, :1])  # columns are the gradients of w_1, w_2, w_3
    rest = np.swapaxes(inverse, 1, 2)
    return np.concatenate([-rest.sum(axis=1, keepdims=True), rest], axis=1, dtype=np.float64)


def _affine_mass(body: AffineBody) -> tuple[Floats, Floats, Floats, float]:
    """Reference corners (4, 3), barycentric weights of vertices (V, 4), masses (4, 4), volume."""
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


def _soft(body: SoftBody) -> tuple[TriMesh, Arrays]:
    """Surface and arrays: nodes are the vertices of the mesh; surface vertices follow one."""
    x, tets = body.mesh.vertices, body.mesh.tets
    placed = x if len(body.bonded) else x @ rotation_matrix(body.pose.rotation).T + body.pose.position
    volume = np.linalg.det(x[tets][:, 1:] - x[tets][:, :1]) / 6
    lumped = np.bincount(tets.ravel(), weights=np.repeat(body.material.density * volume / 4, 4), minlength=len(x))
    if not (lumped > 0).all():
        raise IpcError(f"{body.name}: vertex {int(np.argmin(lumped))} belongs to no tetrahedron")
    free = np.ones(len(x))
    free[np.concatenate([body.bonded, *body.grips.values()])] = 0
    mu, lam = body.material.coefficients()
    blocks = np.full(len(tets), -1) if body.volume_blocks is None else body.volume_blocks
    used, local = np.unique(surface_of(tets), return_inverse=True)
    return TriMesh(x[used], local.reshape(-1, 3)), {
        "node_rest": placed,
        "node_free": free,
        "node_damping": body.material.mass_damping * lumped,
        "node_drive": np.zeros(len(x)),
        "aim_local": np.zeros((len(x), 3)),
        "tets": tets,
        "grads": _corner_gradients(placed[tets]),
        "volume": volume,
        "model": np.full(len(tets), MODEL_CODES[body.material.model]),
        "mu": np.full(len(tets), mu),
        "lam": np.full(len(tets), lam),
        "volume_block": blocks,
        "own": np.where(blocks < 0, lam, body.own_volume * mu),
        "mass_row": np.arange(len(x)),
        "mass_col": np.arange(len(x)),
        "mass": lumped,
        "vert_count": np.ones(len(used)),
        "vert_nodes": np.pad(used[:, None], ((0, 0), (0, 3))),
        "vert_weight": np.tile([1.0, 0, 0, 0], (len(used), 1)),
    }


def _affine(body: AffineBody) -> tuple[TriMesh, Arrays]:
    """Surface and arrays: nodes are four corners around the body; all vertices follow them."""
    corners, weights, mass, volume = _affine_mass(body)
    row, col = np.meshgrid(np.arange(4), np.arange(4), indexing="ij")
    return body.surface, {
        "affine_inertia": np.array([body.material.density * volume ** (2 / 3) * (1 + body.drive)]),
        "affine_stiffness": np.array([body.material.stiffness]),
        "node_rest": corners @ rotation_matrix(body.pose.rotation).T + body.pose.position,
        "node_free": np.ones(4),
        "node_damping": np.zeros(4),
        "node_drive": np.full(4, body.drive),
        "aim_local": corners,
        "tets": np.arange(4)[None],
        "grads": _corner_gradients(corners[None]),
        "volume": np.array([volume]),
        "model": np.array([MODEL_CODES["orthogonal"]]),
        "mu": np.array([body.material.stiffness]),
        "lam": np.zeros(1),
        "volume_block": np.full(1, -1),
        "own": np.zeros(1),
        "mass_row": row.ravel(),
        "mass_col": col.ravel(),
        "mass": mass.ravel(),
        "vert_count": np.full(len(weights), 4),
        "vert_nodes": np.tile(np.arange(4), (len(weights), 1)),
        "vert_weight": weights,
    }


def _arrays(body: Body) -> tuple[TriMesh | None, Arrays]:
    """Surface and arrays of a body; kinematic ones have no nodes, half-spaces no surface."""
    if isinstance(body, SoftBody):
        return _soft(body)
    if isinstance(body, AffineBody):
        return _affine(body)
    if isinstance(body, KinematicBody):
        zero = np.zeros((len(body.surface.vertices), 4))
        return body.surface, {"vert_count": zero[:, 0], "vert_nodes": zero, "vert_weight": zero}
    if isinstance(body, HalfSpace):
        return None, {}
    raise IpcError(f"{body!r} is no body: choose SoftBody, AffineBody, KinematicBody or HalfSpace")


def _frames(bodies: Sequence[Body], node_start: Ints) -> Arrays:
    """Frames, one a body in order and then those of grips and aims, and what they carry."""
    names, owner, node_aim = [body.name for body in bodies], list(range(len(bodies))), np.full(node_start[-1], -1)
    moves = [isinstance(b, KinematicBody | HalfSpace) or (isinstance(b, SoftBody) and len(b.bonded) > 0) for b in bodies]
    nodes, frames, places = [np.zeros(0)], [np.zeros(0)], [np.zeros((0, 3))]
    for number, body in enumerate(bodies):
        if isinstance(body, SoftBody):
            for grip, ids in body.grips.items():
                nodes.append(ids + node_start[number])
                frames.append(np.full(len(ids), len(names)))
                places.append(body.mesh.vertices[ids])
                names.append(f"{body.name}.{grip}")
                owner.append(number)
                moves.append(True)
        elif isinstance(body, AffineBody) and body.drive:
            node_aim[node_start[number] : node_start[number + 1]] = len(names)
            names.append(f"{body.name}.aim")
            owner.append(number)
            moves.append(False)
    framed = np.array(moves) | (np.arange(len(names)) >= len(bodies))
    poses = [(*bodies[b].pose.position, *bodies[b].pose.rotation) for b in owner]
    return {
        "frame_names": np.array(names),
        "framed": framed,
        "frame_body": _ints(owner),
        "frame_moves": _ints(moves),
        "frame_pose": np.where(framed[:, None], poses, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
        "node_aim": _ints(node_aim),
        "grip_node": _ints(np.concatenate(nodes)),
        "grip_frame": _ints(np.concatenate(frames)),
        "grip_local": np.concatenate(places),
    }


def _pairs(
    bodies: Sequence[Body], friction: float, exceptions: Mapping[tuple[str, str], float], ignored: Sequence[tuple[str, str]]
) -> tuple[Ints, Floats]:
    """Bodies that may touch (P, 2), half-spaces second, and μ of each pair (P,)."""
    movable = [isinstance(body, SoftBody | AffineBody) for body in bodies]
    mu_of, skip = {frozenset(pair): mu for pair, mu in exceptions.items()}, {frozenset(pair) for pair in ignored}
    pairs, mus = [], []
    for i, first in enumerate(bodies):
        for j in range(i, len(bodies)):
            names = frozenset((first.name, bodies[j].name))
            if names in skip or not (movable[i] or movable[j]):
                continue
            if i == j and not (isinstance(first, SoftBody) and first.self_contact):
                continue
            pairs.append((j, i) if isinstance(first, HalfSpace) else (i, j))
            mus.append(mu_of.get(names, friction))
            if not mus[-1] >= 0:
                raise IpcError(f"friction of {first.name!r} and {bodies[j].name!r} is {mus[-1]}: it cannot be negative")
    return _ints(pairs).reshape(-1, 2), _floats(mus)


def _ints(values: ArrayLike) -> Ints:
    return np.ascontiguousarray(values, dtype=np.int32)


def _floats(values: ArrayLike) -> Floats:
    return np.ascontiguousarray(values, dtype=np.float64)


def _starts(lengths: Iterable[int]) -> Ints:
    """First index of each of several lists in their concatenation, with the total at the end."""
    return _ints([0, *np.cumsum(list(lengths))])


def _volume_blocks(of_bodies: Sequence[NDArray], tets: Ints, nodes: int) -> Arrays:
    """Blocks of all bodies, renumbered from 0, by the names of :class:`Layout`."""
    tagged = np.concatenate([np.stack([np.full(len(of), k), of], axis=1) for k, of in enumerate(of_bodies)])
    inside = np.flatnonzero(tagged[:, 1] >= 0)
    names, number = np.unique(tagged[inside], axis=0, return_inverse=True)
    number = number.reshape(-1)
    volume_block = np.full(len(tets), -1)
    volume_block[inside] = number
    tet_start, order = _groups(number, len(names))
    keys = number[:, None].astype(np.int64) * nodes + tets[inside]
    pairs, which = np.unique(keys, return_inverse=True)
    corner_start, corner = _groups(which.ravel(), len(pairs))
    node_start, node_pair = _groups(pairs % nodes, nodes)
    return {
        "volume_block": _ints(volume_block),
        "block_tet_start": tet_start,
        "block_tet": _ints(inside[order]),
        "pair_block": _ints(pairs // nodes),
        "pair_node": _ints(pairs % nodes),
        "block_pair_start": _starts(np.bincount(pairs // nodes, minlength=len(names))),
        "pair_corner_start": corner_start,
        "pair_corner": _ints(4 * inside[corner // 4] + corner % 4),
        "node_pair_start": node_start,
        "node_pair": node_pair,
    }


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

    parts = [_arrays(body) for body in bodies]
    node_start, tet_start = (_starts(len(arrays.get(name, ())) for _, arrays in parts) for name in ("node_rest", "tets"))
    if node_start[-1] == 0:
        raise IpcError("nothing can move: a world needs a SoftBody or an AffineBody")

    def joined(name: str, start: Ints | None = None) -> NDArray:
        """Arrays of all bodies; indices count from each body's ``start``."""
        arrays = [a[name] + (0 if start is None else start[k]) for k, (_, a) in enumerate(parts) if name in a]
        return np.concatenate(arrays) if arrays else np.zeros(0)

    meshes = [mesh for mesh, _ in parts]
    topologies = [surface_topology(mesh.vertices, mesh.faces) if mesh else None for mesh in meshes]
    vert_start, face_start = (_starts(len(getattr(m, name)) if m else 0 for m in meshes) for name in ("vertices", "faces"))
    edge_start = _starts(len(topology.edges) if topology else 0 for topology in topologies)
    surfaces = [
        (m, topology, first) for m, topology, first in zip(meshes, topologies, vert_start, strict=False) if m and topology
    ]
    vert_local = np.concatenate([mesh.vertices for mesh, _, _ in surfaces])
    edges = _ints(np.concatenate([topology.edges + first for _, topology, first in surfaces]))
    edge_rest2 = ((vert_local[edges[:, 1]] - vert_local[edges[:, 0]]) ** 2).sum(axis=1)
    edge_body = np.repeat(np.arange(len(bodies)), np.diff(edge_start))
    if not edge_rest2.min() > 0:
        raise IpcError(f"{names[edge_body[np.argmin(edge_rest2)]]}: the surface has an edge of no length")
    deformable = ~np.array([isinstance(body, KinematicBody) for body in bodies])[edge_body]

    tets, n = _ints(joined("tets", node_start)), int(node_start[-1])
    a, b = (index.ravel() for index in np.meshgrid(np.arange(4), np.arange(4), indexing="ij"))
    rows = np.concatenate([tets[:, a].ravel(), joined("mass_row", node_start)]).astype(np.int64)
    cols = np.concatenate([tets[:, b].ravel(), joined("mass_col", node_start)]).astype(np.int64)
    blocks, which = np.unique(rows * n + cols, return_inverse=True)
    part_start, part = _groups(which[: 16 * len(tets)], len(blocks))
    corner_start, corner = _groups(tets.ravel(), n)
    volumes = _volume_blocks([arrays["volume_block"] for _, arrays in parts if "volume_block" in arrays], tets, n)
    first = volumes["block_tet"][volumes["block_tet_start"][:-1]]
    block_mu, block_lam, log = joined("mu")[first], joined("lam")[first], joined("model")[first] == MODEL_CODES["stable_log"]
    weights = joined("volume")[volumes["block_tet"]]
    block_of = np.repeat(np.arange(len(first)), np.diff(volumes["block_tet_start"]))
    vert_count, vert_weight = _ints(joined("vert_count")), _floats(joined("vert_weight"))
    slots = np.arange(4)[None] < vert_count[:, None]
    vert_nodes = _ints(np.where(slots, joined("vert_nodes", node_start), 0))
    node_vert_start, members = _groups(vert_nodes[slots], n)
    pairs, mus = _pairs(bodies, friction, exceptions, ignored)
    frames = _frames(bodies, node_start)
    return Layout(
        names=names,
        frame_names=tuple(frames.pop("frame_names").tolist()),
        half_space=np.array([isinstance(b, HalfSpace) for b in bodies]),
        node_start=node_start,
        vert_start=vert_start,
        edge_start=edge_start,
        face_start=face_start,
        tet_start=tet_start,
        node_free=_ints(joined("node_free")),
        node_body=np.repeat(np.arange(len(bodies), dtype=np.int32), np.diff(node_start)),
        tets=tets,
        model=_ints(joined("model")),
        block_volume=_floats(np.bincount(block_of, weights, minlength=len(first))),
        block_lam=_floats(block_lam - joined("own")[first]),
        block_rest=_floats(np.where(log, 1.0 + 0.75 * block_mu / block_lam, 1.0)),
        row_start=_starts(np.bincount(blocks // n, minlength=n)),
        col=_ints(blocks % n),
        mass=_floats(np.bincount(which[16 * len(tets) :], weights=joined("mass"), minlength=len(blocks))),
        part_start=part_start,
        part=part,
        corner_start=corner_start,
        corner=corner,
        vert_body=np.repeat(np.arange(len(bodies), dtype=np.int32), np.diff(vert_start)),
        vert_count=vert_count,
        vert_nodes=vert_nodes,
        vert_weight=vert_weight,
        vert_local=vert_local,
        vert_area=np.concatenate([s.vertex_area for _, s, _ in surfaces]),
        node_vert_start=node_vert_start,
        node_vert=_ints(np.nonzero(slots)[0][members]),
        node_vert_weight=_floats(vert_weight[slots][members]),
        edges=edges,
        edge_area=np.concatenate([s.edge_area for _, s, _ in surfaces]),
        edge_rest2=edge_rest2,
        faces=_ints(np.concatenate([m.faces + first for m, _, first in surfaces])),
        pairs=pairs,
        friction=mus,
        min_edge=float(edge_rest2[deformable].min()) ** 0.5,
        max_young=max((body.material.young for body in bodies if isinstance(body, SoftBody)), default=0.0),
        affine_inertia=_floats(joined("affine_inertia")),
        affine_stiffness=_floats(joined("affine_stiffness")),
        **{name: _floats(joined(name)) for name in _NUMBERS},
        **frames,
        **volumes,
    )
