"""Arrays as bytes of ``.npy`` and ``.npz`` files: no objects, equal bytes for equal arrays."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping

import numpy as np

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Date of every member of an archive, so that equal arrays are equal files."""


def npy_bytes(array: np.ndarray) -> bytes:
    """An ``.npy`` for ``numpy.load``."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)
    return stream.getvalue()


def npz_bytes(arrays: Mapping[str, np.ndarray], *, compress: bool = False) -> bytes:
    """Contents of an ``.npz``. Equal arrays give equal bytes, unlike those of ``numpy.savez``."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
            member.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
            with archive.open(member, "w", force_zip64=True) as stream:
                # Not ascontiguousarray, which gives a number one axis.
                np.lib.format.write_array(stream, np.asarray(values, order="C"), allow_pickle=False)
    return out.getvalue()
