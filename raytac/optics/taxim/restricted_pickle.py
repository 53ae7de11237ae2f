"""Read pickles of numbers, lists, tuples and NumPy arrays of those, and nothing else.

A pickle is a program: ``pickle.load`` calls whatever it names. Upstream's shadow tables are pickled object arrays, so they are read by
an unpickler that knows only what such an array needs, as stand-ins that check every argument; any other name ends the reading before
anything is called. Arrays are built from the stand-ins afterwards, so that no state from the file reaches NumPy unchecked. The program
itself is looked through before it runs, since a few bytes of it can ask for more memory than there is.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import CalibrationError, RaytacError

_NUMBERS = "biuf"
"""Kinds of NumPy numbers that are admitted."""
_MOST_ITEMS = 2**22
"""Items read at most, each use of a shared list counted; upstream's tables have 24,561."""
_LARGEST_INT = 2**64
_OPCODES = frozenset(
    """
    PROTO FRAME STOP MARK POP POP_MARK
    NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT
    STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8
    EMPTY_LIST LIST APPEND APPENDS EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3
    PUT BINPUT LONG_BINPUT MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE BUILD
    """.split()  # noqa: SIM905
)
"""Instructions that numbers, lists, tuples and arrays need, in any protocol."""


def load_restricted(data: bytes) -> Any:
    """Object of the pickle ``data``: numbers, lists, tuples, NumPy arrays and scalars of them.

    Raises UnpicklingError, before anything that it names has run, if it names or holds anything else, asks for far more memory than its
    own size, or is cut short or damaged.
    """
    try:
        _check_program(data)
        return _Plain().of(_Unpickler(io.BytesIO(data)).load())
    except pickle.UnpicklingError:
        raise
    except Exception as error:  # a damaged stream ends in errors of many types
        raise pickle.UnpicklingError(f"the pickle is damaged: {type(error).__name__}: {error}") from error


def _check_program(data: bytes) -> None:
    """Refuse instructions that are not needed, and a memo larger than the pickle."""
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name not in _OPCODES:
            raise pickle.UnpicklingError(f"it has the instruction {opcode.name}, which numbers, lists and arrays do not need")
        if opcode.name in ("PUT", "LONG_BINPUT") and not 0 <= int(argument or 0) < len(data):
            raise pickle.UnpicklingError(f"it notes an object at place {argument}, beyond its own {len(data)} bytes")


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _Admitted(_ADMITTED[module, name])
        except KeyError:
            message = f"it names {module}.{name}, and only numbers, lists, tuples and NumPy arrays of them are read"
            raise pickle.UnpicklingError(message) from None

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it refers to an object outside of itself")


class _Admitted:
    """A callable that a pickle may call and may not change."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *args: Any) -> Any:
        return self._function(*args)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("it changes what it names")


class _Type:
    """Stands in for a dtype: a number's, or ``O`` for objects."""

    __slots__ = ("dtype",)

    def __init__(self, code: Any, align: Any = False, copy: Any = True) -> None:
        self.dtype = np.dtype(code) if isinstance(code, str) else np.dtype("V")
        if self.dtype.kind not in _NUMBERS + "O":
            raise pickle.UnpicklingError(f"an array of {code!r}")

    def __setstate__(self, state: Any) -> None:
        order, *structure = state[1:5]
        if order not in ("<", ">", "|", "=") or any(part is not None for part in structure):
            raise pickle.UnpicklingError(f"an array of the structure {state[1:5]!r}")
        if self.dtype.kind != "O":
            self.dtype = self.dtype.newbyteorder(order)


class _Array:
    """Stands in for an array until its state has come and been checked."""

    __slots__ = ("data", "fortran", "kind", "shape")

    def __init__(self, *start: Any) -> None:
        self.kind, self.shape, self.data, self.fortran = np.dtype("b"), (0,), b"", False

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, data = state
        self.kind, self.shape, self.fortran, self.data = _dtype_of(kind), shape, bool(fortran), data


