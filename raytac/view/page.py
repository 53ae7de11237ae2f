"""The page around the 3-D view: it forwards users' actions and draws the player's reports."""

from __future__ import annotations

import html
import threading
import time
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.view.controls_panel import ControlsPanel
from raytac.view.history import History
from raytac.view.player import Player, Status
from raytac.view.recording import has_timeline
from raytac.view.saving import FORMATS, Saver
from raytac.view.scene_view import ColourScale, SceneView, legend_html
from raytac.view.sensors_panel import RIGHT, TABLE, SensorsPanel
from raytac.view.session import QUANTITIES, Session, SessionMenu, Snapshot

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent, ViserServer

_MODES = {
    "starting": "computing the first image …",
    "loading": "loading what was chosen …",
    "paused": "paused",
    "playing": "playing",
    "driving": "moving to the sliders' values",
    "stopped": "stopped: the program that served this page has ended",
}
_COMMANDS = ("Play", "Pause", "Step", "Reset")
_VIEW_PATIENCE, _DECODING = 20.0, 0.1
"""Longest wait for a browser's 3-D view, and for the coats in it [s]."""
_ALL = "all"
"""Button that takes the eye back to where it began."""
_ORDER = {
    name: float(place)
    for place, name in enumerate(
        ("title", "status", "transport", "error", "warning", "timeline", "menu", "controls", "coat", "look", "save", "facts")
    )
}
"""Places of the main panel's elements, from above: some come and go with the session."""


