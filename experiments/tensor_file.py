"""Read files of ``torch.save`` as NumPy arrays, without PyTorch."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import InputError

__all__ = ["read_tensors"]

_STORAGES = {"FloatStorage": np.float32, "DoubleStorage": np.float64, "LongStorage": np.int64, "IntStorage": np.int32}
_MOST_BYTES = 2**28
"""Of one array of numbers, so that a damaged file cannot ask for more."""


def read_tensors(path: Path) -> Any:
    """What ``torch.save`` wrote: dictionaries, lists, numbers and text, with tensors as arrays.

    The file is a zip of a pickle and of the tensors' numbers, little-endian. The pickle may name nothing but tensors and ordered
    dictionaries, and calls nothing else.

    Raises:
        InputError: no such file, or one that holds anything else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            program = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
            return _Unpickler(archive, program).load()
    except FileNotFoundError as error:
        raise InputError("policy", value=path, rule="must be a file that exists") from error
    except Exception as error:  # a damaged file ends in errors of many types
        raise InputError("policy", value=path, rule=f"must be a file of torch.save ({error})") from error


class _Unpickler(pickle.Unpickler):
    """Reader of the pickle ``program`` in an archive, whose numbers lie beside it."""

    def __init__(self, archive: zipfile.ZipFile, program: str) -> None:
        super().__init__(io.BytesIO(archive.read(program)))
        self._archive, self._folder = archive, program.removesuffix("data.pkl") + "data/"

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        raise pickle.UnpicklingError(f"it names {module}.{name}")

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, dtype, key, _, count = pid
        name = f"{self._folder}{int(key)}"
        if kind != "storage" or self._archive.getinfo(name).file_size > _MOST_BYTES:
            raise pickle.UnpicklingError(f"it has a {kind} that is no array of numbers, or too large a one")
        return np.frombuffer(self._archive.read(name), np.dtype(dtype).newbyteorder("<"), count)


def _tensor(storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
    """Tensor of a storage, with its strides in elements; outside of the storage an error."""
    index = np.full(size, offset, np.int64)
    for axis, (count, step) in enumerate(zip(size, stride, strict=True)):
        index += (step * np.arange(count)).reshape((-1, *(1 for _ in size[axis + 1 :])))
    return storage[index]
