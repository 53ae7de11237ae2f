"""Arrays of .npz and .npy files from strangers: read without trust, refused with the file, the array and the rule."""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from pathlib import Path

import numpy as np

from raytac.errors import CalibrationError, RaytacError
from raytac.optics.restricted_pickle import load_restricted

__all__ = ["check_file_numbers", "file_bytes", "npy_array", "npz_arrays", "npz_names"]

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
    """The named arrays of an .npz file, each of at most ``most`` bytes with its header; no other one is touched."""
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
    """Array of the bytes of an .npy file, whose header must agree with their number; objects go through the restricted unpickler."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, dtype = read(stream)
        rest = data[stream.tell() :]
        if dtype.hasobject:
            found = load_restricted(rest)
            if dtype != np.dtype("O") or not isinstance(found, np.ndarray) or found.shape != shape:
                raise CalibrationError(f"must be an array of shape {shape}, as its header says", file=path, key=key)
            return found
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
