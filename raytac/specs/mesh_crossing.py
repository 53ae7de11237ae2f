"""Pairs of triangles of one surface that pass through each other or lie on each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from raytac.io.progress import Progress

_CHUNK = 1 << 18
"""Most pairs of boxes that are looked at together."""
_MOST_PAIRS = 20_000
"""Crossing pairs after which the search ends: nobody repairs them one by one."""
_MOST_TESTS = 200_000_000
"""Pairs with overlapping boxes that end the search; a sound million triangles have a tenth."""
_LARGE = 200_000
"""Triangles from which a search shows its progress: it takes seconds from there on."""
_ROUNDING = 16 * np.finfo(np.float64).eps
"""Bound of a triple product's rounding error, over the product of the lengths."""


@dataclass(frozen=True)
class Crossings:
    """Result of ``find_crossings``."""

    pairs: np.ndarray
    """Indices of faces that cross or overlap, (P, 2), the smaller first."""
    place: tuple[float, float, float] | None
    """Middle of the first pair, in the unit of the vertices; None without a pair."""
    is_complete: bool
    """True if every pair was looked at; False where the search ended early."""

    def __bool__(self) -> bool:
        return len(self.pairs) > 0 or not self.is_complete

    def text(self, unit: float, name: str) -> str:
        """Count and place of the crossings; ``unit`` [m] of the place is called ``name``."""
        if self.place is None:
            return f"so many of its triangles lie across each other that the first {_MOST_TESTS:,} pairs do not tell whether they cross"
        count = f"{len(self.pairs):,}" if self.is_complete else f"at least {len(self.pairs):,}"
        at = ", ".join(f"{value / unit:.4g}" for value in self.place)
        which = "pair of triangles crosses or overlaps" if count == "1" else "pairs of triangles cross or overlap"
        return f"{count} {which}, the first near ({at}) {name}"


def find_crossings(vertices: np.ndarray, faces: np.ndarray) -> Crossings:
    """Triangles of a surface that meet where they share no vertex, or that overlap in one plane.

    A bounding-volume hierarchy over the triangles in Morton order is descended against itself, level by level, in chunks, so that memory
    stays bounded. An edge crosses a triangle if its ends lie on different sides of the plane and its line passes through the triangle
    (signs of triple products, Möller and Trumbore's). An end that lies on the triangle to rounding counts as crossing. Two triangles in
    one plane overlap if no edge's normal separates them. Of a large mesh, progress is shown on standard error.

    Args:
        vertices: (V, 3).
        faces: (F, 3) indices.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    order = _morton_order(corners)
    levels = _boxes(corners[order])
    # Each entry: level, pairs of nodes there, and the part of the surface that they stand for.
    stack = [(0, np.zeros((1, 2), np.int64), float(len(faces)))]
    batches: list[np.ndarray] = []
    tests = count = 0
    done = 0.0
    is_complete = True
    with Progress(desc="check triangles", total=len(faces), unit="triangle", show=len(faces) >= _LARGE, leave=False) as bar:
        while stack:
            depth, nodes, share = stack.pop()
            low, high = levels[depth]
            a, b = nodes.T
            nodes = nodes[((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)]
            if depth < len(levels) - 1 and len(nodes):
                children = _children(nodes)
                chunks = [children[start : start + _CHUNK] for start in range(0, len(children), _CHUNK)]
                stack += [(depth + 1, chunk, share * len(chunk) / len(children)) for chunk in chunks]
                continue
            done += share
            bar.update(int(done) - bar.n)
            pairs = order[nodes[nodes[:, 0] != nodes[:, 1]]]
            tests += len(pairs)
            crossing = pairs[_meet(corners, faces, pairs)]
            count += len(crossing)
            batches.append(np.sort(crossing, axis=1))
            if (count > _MOST_PAIRS or tests > _MOST_TESTS) and stack:
                is_complete = False
                break
    pairs = np.concatenate(batches) if batches else np.zeros((0, 2), np.int64)
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    place = tuple(float(v) for v in corners[pairs[0]].mean(axis=(0, 1))) if len(pairs) else None
    return Crossings(pairs, place, is_complete)  # type: ignore[arg-type]


def _morton_order(corners: np.ndarray) -> np.ndarray:
    """Order of triangles (F, 3, 3) along a Z curve through their middles, 21 bits an axis."""
    middle = corners.mean(axis=1)
    low, extent = middle.min(axis=0), np.ptp(middle, axis=0).max()
    grid = ((middle - low) * ((2**21 - 1) / extent if extent > 0 else 0.0)).astype(np.uint64)
    code = np.zeros(len(middle), np.uint64)
    for axis in range(3):
        bits = grid[:, axis]
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _boxes(corners: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes (low, high) of a binary tree over ordered triangles, root first; a missing is empty."""
    depth = int(np.ceil(np.log2(max(len(corners), 1))))
    low, high = np.full((2**depth, 3), np.inf), np.full((2**depth, 3), -np.inf)
    low[: len(corners)], high[: len(corners)] = corners.min(axis=1), corners.max(axis=1)
    levels = [(low, high)]
    while len(low) > 1:
        low, high = low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1)
        levels.append((low, high))
    return levels[::-1]


