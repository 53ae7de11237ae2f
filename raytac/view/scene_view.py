"""The 3-D half of the page: what a session hands out as meshes and lines of a viser server."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING

import numpy as np

from raytac.se3 import quaternion
from raytac.view.session import PadView, Quantity, Session, Snapshot, round_up

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

_FIELD_OF_VIEW = np.radians(38.0)
"""From top to bottom of the 3-D view [rad]: narrow, so that near edges are not blown up."""

_AMBIENT = 0.5
"""Ambient light beside viser's own from above, for the colours of a coat that looks down."""
_NEAR_A_PAD = (0.035, 0.06, 0.06)
"""Place of an eye that looks at a pad, pad frame [m]: oblique, beyond a gripper's fingers."""
_THIN = 0.35
"""Opacity of what pads are seen through."""


class SceneView:
    """Draws solids, lines and coats; one caller at a time."""

    def __init__(self, server: ViserServer, session: Session) -> None:
        """Put solids and lines into the scene, unplaced, and the eye where the session wants it."""
        self._session = session
        self._server, self._pads = server, {pad.name: pad for pad in session.pads}
        self._scale = session.units_per_metre
        scene, scale = server.scene, self._scale
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        self._light = scene.add_light_ambient("/ambient", intensity=_AMBIENT)
        server.initial_camera.position = scale * np.asarray(session.camera.position)
        server.initial_camera.look_at = scale * np.asarray(session.camera.look_at)
        server.initial_camera.fov = _FIELD_OF_VIEW
        self._sources: dict[str, np.ndarray] = {}
        """Vertex of the session's mesh that each drawn one is, by name of solid."""
        self._solids = {}
        for solid in session.solids:
            source, faces = split_creases(solid.vertices, solid.faces)
            self._sources[solid.name] = source
            look = {"color": solid.colour, "opacity": _opacity(solid.opacity)}
            vertices = scale * solid.vertices[source]
            self._solids[solid.name] = scene.add_mesh_simple(f"/solids/{solid.name}", vertices, faces, **look)
        self._lines = {}
        for lines in session.lines:
            look = {"thickness": lines.width, "thickness_units": "screen"}
            segments = _f32(scale * lines.segments)
            self._lines[lines.name] = scene.add_line_segments(f"/lines/{lines.name}", segments, lines.colour, **look)
        self._hiding = {solid.name: solid.opacity for solid in session.solids if solid.hides_pads}
        self._placed: dict[str, np.ndarray] = {}
        """Pose that each solid and line was drawn at last."""
        self._coats = {}

    def remove(self) -> None:
        """Take everything out of the scene."""
        for handle in (self._light, *self._solids.values(), *self._lines.values(), *self._coats.values()):
            handle.remove()

    def look(self, client: ClientHandle, view: PadView | None) -> None:
        """Take a client's eye to a pad, on the side that it looks to; None is back to the start."""
        if view is None:
            eye, target = (np.asarray(place) for place in (self._session.camera.position, self._session.camera.look_at))
        else:
            pose = view.world_from_pad
            eye, target = pose[:3, :3] @ np.asarray(_NEAR_A_PAD) + pose[:3, 3], pose[:3, 3]
        with client.atomic():
            client.camera.position, client.camera.look_at = self._scale * eye, self._scale * target

    @property
    def has_hiding(self) -> bool:
        """True if there is anything that ``see_through`` changes."""
        return bool(self._hiding)

    def see_through(self, transparent: bool) -> None:
        """Let the pads be seen through what lies over them, or not."""
        for name, opacity in self._hiding.items():
            self._solids[name].opacity = min(opacity, _THIN) if transparent else _opacity(opacity)

    def draw(self, snapshot: Snapshot, scales: dict[str, ColourScale], quantity: str) -> None:
        """Place and colour everything; ``quantity`` is that of ``scales`` which colours the coats."""
        with self._server.atomic():
            for name, pose in snapshot.poses.items():
                handle = self._solids.get(name) or self._lines.get(name)
                before = self._placed.get(name)
                if handle is None or not np.isfinite(pose).all() or (before is not None and np.array_equal(pose, before)):
                    continue
                self._placed[name] = pose.copy()
                handle.position, handle.wxyz = self._scale * pose[:3, 3], quaternion(pose[:3, :3])
            for name, points in snapshot.reshaped.items():
                if name in self._solids:
                    self._solids[name].vertices = _f32(self._scale * points[self._sources[name]])
                elif name in self._lines:
                    self._lines[name].points = _f32(self._scale * points)
            for name, handle in self._solids.items():
                if handle.visible == (name in snapshot.hidden):
                    handle.visible = name not in snapshot.hidden
            for name, view in snapshot.pads.items():
                values = view.values[quantity if quantity in view.values else "indentation"]
                vertices, colours = self._scale * np.nan_to_num(view.vertices), scales[quantity].colours(values)
                glb = coloured_glb(vertices, self._pads[name].faces, colours)
                position, wxyz = self._scale * view.world_from_pad[:3, 3], quaternion(view.world_from_pad[:3, :3])
                if name in self._coats:
                    coat = self._coats[name]
                    coat.glb_data, coat.position, coat.wxyz = glb, position, wxyz
                else:
                    self._coats[name] = self._server.scene.add_glb(f"/coats/{name}", glb, position=position, wxyz=wxyz)


def _opacity(opacity: float) -> float | None:
    """As viser has it: None is opaque."""
    return None if opacity >= 1.0 else opacity


