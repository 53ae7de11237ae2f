"""The 3-D half of the page: what a session hands out as meshes and lines of a viser server."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from raytac.robots.pose import quaternion
from raytac.view.colours import ColourScale
from raytac.view.glb import coloured_glb
from raytac.view.session import Session, Snapshot

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["SceneView"]

_FIELD_OF_VIEW = np.radians(38.0)
"""From top to bottom of the 3-D view [rad]: narrow, so that near edges are not blown up."""

_THIN = 0.35
"""Opacity of what pads are seen through."""


class SceneView:
    """Draws solids, lines and coats; one caller at a time."""

    def __init__(self, server: ViserServer, session: Session) -> None:
        """Put the session's solids and lines into the scene, unplaced, and the eye where the session wants it."""
        self._server, self._pads = server, {pad.name: pad for pad in session.pads}
        self._scale = session.units_per_metre
        scene, scale = server.scene, self._scale
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        server.initial_camera.position = scale * np.asarray(session.camera.position)
        server.initial_camera.look_at = scale * np.asarray(session.camera.look_at)
        server.initial_camera.fov = _FIELD_OF_VIEW
        self._solids = {
            solid.name: scene.add_mesh_simple(
                f"/solids/{solid.name}",
                scale * solid.vertices,
                solid.faces,
                color=solid.colour,
                opacity=_opacity(solid.opacity),
                flat_shading=True,
            )
            for solid in session.solids
        }
        self._lines = {
            lines.name: scene.add_line_segments(
                f"/lines/{lines.name}",
                _f32(scale * lines.segments),
                lines.colour,
                thickness=lines.width,
                thickness_units="screen",
            )
            for lines in session.lines
        }
        self._hiding = {solid.name: solid.opacity for solid in session.solids if solid.hides_pads}
        self._coats = {}

    @property
    def has_hiding(self) -> bool:
        """Whether there is anything that ``see_through`` changes."""
        return bool(self._hiding)

    def see_through(self, wanted: bool) -> None:
        """Let the pads be seen through what lies over them, or not."""
        for name, opacity in self._hiding.items():
            self._solids[name].opacity = min(opacity, _THIN) if wanted else _opacity(opacity)

    def draw(self, snapshot: Snapshot, scales: dict[str, ColourScale], quantity: str) -> None:
        """Place and colour everything; ``scales`` by quantity, ``quantity`` is the one that colours the coats."""
        with self._server.atomic():
            for name, pose in snapshot.poses.items():
                handle = self._solids.get(name) or self._lines.get(name)
                if handle is not None and np.isfinite(pose).all():
                    handle.position, handle.wxyz = self._scale * pose[:3, 3], quaternion(pose[:3, :3])
            for name, points in snapshot.reshaped.items():
                if name in self._solids:
                    self._solids[name].vertices = _f32(self._scale * points)
                elif name in self._lines:
                    self._lines[name].points = _f32(self._scale * points)
            for name, view in snapshot.pads.items():
                values = view.values[quantity if quantity in view.values else "indentation"]
                glb = coloured_glb(
                    self._scale * np.nan_to_num(view.vertices), self._pads[name].faces, scales[quantity].colours(values)
                )
                pose = view.world_from_pad
                if name in self._coats:
                    coat = self._coats[name]
                    coat.glb_data = glb
                    coat.position, coat.wxyz = self._scale * pose[:3, 3], quaternion(pose[:3, :3])
                else:
                    place = {"position": self._scale * pose[:3, 3], "wxyz": quaternion(pose[:3, :3])}
                    self._coats[name] = self._server.scene.add_glb(f"/coats/{name}", glb, **place)


def _opacity(opacity: float) -> float | None:
    """As viser has it: None is opaque."""
    return None if opacity >= 1.0 else opacity


def _f32(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float32)