def _children(nodes: np.ndarray) -> np.ndarray:
    """Pairs of children of pairs (n, 2) of nodes, each pair once."""
    a, b = nodes.T
    same = a == b
    own = 2 * a[same]
    one = [np.stack([own, own], 1), np.stack([own, own + 1], 1), np.stack([own + 1, own + 1], 1)]
    p, q = 2 * a[~same], 2 * b[~same]
    return np.concatenate([*one, *(np.stack([p + i, q + j], 1) for i in (0, 1) for j in (0, 1))])


def _meet(corners: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles that cross or overlap, as a mask (n,)."""
    result = np.zeros(len(pairs), bool)
    sides = [_sides(corners, pairs), _sides(corners, pairs[:, ::-1])]
    # A triangle that lies wholly on one side of the other's plane meets it nowhere else than in what they share.
    apart = [((side > 0).all(axis=1) | (side < 0).all(axis=1)) for side in sides]
    flat = ~(sides[0].any(axis=1) & sides[1].any(axis=1))
    near = np.flatnonzero(~(apart[0] | apart[1] | flat))
    for which, side in zip((pairs, pairs[:, ::-1]), sides, strict=True):
        result[near] |= _edges_cross(corners, faces, which[near], side[near])
    flat = np.flatnonzero(flat)
    result[flat] = _overlap(corners[pairs[flat]])
    return result


def _sides(corners: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Side (n, 3), as a sign, of the second triangle's plane of the first's corners; 0: on it."""
    s, t = corners[pairs[:, 0]], corners[pairs[:, 1]]
    u, v = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    return _sign(s - t[:, None, 0], u[:, None], v[:, None])


def _edges_cross(corners: np.ndarray, faces: np.ndarray, pairs: np.ndarray, side: np.ndarray) -> np.ndarray:
    """True where an edge of the first triangle passes through the second; no shared vertex."""
    s, t = corners[pairs[:, 0]], corners[pairs[:, 1]]
    shared = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any(axis=2)
    result = np.zeros(len(pairs), bool)
    for k in range(3):
        m = (k + 1) % 3
        chosen = np.flatnonzero((side[:, k] * side[:, m] <= 0) & (side[:, k] != side[:, m]) & ~shared[:, k] & ~shared[:, m])
        if not len(chosen):
            continue
        p, along, of = s[chosen, k], s[chosen, m] - s[chosen, k], t[chosen]
        around = np.stack([_sign(along, of[:, j] - p, of[:, (j + 1) % 3] - p) for j in range(3)])
        through = np.logical_not((around > 0).any(axis=0) & (around < 0).any(axis=0))
        # An edge almost in the plane has no sure sign: there the outlines tell.
        unsure = np.flatnonzero(through & (around == 0).any(axis=0))
        through[unsure] = _overlap(np.stack([s, t], axis=1)[chosen[unsure]])
        result[chosen] |= through
    return result


def _sign(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Sign of the triple product a · (b × c), 0 where rounding may have made it."""
    value = (a * np.cross(b, c)).sum(axis=-1)
    size = _ROUNDING * np.prod([np.sqrt((v * v).sum(axis=-1)) for v in np.broadcast_arrays(a, b, c)], axis=0)
    return np.where(np.abs(value) <= size, 0, np.sign(value)).astype(np.int8)


def _overlap(corners: np.ndarray) -> np.ndarray:
    """True where coplanar pairs (n, 2, 3, 3) overlap: no edge's normal separates them."""
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    drop = np.abs(normal).sum(axis=1).argmax(axis=1)
    kept = np.array([[1, 2], [0, 2], [0, 1]])[drop]
    flat = np.take_along_axis(corners, kept[:, None, None, :], axis=3)
    flat = flat - flat[:, :1, :1]
    size = np.abs(flat).max(axis=(1, 2, 3), initial=0.0)
    result = np.ones(len(corners), bool)
    for own in (0, 1):
        for k in range(3):
            edge = flat[:, own, (k + 1) % 3] - flat[:, own, k]
            along = flat[..., 0] * edge[:, None, None, 1] - flat[..., 1] * edge[:, None, None, 0]
            low, high = along.min(axis=2), along.max(axis=2)
            common = np.minimum(high[:, 0], high[:, 1]) - np.maximum(low[:, 0], low[:, 1])
            result &= common > 4 * _ROUNDING * size * np.abs(edge).max(axis=1)
    return result
