"""The page around the 3-D view: it forwards users' actions and draws the player's reports."""

from __future__ import annotations

import html
import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.view.player import Player, Status
from raytac.view.scene_view import ColourScale, SceneView, legend_html
from raytac.view.session import QUANTITIES, Control, PadView, Session, Snapshot

if TYPE_CHECKING:
    from viser import GuiEvent, GuiSliderHandle, ViserServer

_MODES = {
    "starting": "computing the first image …",
    "paused": "paused",
    "playing": "playing",
    "driving": "on the way to the sliders",
    "stopped": "stopped: the program that served this page has ended",
}
_COMMANDS = ("Play", "Pause", "Step", "Reset")
_SIGNS = (
    "<p style='margin:0.4em 1em;font-size:0.75em'>Force and torque on the pad, in its frame, about its origin; z points out of the gel "
    "to the object, so what presses has F<sub>z</sub> &lt; 0.</p>"
)
_ALL = "all"
"""Button that takes the eye back to where it began."""
_AXES = ("x", "y", "z")


class Page:
    """All that the browsers show; ``show`` is for the player, the rest reacts to users."""

    def __init__(self, server: ViserServer, session: Session) -> None:
        """Build the page; it stays still until ``attach`` ties it to a player."""
        self._server, self._session = server, session
        self._drawing = threading.Lock()
        """One thread draws at a time: the player's, or that of a user who changed what is shown."""
        self._last: Snapshot | None = None
        self._moved: set[str] = set()
        """Controls moved since the last play, step or reset: they stay where users put them."""
        names = [name for name in QUANTITIES if any(name in pad.quantities for pad in session.pads)]
        self._scales = {name: ColourScale(QUANTITIES[name]) for name in names}
        self._labels = {QUANTITIES[name].label: name for name in names}
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(33, 88, 107))
        self._view = SceneView(server, session)
        self._build_main()
        self._build_sensors()

    def attach(self, player: Player) -> None:
        """Let users command ``player``."""
        acts = dict(zip(_COMMANDS, (player.play, player.pause, player.step, player.reset), strict=True))

        def command(event: GuiEvent[Any]) -> None:
            if event.target.value != "Pause":
                self._moved.clear()
            if event.target.value == "Reset":
                for scale in self._scales.values():
                    scale.reset()
            acts[event.target.value]()

        self._transport.on_click(command)
        for control in self._session.controls:
            self._follow_slider(player, control)

    def show(self, snapshot: Snapshot | None, status: Status) -> None:
        """Draw a new state, or only what the player does where ``snapshot`` is None."""
        with self._drawing, self._server.atomic():
            if snapshot is not None:
                self._last = snapshot
                self._draw(snapshot)
            if status.error:
                self._moved.clear()
            rate = f", {status.states_per_s:.1f} states/s" if status.states_per_s else ""
            self._status.content = f"**{_MODES[status.mode]}**{rate}"
            self._error.visible = bool(status.error)
            self._error.content = _boxed(status.error, "#b3261e")
            if self._last is not None:
                self._place_sliders(self._last)

    def _build_main(self) -> None:
        gui = self._server.gui
        gui.set_panel_label("raytac view")
        gui.add_markdown(self._session.title)
        self._status = gui.add_markdown(f"**{_MODES['starting']}**")
        self._transport = gui.add_button_group("", _COMMANDS)
        self._error = gui.add_html("", visible=False)
        self._warning = gui.add_html("", visible=False)
        self._sliders: dict[str, GuiSliderHandle[float]] = {}
        if self._session.controls:
            with gui.add_folder("Controls"):
                for control in self._session.controls:
                    start = min(max(0.0, control.low), control.high)
                    self._sliders[control.name] = gui.add_slider(
                        control.label, control.low, control.high, control.step, start, hint=control.hint or None
                    )
        with gui.add_folder("Coat"):
            self._quantity = gui.add_dropdown("colour", tuple(self._labels))
            self._legend = gui.add_html("")
            self._see_through = gui.add_checkbox(
                "see through", True, visible=self._view.has_hiding, hint="Let the coat be seen through objects"
            )
        self._view.see_through(True)
        self._look = gui.add_button_group("look at", (_ALL, *(pad.name for pad in self._session.pads)))
        self._look.on_click(self._look_at)
        self._quantity.on_update(lambda _: self._redraw())
        self._see_through.on_update(lambda _: self._view.see_through(self._see_through.value))
        self._facts = gui.add_html("")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)

    def _build_sensors(self) -> None:
        gui = self._server.gui
        self._images, self._wrenches = {}, {}
        panel = gui.add_panel()
        with panel.add_tab("Sensors" if len(self._session.pads) > 1 else "Sensor"):
            for pad in self._session.pads:
                blank = np.full((3, 4, 3), 230, np.uint8)
                self._images[pad.name] = gui.add_image(blank, label=pad.name, format="jpeg", jpeg_quality=92, visible=False)
                self._wrenches[pad.name] = gui.add_html("")
            self._arrows = gui.add_checkbox(
                f"arrows × {ARROW_SCALE:g}", True, visible=False, hint="Where the markers went, so many times as long"
            )
            self._signs = gui.add_html(_SIGNS, visible=False)
        self._arrows.on_update(lambda _: self._redraw())
        panel.dock_left()
        panel.set_width(380)

    def _follow_slider(self, player: Player, control: Control) -> None:
        slider = self._sliders[control.name]

        def moved(event: GuiEvent[Any]) -> None:
            if event.client is None:  # set by the page itself
                return
            self._moved.discard(control.instead_of)
            self._moved.add(control.name)
            player.drive(control.name, slider.value)  # the value now: of many events the last one counts

        slider.on_update(moved)

    def _look_at(self, event: GuiEvent[Any]) -> None:
        if event.client is not None and self._last is not None:
            self._view.look(event.client, self._last.pads.get(event.target.value))

    def _redraw(self) -> None:
        with self._drawing, self._server.atomic():
            if self._last is not None:
                self._draw(self._last)

    def _draw(self, snapshot: Snapshot) -> None:
        quantity = self._labels[self._quantity.value]
        for name, scale in self._scales.items():
            for view in snapshot.pads.values():
                if name in view.values:
                    scale.include(view.values[name])
        self._view.draw(snapshot, self._scales, quantity)
        self._legend.content = legend_html(self._scales[quantity])
        for name, view in snapshot.pads.items():
            image = picture(view, arrows=self._arrows.value)
            if image is not None:
                self._images[name].image = image
                self._images[name].visible = True
            self._wrenches[name].content = _wrench_html(view)
        self._arrows.visible = any(view.markers_px is not None for view in snapshot.pads.values())
        self._signs.visible = any(view.wrench is not None for view in snapshot.pads.values())
        times = {f"{name}, time": f"{value:.1f} ms" for name, value in snapshot.time_ms.items()}
        self._facts.content = _table({**snapshot.facts, **times}.items())
        self._warning.visible = bool(snapshot.warning)
        self._warning.content = _boxed(snapshot.warning, "#8a5a00")

    def _place_sliders(self, snapshot: Snapshot) -> None:
        for control in self._session.controls:
            slider, value = self._sliders[control.name], snapshot.controls.get(control.name)
            if (slider.min, slider.max) != (control.low, control.high):
                slider.min, slider.max = control.low, control.high
            if value is None or not np.isfinite(value) or control.name in self._moved:
                continue
            steps = round((min(max(value, control.low), control.high) - control.low) / control.step)
            slider.value = min(control.low + steps * control.step, control.high)


