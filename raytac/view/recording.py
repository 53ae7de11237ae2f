"""Recordings: states of a session in a file, and a session that plays them on a timeline."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from raytac.errors import InputError
from raytac.io import npz_bytes
from raytac.view.session import (
    CameraPlace,
    Control,
    Handle,
    HandlePlace,
    Lines,
    Pad,
    PadView,
    Session,
    Snapshot,
    Solid,
    check_targets,
)

_FORMAT = "raytac view recording 1"
_RECORDS = {kind.__name__: kind for kind in (CameraPlace, HandlePlace, Lines, Pad, PadView, Snapshot, Solid)}
"""Classes that a recording may hold, by name."""
_SMALL = 64
"""Arrays of at most so many numbers, as poses, keep their type; others become float32."""
_OWN = "timeline"
"""Control of a session that plays states; the page then needs no timeline beside it."""


@dataclass(frozen=True)
class Stage:
    """Parts of a session that are the same in all its states."""

    title: str
    units_per_metre: float
    camera: CameraPlace
    solids: tuple[Solid, ...]
    lines: tuple[Lines, ...]
    pads: tuple[Pad, ...]

    @classmethod
    def of(cls, session: Session) -> Stage:
        """Of any session."""
        return cls(**{field.name: getattr(session, field.name) for field in fields(cls)})


def has_timeline(session: Session) -> bool:
    """True if the session has a slider over its states."""
    return any(control.name == _OWN for control in session.controls)


class StatesSession:
    """Plays states that are known already, forwards or from wherever the timeline is put."""

    is_driven_at_rest = True
    handle: Handle | None = None

    def __init__(self, stage: Stage, states: Sequence[Snapshot], *, unit: str = "state") -> None:
        """Begin at the first state.

        Args:
            stage: what the states are of.
            states: at least one; a state is taken when it is shown, so that they may be read one by one.
            unit: name of a state on the page, such as ``press``.

        Raises:
            InputError: no states.
        """
        if not len(states):
            raise InputError("states", value=0, rule="must be at least one")
        self.title, self.units_per_metre, self.camera = stage.title, stage.units_per_metre, stage.camera
        self.solids, self.lines, self.pads = stage.solids, stage.lines, stage.pads
        self._states, self._unit = states, unit
        last = max(len(states) - 1, 1)
        self.controls = (Control(_OWN, f"{unit} (from 0)", 0.0, float(last), 1.0, f"{len(states)} in all"),)
        self._at, self._target = 0, None

    def reset(self) -> None:
        self._at, self._target = 0, None

    def resume(self) -> None:
        self._target = None
        if self._at == len(self._states) - 1:
            self._at = -1

    def drive(self, targets: Mapping[str, float]) -> None:
        check_targets(self.controls, targets)
        self._target = min(round(targets[_OWN]), len(self._states) - 1)

    def advance(self) -> bool:
        target = self._at + 1 if self._target is None else self._target
        if target == self._at or target >= len(self._states):
            return False
        self._at = target
        return True

    def snapshot(self) -> Snapshot:
        state = self._states[self._at]
        facts = {self._unit: f"{self._at} of {len(self._states) - 1}", **state.facts}
        return replace(state, controls={_OWN: float(self._at)}, facts=facts, handle=None, time_ms={})


def recording_bytes(session: Session, states: Iterable[Snapshot]) -> bytes:
    """An ``.npz`` without Python objects, with all that the page draws of the states."""
    arrays: dict[str, np.ndarray] = {}
    names: dict[int, str] = {}
    kept: list[np.ndarray] = []
    stage = Stage.of(session)

    def encoded(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if id(value) not in names:
                names[id(value)] = name = f"a{len(names)}"
                kept.append(value)  # its id stays its own
                wide = value.dtype == np.float64 and value.size > _SMALL
                arrays[name] = value.astype(np.float32) if wide else value
            return {"array": names[id(value)]}
        if is_dataclass(value):
            return {"record": type(value).__name__, **{f.name: encoded(getattr(value, f.name)) for f in fields(value)}}
        if isinstance(value, Mapping):
            return {"map": {str(key): encoded(item) for key, item in value.items()}}
        if isinstance(value, (tuple, list)):
            return {"list": [encoded(item) for item in value]}
        return float(value) if isinstance(value, np.floating) else value

    head = {field.name: encoded(getattr(stage, field.name)) for field in fields(stage)}
    document = {"format": _FORMAT, "stage": head, "states": [encoded(state) for state in states]}
    text = np.frombuffer(json.dumps(document, allow_nan=True).encode(), np.uint8)
    return npz_bytes({"document": text, **arrays}, compress=True)


def read_recording(path: str | Path) -> StatesSession:
    """Session that plays a recording that the page has saved.

    Raises:
        InputError: no such file, or one that is no recording of this version.
    """
    rule = "must be a recording that `raytac view` has saved"
    try:
        with np.load(Path(path), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        document = json.loads(arrays.pop("document").tobytes())
        if document["format"] != _FORMAT:
            raise ValueError(f"its format is {document['format']!r}, not {_FORMAT!r}")
        stage = Stage(**{name: _decoded(value, arrays) for name, value in document["stage"].items()})
        states = [_decoded(value, arrays) for value in document["states"]]
        if not all(isinstance(state, Snapshot) for state in states):
            raise ValueError("a state is no state")
    except FileNotFoundError as error:
        raise InputError("recording", value=str(path), rule="must be a file that exists") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
        raise InputError("recording", value=str(path), rule=f"{rule} ({error})") from error
    return StatesSession(stage, states)


def _decoded(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "list" in value:
        return tuple(_decoded(item, arrays) for item in value["list"])
    if "map" in value:
        return {key: _decoded(item, arrays) for key, item in value["map"].items()}
    kind = _RECORDS[value["record"]]
    return kind(**{name: _decoded(item, arrays) for name, item in value.items() if name != "record"})
