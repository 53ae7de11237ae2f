"""Parts and pads as flat Warp arrays for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.physics.rest_map import rest_maps
from raytac.physics.rigid.layer_response import layer_response, reduced_modulus
from raytac.physics.rigid.placed_kernels import Pads
from raytac.physics.rigid.shape_kernels import Shapes
from raytac.shapes.part import PART_KINDS, Part
from raytac.shapes.primitives import bounds, radius_about_origin
from raytac.shapes.underside import object_radius
from raytac.specs.sensor import GelpadSpec


class ShapeArrays:
    """All bodies' parts; one ``wp.Mesh`` for each set of triangles, however many parts share it."""

    def __init__(self, bodies: Sequence[Sequence[Part]], device: wp.Device) -> None:
        for index, parts in enumerate(bodies):
            if not parts:
                raise InputError(f"bodies[{index}]", value=(), rule="a body without parts cannot touch")
        parts = [part for body in bodies for part in body]
        self.most_parts = max((len(body) for body in bodies), default=1)
        self._device = device
        self._meshes: dict[tuple[int, int], tuple[wp.Mesh, int, int]] = {}
        self._vertices: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        elevation: list[np.ndarray] = []
        columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        for part in parts:
            centre, half, radius = _ball_and_box(part)
            mesh, first_vertex, first_face = self._triangles(part, centre)
            columns["kind"].append(PART_KINDS.index(part.kind))
            columns["size"].append([*part.size, 0.0, 0.0, 0.0][:3])
            columns["rotation"].append(part.object_from_part[:3, :3])
            columns["offset"].append(part.object_from_part[:3, 3])
            columns["centre"].append(centre)
            columns["half"].append(half)
            columns["radius"].append(radius)
            columns["width"].append(2.0 * part.size[1] if part.kind == "torus" else np.inf)
            columns["blunt"].append(_blunt(part))
            columns["max_slope"].append(part.max_slope)
            columns["mesh"].append(mesh)
            columns["first_vertex"].append(first_vertex)
            columns["first_face"].append(first_face)
            columns["first_sample"].append(sum(map(len, elevation)))
            columns["samples"].append(0 if part.elevation is None else len(part.elevation))
            if part.elevation is not None:
                elevation.append(part.elevation.ravel())
        shapes: Any = Shapes()
        for name, dtype in _COLUMNS.items():
            setattr(shapes, name, _array(columns[name], dtype, device))
        shapes.first_part = _array(np.cumsum([0, *map(len, bodies)]), wp.int32, device)
        shapes.ball = _array([object_radius(body) for body in bodies], wp.float64, device)
        shapes.vertices = _array(np.concatenate([np.zeros((0, 3)), *self._vertices]), wp.vec3d, device)
        shapes.faces = _array(np.concatenate([np.zeros((0, 3), np.int32), *self._faces]), wp.vec3i, device)
        shapes.elevation = _array(np.concatenate([np.zeros(0), *elevation]), wp.float64, device)
        self.struct = shapes

    def _triangles(self, part: Part, centre: np.ndarray) -> tuple[int, int, int]:
        """Identifier of the part's mesh, its first vertex and its first face; of a primitive 0."""
        if part.vertices is None or part.faces is None:
            return 0, 0, 0
        key = id(part.vertices), id(part.faces)
        if key not in self._meshes:
            # In float32, about the centre, so that the digits are those of the part and not of its place.
            points = _array((part.vertices - centre).astype(np.float32), wp.vec3, self._device)
            faces = part.faces if len(part.faces) else np.zeros((1, 3), int)  # of a relief that rises nowhere
            mesh = wp.Mesh(points, _array(faces.ravel(), wp.int32, self._device))
            self._meshes[key] = mesh, sum(map(len, self._vertices)), sum(map(len, self._faces))
            self._vertices.append(part.vertices)
            self._faces.append(faces)
        mesh, first_vertex, first_face = self._meshes[key]
        return int(mesh.id), first_vertex, first_face


_UNKNOWN = 0.8e-3
"""Meshes and reliefs are not given up before nodes of half this spacing [m]."""

_COLUMNS = {
    "kind": wp.int32,
    "size": wp.vec3d,
    "rotation": wp.mat33d,
    "offset": wp.vec3d,
    "centre": wp.vec3d,
    "half": wp.vec3d,
    "radius": wp.float64,
    "width": wp.float64,
    "blunt": wp.float64,
    "max_slope": wp.float64,
    "mesh": wp.uint64,
    "first_vertex": wp.int32,
    "first_face": wp.int32,
    "first_sample": wp.int32,
    "samples": wp.int32,
}


