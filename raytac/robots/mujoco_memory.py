"""Places of MuJoCo's arrays in memory, for kernels that read and write many states at once.

MuJoCo's contacts and constraint rows lie in an arena, where they move from step to step. Python gets each of them by a call of its own,
which for many environments takes longer than MuJoCo's own step. The pointers to them are in the structure ``mjData`` itself, whose
declaration MuJoCo ships (``mujoco.introspect``). Its layout by C's rules is compared with what MuJoCo says of a state.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from raytac.errors import BackendError

_SIZES = {"int": 4, "float": 4, "mjtNum": 8, "mjtSize": 8, "size_t": 8, "uintptr_t": 8, "uint64_t": 8, "mjtBool": 1, "mjtByte": 1}
_WORD = 8


class Layout(NamedTuple):
    """Offsets of the members of a C structure [byte], and its size."""

    offset: dict[str, int]
    size: int
    alignment: int


@functools.cache
def layout(name: str) -> Layout:
    """Layout of one of MuJoCo's structures by its declaration."""
    from mujoco.introspect.structs import STRUCTS

    offset: dict[str, int] = {}
    end, widest = 0, 1
    members: Any = STRUCTS[name].fields
    for member in members:
        size, alignment = _size(member.type)
        end = -(-end // alignment) * alignment
        offset[member.name] = end
        end, widest = end + size, max(widest, alignment)
    return Layout(offset, -(-end // widest) * widest, widest)


def _size(declared: Any) -> tuple[int, int]:
    """Size and alignment [byte] of a declared type."""
    extents = getattr(declared, "extents", None)
    if extents is not None:
        size, alignment = _size(declared.inner_type)
        return size * int(np.prod(extents)), alignment
    if hasattr(declared, "inner_type"):
        return _WORD, _WORD  # a pointer
    if declared.name in _SIZES:
        return _SIZES[declared.name], _SIZES[declared.name]
    inner = layout(declared.name)
    return inner.size, inner.alignment


@functools.cache
def checked_layouts() -> tuple[Layout, Layout]:
    """Layouts of ``mjData`` and ``mjContact``; ``BackendError`` if MuJoCo's differ."""
    state, contact = layout("mjData"), layout("mjContact")
    model = mujoco.MjModel.from_xml_string(_BALLS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    data.time = 0.12345678901234567
    whole = words(data, state.size)
    known = [name for name in _ARRAYS if address(getattr(data, name)) != whole[state.offset[name] // _WORD]]
    first = address(data.contact.dist)
    known += [name for name in _CONTACT if address(getattr(data.contact, name)) != first + contact.offset[name]]
    if data.contact.dist.strides[0] != contact.size or first != whole[state.offset["contact"] // _WORD]:
        known.append("contact")
    numbers = whole.view(np.int32)
    known += ["time"] if whole.view(float)[state.offset["time"] // _WORD] != data.time else []
    known += [name for name in ("ncon", "nefc") if numbers[state.offset[name] // 4] != getattr(data, name)]
    if known:
        raise BackendError(
            f"MuJoCo {mujoco.__version__} keeps {known} elsewhere than it declares: rigid pads cannot act on its states"
        )
    return state, contact


def same_states(one: Sequence[object], other: Sequence[object]) -> bool:
    """True if two sequences hold the same objects."""
    return len(one) == len(other) and all(map(operator.is_, one, other))


def words(data: mujoco.MjData, size: int) -> np.ndarray:
    """Copy of the first bytes of a state's structure, as 64-bit words."""
    import ctypes

    return np.frombuffer(ctypes.string_at(data._address, size), np.uint64)


def address(values: np.ndarray) -> int:
    """Place of an array in memory."""
    return int(values.__array_interface__["data"][0])


_BALLS = """<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>
<geom size=".1"/></body><body pos="1 0 0"><freejoint/><geom size=".1"/><site/></body></worldbody></mujoco>"""
_ARRAYS = (
    "qpos", "qvel", "xpos", "xmat", "site_xpos", "site_xmat", "subtree_com", "cvel", "cdof", "qacc_smooth", "qacc",
    "qacc_warmstart", "efc_J_rownnz", "efc_J_rowadr", "efc_J_colind", "efc_J", "efc_D", "efc_R", "efc_vel", "efc_aref", "efc_force",
)  # fmt: skip
_CONTACT = ("dist", "pos", "frame", "friction", "mu", "dim", "geom1", "geom2", "geom", "efc_address")
