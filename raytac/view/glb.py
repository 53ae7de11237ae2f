"""A triangle mesh with a colour on every vertex as binary glTF 2.0, the only form in which the browser takes one."""

from __future__ import annotations

import json
import struct

import numpy as np

__all__ = ["coloured_glb", "vertex_normals"]

_FLOAT, _UINT, _UBYTE = 5126, 5125, 5121
_ARRAY, _ELEMENTS = 34962, 34963
_MATERIAL = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.85}, "doubleSided": True}


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3), float32: of the faces around each vertex, weighted by area; +z for a vertex without area."""
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
    heads = (
        struct.pack("<4sII", b"glTF", 2, total),
        struct.pack("<I4s", len(text), b"JSON"),
        struct.pack("<I4s", len(binary), b"BIN\0"),
    )
    return heads[0] + heads[1] + text + heads[2] + binary


def _linear_u8(colours: np.ndarray) -> np.ndarray:
    """8-bit linear values of 8-bit sRGB (IEC 61966-2-1)."""
    value = np.asarray(colours, float) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * linear).astype(np.uint8)