_LEAST_MEMORY = 32768
"""Nodes that a window may have at least: finest grid of a 0.1 mm blade across the pad."""


class PadArrays:
    """Pads with grids of several pitches."""

    def __init__(self, gelpads: Sequence[GelpadSpec], pitches: Sequence[float], last: int, device: wp.Device) -> None:
        """``last``: the grid that gives the highest node of the gel."""
        shape = len(gelpads), len(pitches)
        nx, ny, first_x, first_y = (np.zeros(shape, np.int32) for _ in range(4))
        cell = np.zeros(shape)
        lines: list[np.ndarray] = []
        highest = np.zeros(len(gelpads))
        for p, gelpad in enumerate(gelpads):
            highest[p] = make_grid(gelpad, pitches[last]).rest.max()
            for k, pitch in enumerate(pitches):
                x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / pitch) + 1) for size in gelpad.size)
                cell[p, k] = (x[1] - x[0]) * (y[1] - y[0])
                separable = gelpad.surface is None
                for first, count, line, rest in (
                    (first_x, nx, x, -gelpad.sag(x, 0.0) if separable else 0.0 * x),
                    (first_y, ny, y, -gelpad.sag(0.0, y) if separable else 0.0 * y),
                ):
                    first[p, k], count[p, k] = sum(map(len, lines)), len(line)
                    lines.append(np.stack([line, rest, np.gradient(rest, line)], axis=1))
        self.most_nodes = int((nx[:, last] * ny[:, last]).max(initial=_LEAST_MEMORY))
        """Nodes that a window may have."""
        self.most_around = self.most_nodes + int((nx + ny).max(initial=0)) + 1
        """The same with one line more along x and y."""
        pads: Any = Pads()
        pads.half = _array([[0.5 * size for size in gelpad.size] for gelpad in gelpads], wp.vec2d, device)
        pads.thickness = _array([gelpad.thickness for gelpad in gelpads], wp.float64, device)
        pads.highest = _array(highest, wp.float64, device)
        pads.pitch = _array(pitches, wp.float64, device)
        pads.nx, pads.ny = wp.array(nx, dtype=wp.int32, device=device), wp.array(ny, dtype=wp.int32, device=device)
        pads.first_x = wp.array(first_x, dtype=wp.int32, device=device)
        pads.first_y = wp.array(first_y, dtype=wp.int32, device=device)
        pads.cell = wp.array(cell, dtype=wp.float64, device=device)
        pads.lines = _array(np.concatenate(lines), wp.vec3d, device)
        pads.maps = rest_maps(gelpads, device)
        pads.law = wp.array(np.array([_law(gelpad) for gelpad in gelpads]), dtype=wp.float64, device=device)
        self.struct = pads


def _law(gelpad: GelpadSpec) -> np.ndarray:
    """Constants of ``law_kernels``: 2 E*, radius of the widest contact, entries."""
    layer = layer_response(gelpad)
    entries = np.stack([layer.stiffening, layer.moment, layer.bend], axis=1).ravel()
    return np.concatenate([[2.0 * reduced_modulus(gelpad), layer.radius[-1]], entries])


def _array(values: Any, dtype: Any, device: wp.Device) -> wp.array:
    return wp.array(np.asarray(values), dtype=dtype, device=device)


def _blunt(part: Part) -> float:
    """Least width [m] of tips and tubes; inf if convex with edges of 90° or blunter."""
    if part.kind == "cone":
        return 0.0  # its base's rim is sharp
    if part.kind == "ellipsoid":
        return 2.0 * min(part.size) ** 2 / max(part.size)
    if part.kind == "torus":
        return 2.0 * part.size[1]
    return np.inf if part.vertices is None else _UNKNOWN


def _ball_and_box(part: Part) -> tuple[np.ndarray, np.ndarray, float]:
    """Box around a part, part frame: centre, half edges, radius of a ball about it [m]."""
    if part.kind == "plane":
        return np.zeros(3), np.full(3, np.inf), np.inf
    if part.vertices is not None:
        low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
        centre = 0.5 * (low + high)
        return centre, 0.5 * (high - low), (1.0 + 1e-6) * float(np.linalg.norm(part.vertices - centre, axis=1).max())
    low, high = bounds(part.kind, part.size, np.eye(4))
    centre = 0.5 * (low + high)
    if part.kind == "cone":
        return centre, 0.5 * (high - low), float(np.linalg.norm(0.5 * (high - low)))
    return centre, 0.5 * (high - low), radius_about_origin(part.kind, part.size)
