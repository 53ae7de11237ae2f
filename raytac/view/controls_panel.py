"""Sliders of a session's controls, and the handle in the 3-D view, in step with each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.errors import InputError
from raytac.se3 import quaternion, rotation_of
from raytac.view.player import Player
from raytac.view.session import Control, HandlePlace, Session, Snapshot

if TYPE_CHECKING:
    from viser import GuiEvent, GuiSliderHandle, TransformControlsEvent, TransformControlsHandle, ViserServer

_HANDLE = "/handle"
_SIZE = 0.12
"""Of the handle, over the distance of the eye at the start."""


class ControlsPanel:
    """Sliders and handle of a session; ``remove`` takes them away."""

    def __init__(self, server: ViserServer, session: Session, player: Player, *, order: float) -> None:
        """Build them; what users move goes to ``player``. ``order`` is the place on the page."""
        self._session, self._player, self._scale = session, player, session.units_per_metre
        self._moved: set[str] = set()
        """Controls moved since the last play, step or reset: they stay where users put them."""
        self._sliders: dict[str, GuiSliderHandle[float]] = {}
        self._folder = server.gui.add_folder("Controls", order=order) if session.controls else None
        if self._folder is not None:
            with self._folder:
                for control in session.controls:
                    start = min(max(0.0, control.low), control.high)
                    hint = control.hint or None
                    slider = server.gui.add_slider(control.label, control.low, control.high, control.step, start, hint=hint)
                    self._sliders[control.name] = slider
                    self._follow(control, slider)
        self._begun: HandlePlace | None = None
        """Place of the handle when a user took hold of it; None while nobody does."""
        self._place: HandlePlace | None = None
        self._dragged: set[str] = set()
        """Controls that the present drag has moved: they follow it to its end."""
        self._is_wanted = True
        self._handles = self._make_handles(server)
        for handle in self._handles:
            handle.on_update(self._drag)

    def remove(self) -> None:
        """Take sliders and handle off the page."""
        if self._folder is not None:
            self._folder.remove()
        for handle in self._handles:
            handle.remove()
        self._sliders = {}

    def show_handle(self, wanted: bool) -> None:
        """Show the handle where there is one, or not."""
        self._is_wanted = wanted
        for handle in self._handles:
            handle.visible = wanted and self._place is not None

    def let_go(self) -> None:
        """Let sliders and handle show what is, instead of what users asked for."""
        self._moved.clear()
        self._begun = None

    def draw(self, snapshot: Snapshot) -> None:
        """Put sliders and handle to where a state has them."""
        for control in self._session.controls:
            slider, value = self._sliders[control.name], snapshot.controls.get(control.name)
            if (slider.min, slider.max) != (control.low, control.high):
                slider.min, slider.max = control.low, control.high
            if value is not None and np.isfinite(value) and control.name not in self._moved:
                self._set(control, value)
        self._place = snapshot.handle
        if self._begun is None:  # who holds the handle sees it where the hand is
            self._put_handles()

    def _put_handles(self) -> None:
        place = self._place
        for handle in self._handles:
            handle.visible = self._is_wanted and place is not None
            if place is not None:
                handle.position, handle.wxyz = self._scale * place.pose[:3, 3], quaternion(place.pose[:3, :3])

    def _make_handles(self, server: ViserServer) -> list[TransformControlsHandle]:
        """One handle, or arrows and one ring apart: viser has the rings of all axes or none."""
        session = self._session
        if session.handle is None:
            return []
        eye = np.asarray(session.camera.position) - session.camera.look_at
        size = _SIZE * self._scale * float(np.linalg.norm(eye))
        look = {"depth_test": False, "opacity": 0.8, "line_width": 3.0, "disable_sliders": True, "visible": False}
        turns = [bool(name) for name in session.handle.about]
        add = server.scene.add_transform_controls
        if all(turns) or not any(turns):
            return [add(_HANDLE, size, disable_rotations=not any(turns), **look)]
        axes = tuple(not turn for turn in turns)  # a ring needs the two others
        ring = add(f"{_HANDLE}_ring", 0.8 * size, disable_axes=True, active_axes=axes, **look)  # type: ignore[arg-type]
        return [add(_HANDLE, size, disable_rotations=True, **look), ring]

    def _set(self, control: Control, value: float) -> None:
        steps = round((min(max(value, control.low), control.high) - control.low) / control.step)
        self._sliders[control.name].value = round(min(control.low + steps * control.step, control.high), 9)

    def _follow(self, control: Control, slider: GuiSliderHandle[float]) -> None:
        def moved(event: GuiEvent[Any]) -> None:
            if event.client is not None:  # None: set by the page itself
                self._ask(control, slider.value)  # the value now: of many events the last one counts

        slider.on_update(moved)

    def _ask(self, control: Control, value: float) -> None:
        self._moved.discard(control.instead_of)
        self._moved.add(control.name)
        try:
            self._player.drive(control.name, value)
        except InputError:  # another session was chosen meanwhile
            self._moved.clear()

    async def _drag(self, event: TransformControlsEvent) -> None:  # a coroutine: these alone keep their order
        handle, static = event.target, self._session.handle
        if event.phase == "start" or (self._begun is None and event.phase == "update"):
            self._begun, self._dragged = self._place, set()
        if self._begun is None or static is None:
            return
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_of(np.asarray(handle.wxyz, float)), np.asarray(handle.position, float) / self._scale
        wanted = static.targets(self._begun, pose, self._session.controls, self._dragged)
        self._dragged |= wanted.keys()
        for control in self._session.controls:
            if control.name in wanted and control.name in self._sliders:
                self._set(control, wanted[control.name])
                self._ask(control, wanted[control.name])
        if event.phase == "end":
            self._begun = None
            self._put_handles()  # beyond the end of a slider: back to where the object can be
