"""The panel of the sensors: pictures, forces and their course over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.view.history import History
from raytac.view.pictures import ARROW_SCALE, HeightScale, enlarged, picture, pictures_of
from raytac.view.session import PadView, Session, Snapshot

if TYPE_CHECKING:
    from viser import GuiUplotHandle, ViserServer

_SIGNS = (
    "<p style='margin:0.4em 1em;font-size:0.75em'>Force and torque on the pad, in its frame, about its origin; z points out of the gel "
    "to the object, so what presses has F<sub>z</sub> &lt; 0.</p>"
)
_AXES = ("x", "y", "z")
_COLOURS = ("#d55e00", "#009e73", "#0072b2")
"""Of x, y and z: apart for all kinds of colour vision (M. Okabe and K. Ito)."""
_PLOTS = {"force [N]": ("F_x", "F_y", "F_z"), "markers [px]": ("mean", "greatest")}
"""Plots of a pad over time, and their curves."""
_MOST_POINTS = 600
"""Of a curve: what goes to the browser with every state."""


class SensorsPanel:
    """Everything on the page about a session's sensors; ``remove`` takes it away."""

    def __init__(self, server: ViserServer, session: Session, redraw: Callable[[], None]) -> None:
        """Build the panel, empty; ``redraw`` is called when users choose other pictures."""
        gui, self._session = server.gui, session
        self._server = server
        self.heights = HeightScale()
        self._images, self._wrenches = {}, {}
        self._plots: dict[tuple[str, str], GuiUplotHandle] = {}
        self._panel = gui.add_panel()
        self._tab = self._panel.add_tab("Sensors" if len(session.pads) > 1 else "Sensor")
        with self._tab:
            self._kind = gui.add_dropdown("picture", pictures_of({}), visible=False)
            self._range = gui.add_html("", visible=False)
            for pad in session.pads:
                blank = np.full((3, 4, 3), 230, np.uint8)
                self._images[pad.name] = gui.add_image(blank, label=pad.name, format="jpeg", jpeg_quality=92, visible=False)
                self._wrenches[pad.name] = gui.add_html("")
            self._arrows = gui.add_checkbox(
                f"arrows × {ARROW_SCALE:g}", True, visible=False, hint="Where the markers went, so many times as long"
            )
            self._signs = gui.add_html(_SIGNS, visible=False)
            self._over_time = gui.add_checkbox("plots", True, visible=False, hint="Force and markers over time")
        for element in (self._kind, self._arrows, self._over_time):
            element.on_update(lambda _: redraw())
        self._panel.dock_left()
        self._panel.set_width(380)

    def remove(self) -> None:
        """Take the panel off the page."""
        self._panel.remove()

    @property
    def kind(self) -> str:
        """Picture that is shown, one of ``PICTURES``."""
        return self._kind.value

    @property
    def arrows(self) -> bool:
        """True if markers are drawn over pictures."""
        return self._arrows.value

    def draw(self, snapshot: Snapshot, history: History) -> None:
        """Show one state, and the course of forces and markers up to the newest."""
        kinds = pictures_of(snapshot.pads)
        if kinds and kinds != self._kind.options:
            self._kind.options = kinds
        self._kind.visible = len(kinds) > 1
        for name, view in snapshot.pads.items():
            self.heights.include(view)
            image = picture(view, self.kind, arrows=self.arrows, heights=self.heights)
            if image is not None:
                self._images[name].image = enlarged(image)
                self._images[name].visible = True
            self._wrenches[name].content = _wrench_html(view)
        self._range.visible = self.kind == "height" and bool(kinds)
        if self._range.visible:
            self._range.content = f"<p style='margin:0 1em;font-size:0.75em'>{self.heights.label}</p>"
        self._arrows.visible = any(view.markers_px is not None for view in snapshot.pads.values())
        self._signs.visible = any(view.wrench is not None for view in snapshot.pads.values())
        self._draw_plots(history)

    def _draw_plots(self, history: History) -> None:
        stride = -(-len(history) // _MOST_POINTS)
        x = history.x[::stride] if len(history) else np.zeros(0)
        self._over_time.visible = len(history) > 1
        for pad in (pad.name for pad in self._session.pads):
            for name in _PLOTS:
                values = history.forces(pad) if name == "force [N]" else history.displacements(pad)
                is_shown = self._over_time.value and len(x) > 1 and bool(np.isfinite(values).any())
                if is_shown:
                    self._plot(pad, name, history.x_label).data = (x, *(curve[::stride].copy() for curve in values))
                if (pad, name) in self._plots:
                    self._plots[pad, name].visible = is_shown

    def _plot(self, pad: str, name: str, x_label: str) -> GuiUplotHandle:
        """The plot of a pad, made when there is something to show."""
        if (pad, name) not in self._plots:
            with self._tab:
                self._plots[pad, name] = self._empty_plot(f"{pad}: {name}", _PLOTS[name], x_label)
        return self._plots[pad, name]

    def _empty_plot(self, title: str, curves: tuple[str, ...], x_label: str) -> GuiUplotHandle:
        series: list[Any] = [{"label": x_label}]
        series += [
            {"label": curve, "stroke": colour, "width": 2, "points": {"show": False}}
            for curve, colour in zip(curves, _COLOURS[-len(curves) :], strict=True)
        ]
        empty = tuple(np.array([0.0, 1.0]) for _ in series)
        scales: Any = {"x": {"time": False}}
        return self._server.gui.add_uplot(empty, tuple(series), title=title, scales=scales, aspect=1.9, padding=(14, 14, 0, 0))


def _wrench_html(view: PadView) -> str:
    if view.wrench is None or not np.isfinite(view.wrench).all():
        return ""
    force = [
        (f"F<sub>{axis}</sub>", f"{round(value, 3) + 0.0:+.3f} N") for axis, value in zip(_AXES, view.wrench[:3], strict=True)
    ]
    torque = [
        (f"T<sub>{axis}</sub>", f"{round(1e3 * value, 2) + 0.0:+.2f} N mm")
        for axis, value in zip(_AXES, view.wrench[3:], strict=True)
    ]
    rows = "".join(
        f"<tr><td>{a}</td><td style='{RIGHT}'>{b}</td><td style='padding-left:1.5em'>{c}</td><td style='{RIGHT}'>{d}</td></tr>"
        for (a, b), (c, d) in zip(force, torque, strict=True)
    )
    return f"<table style='{TABLE}'>{rows}</table>"


TABLE = "font-size:0.85em;margin:0 1em;font-variant-numeric:tabular-nums;border-spacing:0.4em 0.1em"
RIGHT = "text-align:right"
"""Styles of the page's tables."""