def _f32(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float32)


_FLOAT, _UINT, _UBYTE = 5126, 5125, 5121
_ARRAY, _ELEMENTS = 34962, 34963
_MATERIAL = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.85}, "doubleSided": True}


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3), float32: area-weighted means of faces; +z for a vertex without area."""
    corner = vertices[faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    corners = faces.ravel()
    total = np.stack([np.bincount(corners, np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0.0, total / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0]).astype(np.float32)


def coloured_glb(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """The file's bytes.

    Args:
        vertices: shape (V, 3).
        faces: shape (F, 3), counter-clockwise from the side that normals point to; both sides are drawn.
        colours: 8-bit sRGB, shape (V, 3); glTF keeps vertex colours linear, so they are converted.
    """
    # glTF 2.0 swaps nothing here: its +y up is only a convention of viewers, and the page places the mesh as it is.
    positions = np.ascontiguousarray(vertices, np.float32)
    linear = np.full((len(vertices), 4), 255, np.uint8)
    linear[:, :3] = _linear_u8(colours)
    blocks = [
        (positions, "VEC3", _FLOAT, _ARRAY),
        (vertex_normals(positions, faces), "VEC3", _FLOAT, _ARRAY),
        (linear, "VEC4", _UBYTE, _ARRAY),
        (np.ascontiguousarray(faces, np.uint32).ravel(), "SCALAR", _UINT, _ELEMENTS),
    ]
    views, accessors, start = [], [], 0
    for array, kind, component, target in blocks:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": len(accessors), "componentType": component, "count": len(array), "type": kind})
        start += array.nbytes
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors[2]["normalized"] = True
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_MATERIAL],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(array.tobytes() for array, *_ in blocks)  # every block is a multiple of four bytes long
    total = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _linear_u8(colours: np.ndarray) -> np.ndarray:
    """8-bit linear values of 8-bit sRGB (IEC 61966-2-1)."""
    value = np.asarray(colours, float) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)


_SHARP = 35.0
"""Faces that meet at a larger angle than this [degrees] meet in an edge that is seen."""


def split_creases(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give both sides of every sharp edge vertices of their own, for normals by vertex.

    Args:
        vertices: shape (V, 3).
        faces: shape (F, 3), all of them turned alike.

    Returns:
        source: number of the old vertex of each new one, shape (W,); new vertices are ``vertices[source]``, now and when they move.
        faces: with the new numbers, shape (F, 3).
    """
    faces = np.asarray(faces)
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # Edge k of a face runs from corner k to the next one; its partner in the neighbour runs in the other direction.
    count = len(vertices)
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    order = np.argsort(start * count + end)
    keys = (start * count + end)[order]
    index = np.minimum(np.searchsorted(keys, end * count + start), len(keys) - 1)
    edge = np.flatnonzero(keys[index] == end * count + start)
    partner = order[index[edge]]
    face, other = edge // 3, partner // 3
    smooth = np.einsum("ij,ij->i", normal[face], normal[other]) >= np.cos(np.radians(_SHARP))
    edge, partner = edge[smooth], partner[smooth]
    # The start of an edge is the end of its partner: corners of one vertex that are joined across a smooth edge.
    after = 3 * (partner // 3) + (partner + 1) % 3
    group = _joined(len(start), edge, after)
    _, first, faces = np.unique(group, return_index=True, return_inverse=True)
    return start[first], faces.reshape(-1, 3)


def _joined(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Smallest number that each of ``count`` numbers is connected with through the pairs (a, b)."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[a], label[b])
        lowered = label.copy()
        np.minimum.at(lowered, a, least)
        np.minimum.at(lowered, b, least)
        lowered = lowered[lowered]  # a label's own label is as good: chains halve
        if (lowered == label).all():
            return label
        label = lowered


def _table() -> np.ndarray:
    """The colour map's 256 entries, 8-bit sRGB, (256, 3)."""
    from matplotlib import colormaps

    return np.rint(255.0 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)


class ColourScale:
    """Scale from 0 to a round number that is at least the greatest value since ``reset``."""

    def __init__(self, quantity: Quantity) -> None:
        self.quantity, self._table = quantity, _table()
        self.reset()

    def reset(self) -> None:
        """Begin again, at the least full scale of the quantity."""
        self.full = self.quantity.least

    def include(self, values: np.ndarray) -> None:
        """Let the scale reach the greatest of ``values`` (SI); what is not finite does not count."""
        greatest = float(np.max(values[np.isfinite(values)], initial=0.0)) * self.quantity.factor
        if greatest > self.full:
            self.full = round_up(greatest)

    def colours(self, values: np.ndarray) -> np.ndarray:
        """8-bit sRGB (V, 3) of SI values (V,): below 0 as 0; grey where not finite."""
        share = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0) * (self.quantity.factor / self.full)
        rgb = self._table[np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(int)]
        rgb[~np.isfinite(values)] = 128
        return rgb


def legend_html(scale: ColourScale) -> str:
    """The scale as a bar with its label and five figures."""
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in _table()[:: 255 // 15])
    figures = "".join(f"<span>{share * scale.full:.4g}</span>" for share in (0.0, 0.25, 0.5, 0.75, 1.0))
    return (
        f'<div style="padding:0 1em 0.4em;font-size:0.8em"><div>{scale.quantity.label}</div>'
        f'<div style="height:0.8em;border-radius:2px;background:linear-gradient(to right,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{figures}</div></div>'
    )
