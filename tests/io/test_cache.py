"""The user's cache: what is damaged in any way is told and not used, and what cannot be kept is told and done without."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from raytac.io import cache
from raytac.io.arrays import npy_bytes, npz_bytes
from raytac.io.cache import keep_cached, read_cached
from raytac.io.seal import SealError, read_sealed, write_sealed


def test_every_byte_of_a_sealed_file_counts(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    for data in (b"", b"some bytes"):
        write_sealed(path, data)
        assert read_sealed(path) == data
        whole = path.read_bytes()
        wrong = [whole[:place] + bytes([whole[place] ^ (1 << place % 8)]) + whole[place + 1 :] for place in range(len(whole))]
        for harmed in (b"", *(whole[:k] for k in range(1, len(whole))), whole + b"\0", *wrong):
            path.write_bytes(harmed)
            with pytest.raises(SealError):
                read_sealed(path)


def test_a_file_of_another_name_does_not_pass(tmp_path: Path) -> None:
    write_sealed(tmp_path / "one", b"data")
    os.replace(tmp_path / "one", tmp_path / "other")
    with pytest.raises(SealError):
        read_sealed(tmp_path / "other")


def test_numpy_reads_sealed_arrays(tmp_path: Path) -> None:
    array = np.arange(6.0).reshape(2, 3)
    write_sealed(tmp_path / "a.npy", npy_bytes(array))
    write_sealed(tmp_path / "a.npz", npz_bytes({"x": array, "n": np.array(3)}, compress=True))
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), array)
    with np.load(tmp_path / "a.npz") as kept:
        np.testing.assert_array_equal(kept["x"], array)
        assert kept["n"].shape == () and kept["n"] == 3
    with pytest.raises(ValueError, match="allow_pickle"):
        npy_bytes(np.array([{}]))
    assert np.load(io.BytesIO(npy_bytes(array.T))).tolist() == array.T.tolist()


def _link_to_zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize("there", [Path.mkdir, os.mkfifo, _link_to_zeros])
def test_what_is_no_file_is_not_read(tmp_path: Path, there: Callable[[Path], object]) -> None:
    there(tmp_path / "kept")
    with pytest.warns(RuntimeWarning, match="cannot be used and is made again: .*Not a regular file"):
        assert read_cached(tmp_path / "kept") is None
    if there is not Path.mkdir:
        keep_cached(tmp_path / "kept", b"data")
        assert read_cached(tmp_path / "kept") == b"data"


def test_what_is_not_there_is_nothing_to_tell(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_cached(tmp_path / "none") is None and read_cached(tmp_path / "no" / "folder") is None
        (tmp_path / "file").write_text("")
        assert read_cached(tmp_path / "file" / "none") is None and read_cached(None) is None


def test_a_cache_that_cannot_be_written_is_told_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for k in range(3):
            keep_cached(tmp_path / "file" / "tables" / str(k), b"data")
    assert len(told) == 1 and "tables cannot be written (Not a directory)" in str(told[0].message)
    assert "RAYTAC_CACHE" in str(told[0].message)


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(30, "Read-only file system")])
def test_a_cache_that_is_read_only_is_still_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: OSError) -> None:
    def refuse(*args: object, **options: object) -> None:
        raise error

    keep_cached(tmp_path / "kept", b"data")
    monkeypatch.setattr("raytac.io.atomic.os.replace", refuse)
    with pytest.warns(RuntimeWarning, match=str(error.strerror)):
        keep_cached(tmp_path / "other", b"data")
    assert read_cached(tmp_path / "kept") == b"data" and len(list(tmp_path.iterdir())) == 1


def test_root_of_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "own"))
    assert cache.cache_root() == tmp_path / "own"
    monkeypatch.delenv("RAYTAC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_root() == tmp_path / "xdg" / "raytac"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_root() == tmp_path / ".cache" / "raytac"


def test_a_user_without_a_home_has_no_cache(homeless: None) -> None:
    assert cache.cache_root() is None and cache.cache_folder("tables") is None
    with pytest.warns(RuntimeWarning, match="there is no home folder.*RAYTAC_CACHE"):
        keep_cached(None, b"data")
