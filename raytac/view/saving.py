"""Files that users of the page save: PNG, GIF, MP4 and recordings."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import RaytacError
from raytac.io.atomic import write_atomic
from raytac.io.films import check_mp4, gif_bytes, mp4_bytes
from raytac.view.pictures import FILM_HEIGHT, STILL_HEIGHT, HeightScale, film_picture, films_equal_size
from raytac.view.recording import recording_bytes
from raytac.view.session import Session, Snapshot

FORMATS = ("PNG", "GIF", "MP4", "Recording")
"""Kinds of files: PNG of the state that is shown, all others of every state kept."""
MOST_PICTURES = 240
"""Of a film; of more states some are left out evenly."""
_FILM_S, _FASTEST = 8.0, 20.0
"""Longest film [s] without simulated time, and most pictures a second."""
_GOOD, _BAD = "#1b6e3c", "#b3261e"

View = Callable[[Snapshot, int], np.ndarray | None]
"""The 3-D view of a state, so many pixels high, (H, W, 3), by the user's browser; or None."""


class Saver:
    """Writes files into one folder, one at a time, and hands them to the browser that asked."""

    def __init__(self, folder: str | Path) -> None:
        """Remember the folder; it is made when the first file is."""
        self.folder = Path(folder)
        self._busy = threading.Lock()

    def save(
        self,
        kind: str,
        session: Session,
        shown: Snapshot,
        states: Sequence[Snapshot],
        *,
        picture: str,
        arrows: bool,
        view: View,
        client: Any,
    ) -> tuple[str, str]:
        """Write one file and send it; what cannot be is said.

        Args:
            kind: one of ``FORMATS``.
            shown: the state of a PNG.
            states: those of all other files.
            picture, arrows: as of ``raytac.view.pictures.picture``.
            view: draws the 3-D view.
            client: browser that gets the file as a download.

        Returns:
            Text for the page and its colour.
        """
        if not self._busy.acquire(blocking=False):
            return "another file is being written: wait for it", _BAD
        try:
            chosen = [shown] if kind == "PNG" else list(states) or [shown]
            if kind == "Recording":
                data, suffix = recording_bytes(session, chosen), "npz"
            else:
                data, suffix = self._pictures(kind, chosen, picture, arrows, view), kind.lower()
            path = self._path(session.title, suffix)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, data)
            client.send_file_download(path.name, data, save_immediately=True)
            count = "1 state" if len(chosen) == 1 else f"{len(chosen)} states"
            return f"{path} ({count}, {len(data) / 1e6:.1f} MB)", _GOOD
        except (RaytacError, OSError) as error:
            return str(error), _BAD
        finally:
            self._busy.release()

    def _pictures(self, kind: str, states: list[Snapshot], picture: str, arrows: bool, view: View) -> bytes:
        from PIL import Image

        if kind == "MP4":
            check_mp4()
        if len(states) > MOST_PICTURES:
            states = [states[k] for k in np.linspace(0, len(states) - 1, MOST_PICTURES).round().astype(int)]
        heights = HeightScale()
        for state in states:
            for pad in state.pads.values():
                heights.include(pad)
        height = STILL_HEIGHT if kind == "PNG" else FILM_HEIGHT
        look = {"arrows": arrows, "heights": heights, "height": height}
        drawn = [film_picture(state, picture, view=view(state, height), **look) for state in states]
        if kind == "PNG":
            stream = io.BytesIO()
            Image.fromarray(drawn[0]).save(stream, "PNG")
            return stream.getvalue()
        sheets, rate = films_equal_size(drawn), _rate(states)
        return gif_bytes(sheets, rate) if kind == "GIF" else mp4_bytes(sheets, rate)

    def _path(self, title: str, suffix: str) -> Path:
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", title.split("·")[0].strip()).strip("-") or "view"
        stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
        path, number = self.folder / f"{stem}.{suffix}", 1
        while path.exists():
            number += 1
            path = self.folder / f"{stem}_{number}.{suffix}"
        return path


def _rate(states: Sequence[Snapshot]) -> float:
    """Pictures a second: at the speed of simulated time, as far as a film can show it."""
    first, last = states[0].time, states[-1].time
    if first is not None and last is not None and last > first:
        return min((len(states) - 1) / (last - first), _FASTEST)
    return min(max(len(states) / _FILM_S, 5.0), _FASTEST)
