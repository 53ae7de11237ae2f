"""``Player``: the one thread that runs a session, commanded by any number of others."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace

from raytac.errors import InputError, RaytacError
from raytac.view.session import Session, Snapshot

_FASTEST = 1.0 / 30.0
"""Least time between two states while playing [s]; spares slow lines."""
_SMOOTH = 0.8
"""Share of the old value in the smoothed frame rate."""


@dataclass(frozen=True)
class Status:
    """State of the player."""

    mode: str = "starting"
    """``starting``, ``loading``, ``paused``, ``playing``, ``driving`` or ``stopped``."""
    states_per_s: float = 0.0
    """States computed, imaged and handed out a second, smoothed; 0 when nothing moves."""
    count: int = 0
    """States since the last reset."""
    error: str = ""
    """Why the last command ended; empty if it did not fail. The next command clears it."""


class Player:
    """Runs a session in a thread of its own and hands every new state to ``show``.

    Commands return at once and may come from any thread, as often as they like: of many targets for a control that arrive while a state
    is computed only the last one is driven to. Errors are reported in ``Status.error``; the thread lives on.

    .. code-block:: python

        player = Player(session, show)
        player.start()
        player.play()
        player.drive("depth", 0.5)
        player.close()
    """

    def __init__(self, session: Session, show: Callable[[Snapshot | None, Status], None]) -> None:
        """``show(snapshot, status)`` is called in the player's thread; None: only status changed."""
        self._session, self._show = session, show
        self._wakeup = threading.Condition()
        self._targets: dict[str, float] = {}
        self._orders: list[str] = ["show"]
        """``show``, ``play``, ``pause``, ``step``, ``reset``, ``load`` in the order they came."""
        self._make: Callable[[], Session] | None = None
        """Make the session that the next ``load`` takes."""
        self._is_closing = False
        self._status = Status()
        self._thread = threading.Thread(target=self._work, name="raytac-view-player", daemon=True)

    @property
    def status(self) -> Status:
        return self._status

    @property
    def session(self) -> Session:
        """The session that is shown now."""
        return self._session

    def start(self) -> None:
        """Begin: the first state is shown, nothing moves."""
        self._thread.start()

    def close(self, patience: float | None = None) -> bool:
        """End after the state that is computed; True if within ``patience`` [s] (None: any time)."""
        with self._wakeup:
            self._is_closing = True
            self._wakeup.notify()
        if self._thread.is_alive():
            self._thread.join(patience)
        return not self._thread.is_alive()

    def play(self) -> None:
        self._order("play")

    def pause(self) -> None:
        self._order("pause")

    def step(self) -> None:
        """One state further, then pause."""
        self._order("step")

    def reset(self) -> None:
        """Back to the start, paused."""
        self._order("reset")

    def load(self, make: Callable[[], Session]) -> None:
        """Show the session that ``make`` returns; if that fails, the present one stays as it is."""
        with self._wakeup:
            self._targets.clear()
            self._make = make
            self._orders = ["load"]  # what was asked of the present session is void
            self._wakeup.notify()

    def drive(self, name: str, value: float) -> None:
        """Take a control to ``value``. Raises ``InputError`` for an unknown control."""
        names = tuple(control.name for control in self._session.controls)
        if name not in names:
            raise InputError("name", value=name, rule="must be a control of the session", choices=names)
        with self._wakeup:
            self._targets.pop(name, None)  # the latest goes last: of two that exclude each other it wins
            self._targets[name] = float(value)
            self._wakeup.notify()

    def _order(self, order: str) -> None:
        with self._wakeup:
            if order == "reset":  # what was asked before is void
                self._orders.clear()
                self._targets.clear()
            self._orders.append(order)
            self._wakeup.notify()

    def _work(self) -> None:
        while True:
            with self._wakeup:
                while not (self._is_closing or self._orders or self._targets or self._status.mode in ("playing", "driving")):
                    self._wakeup.wait()
                if self._is_closing:
                    self._status = replace(self._status, mode="stopped", states_per_s=0.0)
                    return
                order = self._orders.pop(0) if self._orders else ""
                targets = {} if order else self._targets
                if targets:
                    self._targets = {}
            began = time.perf_counter()
            try:
                snapshot = self._obey(order, targets)
            except Exception as error:
                self._fail(error)
                continue
            self._tell(snapshot, began)

    def _obey(self, order: str, targets: dict[str, float]) -> Snapshot | None:
        """Do one thing; returns what there is to show, None if nothing moved."""
        session, mode = self._session, self._status.mode
        if order == "pause":
            self._become("paused")
            return None
        if order == "reset":
            session.reset()
            self._become("paused", count=0)
            return session.snapshot()
        if order == "show":
            self._become("paused")
            return session.snapshot()
        if order == "load":
            return self._exchange()
        if order in ("play", "step"):
            session.resume()
            self._become("playing" if order == "play" else "paused")
        elif targets:
            session.drive(targets)
            if session.is_driven_at_rest:
                self._become("driving")
            else:
                self._become(mode)
                if mode != "playing":
                    return None
        if session.advance():
            self._status = replace(self._status, count=self._status.count + 1)
            return session.snapshot()
        self._become("paused")
        return None

    def _exchange(self) -> Snapshot:
        """The first state of another session, which is taken only if it has one."""
        assert self._make is not None
        self._become("loading")
        self._show(None, self._status)
        session = self._make()
        snapshot = session.snapshot()
        self._session = session
        self._become("paused", count=0)
        return snapshot

    def _become(self, mode: str, **changes: int) -> None:
        is_moving = mode in ("playing", "driving")
        rate = self._status.states_per_s if is_moving else 0.0
        self._status = replace(self._status, mode=mode, error="", states_per_s=rate, **changes)

    def _tell(self, snapshot: Snapshot | None, began: float) -> None:
        if snapshot is not None and self._status.mode in ("playing", "driving"):
            rest = _FASTEST - (time.perf_counter() - began)
            if rest > 0.0:
                time.sleep(rest)
            rate, old = 1.0 / (time.perf_counter() - began), self._status.states_per_s
            self._status = replace(self._status, states_per_s=_SMOOTH * old + (1.0 - _SMOOTH) * rate if old else rate)
        try:
            self._show(snapshot, self._status)
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Stop moving and say why; a fault of ours is also printed in full."""
        text = str(error)
        if not isinstance(error, RaytacError):
            text = f"{type(error).__name__}: {error}"
            traceback.print_exception(error)
        self._status = replace(self._status, mode="paused", states_per_s=0.0, error=text)
        try:
            self._show(None, self._status)
        except Exception as second:
            traceback.print_exception(second)
