"""What the page takes from a browser: where its camera is, and what a user set an element to. Everything else is refused."""

from __future__ import annotations

from collections.abc import Callable
from math import dist, hypot, isfinite
from typing import Annotated, Any

import msgspec

__all__ = ["LARGEST", "BadMessage", "checked_message", "one_line"]

LARGEST = 2**16
"""Longest message that is taken [bytes]; a camera takes 300."""
_Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""Of a camera; not NaN. The 3-D view is some units large, whatever it shows."""
_Vector = tuple[_Number, _Number, _Number]


class BadMessage(ValueError):
    """A message that no browser with this page sends."""


class _Camera(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Fields as of viser's message of that name."""

    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: Annotated[float, msgspec.Meta(ge=0, le=1e6)]
    image_width: Annotated[float, msgspec.Meta(ge=0, le=1e6)]
    look_at: _Vector
    up_direction: _Vector

    def __post_init__(self) -> None:
        if dist(self.position, self.look_at) < 1e-6 or hypot(*self.up_direction) < 1e-6:
            raise ValueError("a camera must look somewhere and have an up direction")


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of an element that a user sets; viser would let a browser set any."""

    value: bool | float | str


class _Update(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: str
    updates: _Value


_DECODER = msgspec.msgpack.Decoder(_Camera | _Update)


def checked_message(raw: bytes | str, element: Callable[[str], Any]) -> bytes:
    """The same message encoded again, from nothing but what was understood of it.

    Args:
        raw: as it came.
        element: the element of a uuid, with its ``value``, and ``options`` or ``min`` and ``max`` if these say what it can be; None if
            there is none (any more), which viser does not mind.

    Raises:
        BadMessage: no MessagePack, of another type, or not what its type or its element takes.
    """
    if isinstance(raw, str):
        raise BadMessage("text instead of MessagePack")
    try:
        message = _DECODER.decode(raw)
    except msgspec.DecodeError as error:
        raise BadMessage(one_line(str(error))) from error
    if isinstance(message, _Update):
        target, value = element(message.uuid), message.updates.value
        if target is not None and not _fits(target, value):
            raise BadMessage(f"{str(value)[:40]!r} is no value of this element")
    return msgspec.msgpack.encode(message)


def one_line(text: str) -> str:
    """The start of a text that may quote anything, without line breaks and whatever else commands a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:120])


def _fits(target: Any, value: bool | float | str) -> bool:
    options = getattr(target, "options", None)
    if options is not None:
        return value in options
    if isinstance(target.value, bool) or isinstance(value, bool):
        return isinstance(target.value, bool) and isinstance(value, bool)
    if isinstance(target.value, str) or isinstance(value, str) or not isfinite(value):
        return False
    low, high = getattr(target, "min", value), getattr(target, "max", value)
    slack = 1e-6 * (high - low)  # a slider's value is a sum of steps
    return low - slack <= value <= high + slack