def _wrench_html(view: PadView) -> str:
    if view.wrench is None or not np.isfinite(view.wrench).all():
        return ""
    force = [(f"F<sub>{axis}</sub>", f"{value + 0.0:+.3f} N") for axis, value in zip(_AXES, view.wrench[:3], strict=True)]
    torque = [(f"T<sub>{axis}</sub>", f"{1e3 * value:+.2f} N mm") for axis, value in zip(_AXES, view.wrench[3:], strict=True)]
    rows = "".join(
        f"<tr><td>{a}</td><td style='{_RIGHT}'>{b}</td><td style='padding-left:1.5em'>{c}</td><td style='{_RIGHT}'>{d}</td></tr>"
        for (a, b), (c, d) in zip(force, torque, strict=True)
    )
    return f"<table style='{_TABLE}'>{rows}</table>"


_TABLE = "font-size:0.85em;margin:0 1em;font-variant-numeric:tabular-nums;border-spacing:0.4em 0.1em"
_RIGHT = "text-align:right"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    row = f"<tr><td>{{}}</td><td style='{_RIGHT}'>{{}}</td></tr>"
    cells = "".join(row.format(html.escape(label), html.escape(value)) for label, value in rows)
    return f"<table style='{_TABLE}'>{cells}</table>"


def _boxed(text: str, colour: str) -> str:
    style = f"margin:0 1em;padding:0.5em;font-size:0.85em;border-left:3px solid {colour};color:{colour}"
    return f"<div style='{style}'>{html.escape(text)}</div>"


ARROW_SCALE = 2.0
"""Length of a drawn arrow over the displacement, so that tenths of a pixel are seen."""
_LEAST_WIDTH = 480
"""Least width [px] to which images are enlarged, by a whole factor, for crisp arrows."""
_SHORTEST = 1.0
"""Arrows of fewer enlarged pixels are drawn as dots."""
_INK = (255, 220, 60)


def picture(pad: PadView, *, arrows: bool) -> np.ndarray | None:
    """8-bit image (H', W', 3) of a pad's sensor, or None; ``arrows``: of markers, over it."""
    if pad.rgb is None:
        return None
    factor = -(-_LEAST_WIDTH // pad.rgb.shape[1])
    if not arrows or pad.markers_px is None:
        return pad.rgb
    from PIL import Image, ImageDraw

    height, width = pad.rgb.shape[:2]
    image = Image.fromarray(pad.rgb).resize((factor * width, factor * height), Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(image)
    rest, moved = pad.markers_px
    starts, arrows_px = factor * rest, factor * ARROW_SCALE * moved
    for (x, y), (dx, dy) in zip(starts, arrows_px, strict=True):
        if not np.isfinite([x, y, dx, dy]).all():
            continue
        length = float(np.hypot(dx, dy))
        if length < _SHORTEST:
            draw.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=_INK)
            continue
        end = np.array([x + dx, y + dy])
        draw.line([(x, y), tuple(end.tolist())], fill=_INK, width=2)
        along, across = np.array([dx, dy]) / length, np.array([-dy, dx]) / length
        head = min(7.0, 0.5 * length)
        tip = [end, end - head * along + 0.45 * head * across, end - head * along - 0.45 * head * across]
        draw.polygon([tuple(point.tolist()) for point in tip], fill=_INK)
    return np.asarray(image)