class _Plain:
    """Values with arrays in place of stand-ins, up to ``_MOST_ITEMS`` items."""

    def __init__(self) -> None:
        self._budget = _MOST_ITEMS

    def of(self, item: Any) -> Any:
        """``item`` with every stand-in in it replaced."""
        self._spend(1)
        if isinstance(item, _Array):
            return self._array(item)
        if isinstance(item, (list, tuple)):
            return type(item)(self.of(one) for one in item)
        if isinstance(item, int) and not -_LARGEST_INT < item < _LARGEST_INT:
            raise pickle.UnpicklingError("it holds an integer of more than 64 bits")
        if isinstance(item, (bool, int, float, np.number, np.bool_)):
            return item
        raise pickle.UnpicklingError(
            f"it holds a {type(item).__name__}, and only numbers, lists, tuples and NumPy arrays are read"
        )

    def _array(self, stand_in: _Array) -> np.ndarray:
        shape, order = tuple(int(n) for n in stand_in.shape), "F" if stand_in.fortran else "C"
        if stand_in.kind.kind != "O":
            data = _bytes(stand_in.data)
            self._spend(len(data) // stand_in.kind.itemsize)
            return np.frombuffer(data, dtype=stand_in.kind).reshape(shape, order=order)
        items = stand_in.data
        if not isinstance(items, list) or min(shape, default=0) < 0 or len(items) != math.prod(shape):
            raise pickle.UnpicklingError(f"an array of shape {shape} without its items")
        out = np.empty(len(items), dtype=object)
        for k, item in enumerate(items):
            out[k] = self.of(item)
        return out.reshape(shape, order=order)

    def _spend(self, items: int) -> None:
        self._budget -= items
        if self._budget < 0:
            raise pickle.UnpicklingError(f"it holds more than {_MOST_ITEMS} items")


def _dtype_of(kind: Any) -> np.dtype:
    if not isinstance(kind, _Type):
        raise pickle.UnpicklingError("an array without a type")
    return kind.dtype


def _bytes(data: Any) -> bytes:
    if not isinstance(data, (bytes, bytearray)):
        raise pickle.UnpicklingError(f"numbers in a {type(data).__name__}")
    return bytes(data)


def _scalar(kind: Any, data: Any) -> Any:
    dtype = _dtype_of(kind)
    if dtype.kind not in _NUMBERS or len(_bytes(data)) != dtype.itemsize:
        raise pickle.UnpicklingError(f"a scalar of {dtype}")
    return np.frombuffer(_bytes(data), dtype=dtype)[0]


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> _Array:
    """An array as protocol 5 writes it."""
    out = _Array()
    out.__setstate__((1, shape, kind, order == "F", _bytes(data)))
    return out


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """Bytes as protocols before 3 write them."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"text in encoding {encoding!r}")
    return text.encode("latin1")


def _never(*args: Any) -> Any:
    raise pickle.UnpicklingError("it makes an array without _reconstruct")


_ADMITTED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _never,  # named only, as the kind of array to make
    ("numpy", "dtype"): _Type,
    ("_codecs", "encode"): _encode,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _Array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
}

_LARGEST = 2**30
"""Longest file or array read [byte]."""


def check_file_numbers(path: Path, key: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """``array`` if it holds finite numbers and has this shape."""
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise CalibrationError(f"must be numbers of shape {shape}", file=path, key=key, value=f"{array.dtype} {array.shape}")
    if not np.isfinite(array).all() or np.abs(array.astype(np.float64)).max() > 1e9:
        raise CalibrationError("must be finite, at most 10^9", file=path, key=key, value=str(array.dtype))
    return array


def file_bytes(path: Path) -> bytes:
    """The whole file."""
    try:
        if path.stat().st_size > _LARGEST:
            raise CalibrationError(f"must be at most {_LARGEST} bytes", file=path)
        return path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"cannot be read ({error.strerror})", file=path) from error


def npz_names(path: Path) -> set[str]:
    """Names of the arrays in an .npz file."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name.removesuffix(".npy") for name in archive.namelist()}
    except Exception as error:  # a damaged archive ends in errors of many types
        raise CalibrationError(f"cannot be read ({error})", file=path) from error


def npz_arrays(path: Path, names: tuple[str, ...], most: int = _LARGEST) -> dict[str, np.ndarray]:
    """The named arrays of an .npz file, each of at most ``most`` bytes with its header."""
    missing = [name for name in names if name not in npz_names(path)]
    if missing:
        raise CalibrationError(f"must hold the array {missing[0]!r}", file=path, choices=sorted(npz_names(path)))
    arrays = {}
    for name in names:
        try:
            with zipfile.ZipFile(path) as archive:
                size = archive.getinfo(f"{name}.npy").file_size
                if size > most:  # before it is unpacked: a small archive can hold any number of zeros
                    raise CalibrationError(f"must be at most {most} bytes long, and is {size}", file=path, key=name)
                data = archive.read(f"{name}.npy")
        except RaytacError:
            raise
        except Exception as error:  # a damaged archive ends in errors of many types
            raise CalibrationError(f"is damaged ({type(error).__name__}: {error})", file=path, key=name) from error
        arrays[name] = npy_array(path, name, data)
    return arrays


def npy_array(path: Path, key: str, data: bytes) -> np.ndarray:
    """Array of an .npy file's bytes, as many as its header says; objects by ``load_restricted``."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, dtype = read(stream)
        rest = data[stream.tell() :]
        if dtype.hasobject:
            array = load_restricted(rest)
            if dtype != np.dtype("O") or not isinstance(array, np.ndarray) or array.shape != shape:
                raise CalibrationError(f"must be an array of shape {shape}, as its header says", file=path, key=key)
            return array
        if len(rest) != math.prod(shape) * dtype.itemsize:
            rule = f"is cut short or too long: {len(rest)} bytes for {dtype} of shape {shape}"
            raise CalibrationError(rule, file=path, key=key)
        return np.frombuffer(rest, dtype=dtype).reshape(shape, order="F" if fortran else "C")
    except RaytacError:
        raise
    except pickle.UnpicklingError as error:
        raise CalibrationError(f"is refused: {error}", file=path, key=key) from error
    except Exception as error:  # a damaged header does too
        raise CalibrationError(f"is damaged ({type(error).__name__}: {error})", file=path, key=key) from error
