"""Numbers of many states of MuJoCo at once: read and written by one kernel each.

MuJoCo keeps every state in memory of its own, and a call from Python for each number of each state takes longer than its own step. The
arrays that are named here stay where they are as long as the state lives, so that their places are looked up once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.robots.arm_kernels import Entries, read_numbers, write_numbers
from raytac.robots.mujoco_memory import checked_layouts, same_states
from raytac.warp_runtime import Recorded, start_warp

_CONSTANT = -1
"""Member of an entry that is its index itself, as a number."""


@dataclass(frozen=True)
class Numbers:
    """Some numbers of a state, in the shape that an array of them has."""

    name: tuple[str, ...]
    """Member of ``MjData`` of every entry; "" for a constant."""
    index: tuple[int, ...]
    """Its index in that member as a flat array, or the constant itself."""
    shape: tuple[int, ...]


def numbers(name: str, index: np.ndarray) -> Numbers:
    """Entries ``index`` (…) of a flat member of ``MjData``, or of ``time``; 0 where negative."""
    flat = np.asarray(index, int).ravel().tolist()
    return Numbers(tuple(name if i >= 0 else "" for i in flat), tuple(max(i, 0) for i in flat), np.shape(index))


def site_pose(site: int | np.ndarray) -> Numbers:
    """Pose (4, 4) of a site by its index; (n, 4, 4) of n sites."""
    return _pose("site_xmat", "site_xpos", site)


def body_pose(body: int | np.ndarray) -> Numbers:
    """Pose (4, 4) of a body by its index; (n, 4, 4) of n bodies."""
    return _pose("xmat", "xpos", body)


def _pose(turn: str, place: str, indices: int | np.ndarray) -> Numbers:
    name: list[str] = []
    index: list[int] = []
    for i in np.ravel(indices).tolist():
        for row in range(3):
            name += [turn, turn, turn, place]
            index += [9 * i + 3 * row, 9 * i + 3 * row + 1, 9 * i + 3 * row + 2, 3 * i + row]
        name += [""] * 4
        index += [0, 0, 0, 1]
    return Numbers(tuple(name), tuple(index), (*np.shape(indices), 4, 4))


class StateReader:
    """Numbers of B states, read together.

    Attributes:
        arrays: Warp arrays (B, …) of float64 by name; they are overwritten by the next ``read``.
        read: reads all numbers into ``arrays``.
        launch: the same, to be recorded with what works on them.
    """

    def __init__(self, datas: Sequence[mujoco.MjData], members: Mapping[str, Numbers]) -> None:
        """Look up where ``members`` of ``datas`` lie; InputError for no float64 of fixed size."""
        start_warp()
        self._datas = tuple(datas)
        for one in members.values():
            _check(self._datas, one)
        count = len(self._datas)
        names = sorted({name for one in members.values() for name in one.name if name})
        member, index, start, stride = [], [], [], []
        size = 0
        self._parts: dict[str, tuple[slice, tuple[int, ...]]] = {}
        for key, one in members.items():
            width = len(one.index)
            member += [names.index(name) if name else _CONSTANT for name in one.name]
            index += one.index
            start += range(size, size + width)
            stride += [width] * width
            self._parts[key] = slice(size, size + count * width), (count, *one.shape)
            size += count * width
        self._flat = wp.zeros(size, dtype=wp.float64, device="cpu")
        self._values = self._flat.numpy()
        self.arrays: dict[str, Any] = {
            key: wp.array(ptr=self._flat.ptr + part.start * 8, shape=shape, dtype=wp.float64, device="cpu")
            for key, (part, shape) in self._parts.items()
        }
        places = np.array([[_place(data, name) for name in names] for data in self._datas], np.uint64)
        entries = Entries()
        entries.places, entries.values = wp.array(places, dtype=wp.uint64, device="cpu"), self._flat
        for name, column in (("member", member), ("index", index), ("start", start), ("stride", stride)):
            setattr(entries, name, wp.array(column, dtype=wp.int32, device="cpu"))
        self.launch = partial(wp.launch, read_numbers, dim=count, inputs=[entries], device="cpu")
        self.read = Recorded(self.launch)

    def reads(self, datas: Sequence[mujoco.MjData]) -> bool:
        """True if it reads these states."""
        return same_states(datas, self._datas)

    def values(self) -> dict[str, np.ndarray]:
        """Read all numbers; new NumPy arrays (B, …) by name."""
        self.read()
        copied = self._values.copy()
        return {key: copied[part].reshape(shape) for key, (part, shape) in self._parts.items()}


class NumberWriter:
    """Write some numbers of one member of B states together.

    Attributes:
        array: Warp array (B, n), the next numbers; ``values`` is the same memory in NumPy.
    """

    def __init__(self, datas: Sequence[mujoco.MjData], member: str, index: Sequence[int] | np.ndarray) -> None:
        """Look up entries ``index`` (n,) of a flat member of ``datas``."""
        start_warp()
        self._datas = tuple(datas)
        count = len(self._datas)
        self.array = wp.zeros((count, len(index)), dtype=wp.float64, device="cpu")
        self.values = self.array.numpy()
        self._chosen = wp.zeros(count, dtype=wp.int32, device="cpu")
        self._mask = self._chosen.numpy()
        places = wp.array([_place(data, member) for data in self._datas], dtype=wp.uint64, device="cpu")
        inputs = [places, wp.array(list(index), dtype=wp.int32, device="cpu"), self.array, self._chosen]
        self._write = Recorded(partial(wp.launch, write_numbers, dim=self.array.shape, inputs=inputs, device="cpu"))

    def write(self, envs: Sequence[int] | np.ndarray) -> np.ndarray | None:
        """Write the numbers of environments; or return the first that are not finite, writing none."""
        chosen = self.values if len(envs) == len(self._datas) else self.values[envs]
        # One number that is not finite makes the sum such.
        if not np.isfinite(chosen.sum()):
            return next(row for row in chosen if not np.isfinite(row).all())
        self._mask[:] = 0
        self._mask[envs] = 1
        self._write()
        return None


def _check(datas: Sequence[mujoco.MjData], entries: Numbers) -> None:
    last: dict[str, int] = {}
    for name, index in zip(entries.name, entries.index, strict=True):
        if name:
            last[name] = max(index, last.get(name, 0))
    for name, index in last.items():
        for data in datas:
            values = np.zeros(1) if name == "time" else getattr(data, name)
            known = isinstance(values, np.ndarray) and values.dtype == float and not name.startswith(("efc_", "contact"))
            if not known or index >= values.size:
                raise InputError("numbers", value=(name, index), rule="must be of float64 members of fixed size, and within them")


def _place(data: mujoco.MjData, name: str) -> int:
    """Address of an array of a state, or of its time."""
    if name == "time":
        return data._address + checked_layouts()[0].offset["time"]
    return int(getattr(data, name).__array_interface__["data"][0])
