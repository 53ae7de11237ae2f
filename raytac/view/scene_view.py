"""The 3-D half of the page: what a session hands out as meshes and lines of a viser server."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from raytac.se3 import quaternion
from raytac.view.colours import ColourScale
from raytac.view.glb import coloured_glb
from raytac.view.session import PadView, Session, Snapshot
from raytac.view.smooth import split_creases

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

__all__ = ["SceneView"]

_FIELD_OF_VIEW = np.radians(38.0)
"""From top to bottom of the 3-D view [rad]: narrow, so that near edges are not blown up."""

_AMBIENT = 0.5
"""Light from everywhere beside viser's own from above, so that the colours of a coat that looks down are seen."""
_NEAR_A_PAD = (0.035, 0.06, 0.06)
"""Where an eye looks at a pad from, pad frame [m]: obliquely, from beyond the fingertips of a gripper."""
_THIN = 0.35
"""Opacity of what pads are seen through."""


class SceneView:
    """Draws solids, lines and coats; one caller at a time."""

    def __init__(self, server: ViserServer, session: Session) -> None:
        """Put the session's solids and lines into the scene, unplaced, and the eye where the session wants it."""
        self._session = session
        self._server, self._pads = server, {pad.name: pad for pad in session.pads}
        self._scale = session.units_per_metre
        scene, scale = server.scene, self._scale
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.add_light_ambient("/ambient", intensity=_AMBIENT)
        server.initial_camera.position = scale * np.asarray(session.camera.position)
        server.initial_camera.look_at = scale * np.asarray(session.camera.look_at)
        server.initial_camera.fov = _FIELD_OF_VIEW
        self._sources: dict[str, np.ndarray] = {}
        """Vertex of the session's mesh that each drawn one is, by name of solid."""
        self._solids = {}
        for solid in session.solids:
            source, faces = split_creases(solid.vertices, solid.faces)
            self._sources[solid.name] = source
            self._solids[solid.name] = scene.add_mesh_simple(
                f"/solids/{solid.name}",
                scale * solid.vertices[source],
                faces,
                color=solid.colour,
                opacity=_opacity(solid.opacity),
            )
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
        self._placed: dict[str, np.ndarray] = {}
        """Pose that each solid and line was drawn at last."""
        self._coats = {}

    def look(self, client: ClientHandle, view: PadView | None) -> None:
        """Take one client's eye to a pad, on the side that the pad looks to; None is back to the start."""
        if view is None:
            eye, target = (np.asarray(place) for place in (self._session.camera.position, self._session.camera.look_at))
        else:
            pose = view.world_from_pad
            eye, target = pose[:3, :3] @ np.asarray(_NEAR_A_PAD) + pose[:3, 3], pose[:3, 3]
        with client.atomic():
            client.camera.position, client.camera.look_at = self._scale * eye, self._scale * target

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