class Page:
    """All that the browsers show; ``show`` is for the player, the rest reacts to users."""

    def __init__(
        self, server: ViserServer, session: Session, *, menu: SessionMenu | None = None, saver: Saver | None = None
    ) -> None:
        """Build the page; it stays still until ``attach`` ties it to a player.

        Args:
            menu: drop-downs that exchange the session; None is none.
            saver: writes what users save; None leaves the buttons out.
        """
        self._server, self._menu, self._saver = server, menu, saver
        self._drawing = threading.RLock()
        """One thread draws at a time: the player's, or that of a user who changed what is shown."""
        self._last: Snapshot | None = None
        self._past: int | None = None
        """Place in the history that is looked at; None is the present."""
        self._history = History()
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(33, 88, 107))
        self._build_main(session)

    def attach(self, player: Player) -> None:
        """Let users command ``player``, and show its session."""
        self._player = player
        self._open(player.session)
        acts = dict(zip(_COMMANDS, (player.play, player.pause, player.step, player.reset), strict=True))

        def command(event: GuiEvent[Any]) -> None:
            if event.target.value != "Pause":
                self._controls.let_go()
            if event.target.value == "Reset":
                self._forget()
            acts[event.target.value]()

        self._transport.on_click(command)
        self._timeline.on_update(self._look_back)
        for label, choice in self._choices.items():
            choice.on_update(lambda event, label=label: self._choose(event, label))

    def show(self, snapshot: Snapshot | None, status: Status) -> None:
        """Draw a new state, or only what the player does where ``snapshot`` is None."""
        with self._drawing, self._server.atomic():
            if self._player.session is not self._session:
                self._chosen = self._wanted
                self._close()
                self._open(self._player.session)
            if snapshot is not None:
                self._last, self._past = snapshot, None
                self._history.add(status.count, snapshot)
                self._draw(snapshot)
                self._place_timeline()
            if status.error:
                self._controls.let_go()
            rate = f", {status.states_per_s:.1f} states/s" if status.states_per_s else ""
            self._status.content = f"**{_MODES[status.mode]}**{rate}"
            self._complain(status.error)
            if status.mode != "loading":
                for label, choice in self._choices.items():
                    choice.value = self._chosen[label]
                    choice.disabled = False
            if self._last is not None and self._past is None:
                self._controls.draw(self._last)

    def _complain(self, text: str) -> None:
        self._error.visible = bool(text)
        self._error.content = _boxed(text, "#b3261e")

    # --- what is there whatever is shown ----------------------------------------------------------------------------------------

    def _build_main(self, session: Session) -> None:
        gui = self._server.gui
        gui.set_panel_label("raytac view")
        self._title = gui.add_markdown(session.title, order=_ORDER["title"])
        self._status = gui.add_markdown(f"**{_MODES['starting']}**", order=_ORDER["status"])
        self._transport = gui.add_button_group("", _COMMANDS, order=_ORDER["transport"])
        self._error = gui.add_html("", visible=False, order=_ORDER["error"])
        self._warning = gui.add_html("", visible=False, order=_ORDER["warning"])
        hint = "Look back at states that were shown; Play goes on from the present"
        self._timeline = gui.add_slider("timeline", 0, 1, 1, 0, visible=False, order=_ORDER["timeline"], hint=hint)
        self._choices = {}
        self._chosen = self._wanted = {} if self._menu is None else dict(self._menu.chosen)
        if self._menu is not None:
            with gui.add_folder("Scene", order=_ORDER["menu"]):
                for label, options in self._menu.options.items():
                    self._choices[label] = gui.add_dropdown(label, options, initial_value=self._chosen[label])
        if self._saver is not None:
            hint = f"Into {self._saver.folder}, and as a download; all but PNG: every state of the timeline"
            save = gui.add_button_group("save", FORMATS, hint=hint, order=_ORDER["save"])
            save.on_click(self._save)
            hint = "In what is saved, from where you look; it takes seconds a picture in a browser without a graphics card"
            self._with_view = gui.add_checkbox("save 3-D view", True, hint=hint, order=_ORDER["save"] + 0.2)
            self._saved = gui.add_html("", visible=False, order=_ORDER["save"] + 0.5)
        self._facts = gui.add_html("", order=_ORDER["facts"])
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)

    # --- what comes and goes with a session -------------------------------------------------------------------------------------

    def _open(self, session: Session) -> None:
        gui, self._session = self._server.gui, session
        self._title.content = session.title
        names = [name for name in QUANTITIES if any(name in pad.quantities for pad in session.pads)]
        self._scales = {name: ColourScale(QUANTITIES[name]) for name in names}
        self._labels = {QUANTITIES[name].label: name for name in names}
        self._view = SceneView(self._server, session)
        self._sensors = SensorsPanel(self._server, session, self._redraw)
        self._controls = ControlsPanel(self._server, session, self._player, order=_ORDER["controls"])
        self._coat = gui.add_folder("Coat", order=_ORDER["coat"])
        with self._coat:
            self._quantity = gui.add_dropdown("colour", tuple(self._labels))
            self._legend = gui.add_html("")
            hint = "Let the coat be seen through objects"
            self._see_through = gui.add_checkbox("see through", True, visible=self._view.has_hiding, hint=hint)
            hint = "Arrows and rings that move the object or the robot"
            self._with_handle = gui.add_checkbox("handle", True, visible=session.handle is not None, hint=hint)
        self._view.see_through(True)
        self._look = gui.add_button_group("look at", (_ALL, *(pad.name for pad in session.pads)), order=_ORDER["look"])
        self._look.on_click(self._look_at)
        self._quantity.on_update(lambda _: self._redraw())
        self._see_through.on_update(lambda _: self._view.see_through(self._see_through.value))
        self._with_handle.on_update(lambda _: self._controls.show_handle(self._with_handle.value))
        self._forget()

    def _close(self) -> None:
        for part in (self._view, self._sensors, self._controls, self._coat, self._look):
            part.remove()
        self._last = None

    def _forget(self) -> None:
        """Begin scales and timeline again, and leave out what was said of a saved file."""
        with self._drawing:
            if self._saver is not None:
                self._saved.visible = False
            for scale in self._scales.values():
                scale.reset()
            self._sensors.heights.reset()
            self._history.clear()
            self._past = None

    # --- users ------------------------------------------------------------------------------------------------------------------

    def _choose(self, event: GuiEvent[Any], label: str) -> None:
        if event.client is None or self._menu is None:  # set by the page itself
            return
        self._wanted = wanted = {**self._chosen, label: event.target.value}
        for choice in self._choices.values():
            choice.disabled = True
        self._player.load(partial(self._menu.make, wanted))

    def _look_back(self, event: GuiEvent[Any]) -> None:
        if event.client is None:
            return
        self._player.pause()
        with self._drawing, self._server.atomic():
            place = min(int(self._timeline.value), len(self._history) - 1)
            if place >= 0:
                self._past = None if place == len(self._history) - 1 else place
                self._draw(self._history[place])
                self._controls.draw(self._history[place])

    def _look_at(self, event: GuiEvent[Any]) -> None:
        if event.client is not None and self._last is not None:
            self._view.look(event.client, self._last.pads.get(event.target.value))

    def _save(self, event: GuiEvent[Any]) -> None:
        if event.client is None or self._last is None or self._saver is None:
            return
        with self._drawing:
            shown = self._last if self._past is None else self._history[self._past]
            states, look = list(self._history), {"picture": self._sensors.kind, "arrows": self._sensors.arrows}
        self._saved.visible, self._saved.content = True, _boxed("writing …", "#21586b")
        view, session = partial(self._rendered, event.client), self._session
        text, colour = self._saver.save(event.target.value, session, shown, states, view=view, client=event.client, **look)
        self._saved.content = _boxed(text, colour)
        self._controls.show_handle(self._with_handle.value)
        self._redraw()

    def _rendered(self, client: ClientHandle, snapshot: Snapshot, height: int) -> np.ndarray | None:
        """The 3-D view of a state as a browser sees it, (H, W, 3); None if it does not answer."""
        if not self._with_view.value:
            return None
        with self._drawing:
            with self._server.atomic():
                self._controls.show_handle(False)
                self._view.draw(snapshot, self._scales, self._labels[self._quantity.value])
            self._server.flush()
            time.sleep(_DECODING)
            try:
                return client.get_render(height, height * 4 // 3, timeout=_VIEW_PATIENCE)
            except (TimeoutError, RuntimeError):
                return None

    # --- drawing ----------------------------------------------------------------------------------------------------------------

    def _place_timeline(self) -> None:
        count = len(self._history)
        self._timeline.visible = count > 1 and not has_timeline(self._session)
        if count > 1:
            self._timeline.max, self._timeline.value = count - 1, count - 1

    def _redraw(self) -> None:
        with self._drawing, self._server.atomic():
            if self._last is not None:
                self._draw(self._last if self._past is None else self._history[self._past])

    def _draw(self, snapshot: Snapshot) -> None:
        quantity = self._labels[self._quantity.value]
        for name, scale in self._scales.items():
            for view in snapshot.pads.values():
                if name in view.values:
                    scale.include(view.values[name])
        self._view.draw(snapshot, self._scales, quantity)
        self._legend.content = legend_html(self._scales[quantity])
        self._sensors.draw(snapshot, self._history)
        times = {f"{name}, time": f"{value:.1f} ms" for name, value in snapshot.time_ms.items()}
        past = {} if self._past is None else {"looking back": f"state {self._past + 1} of {len(self._history)}"}
        self._facts.content = _table({**past, **snapshot.facts, **times}.items())
        self._warning.visible = bool(snapshot.warning)
        self._warning.content = _boxed(snapshot.warning, "#8a5a00")


def _table(rows: Iterable[tuple[str, str]]) -> str:
    row = f"<tr><td>{{}}</td><td style='{RIGHT}'>{{}}</td></tr>"
    cells = "".join(row.format(html.escape(label), html.escape(value)) for label, value in rows)
    return f"<table style='{TABLE}'>{cells}</table>"


def _boxed(text: str, colour: str) -> str:
    style = f"margin:0 1em;padding:0.5em;font-size:0.85em;border-left:3px solid {colour};color:{colour}"
    return f"<div style='{style}'>{html.escape(text)}</div>"
