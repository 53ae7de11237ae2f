"""Kept tetrahedra: used for their own surface and target alone, and only where they are whole."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ipc
from ipc.meshes.tetwild import tetrahedralize

BOX = ipc.box_surface((1.0, 1.0, 1.0))
GOOD = ipc.box_mesh([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])


@pytest.fixture
def fills(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Target lengths of the meshes that were made and not read."""
    made: list[float] = []

    def fill(surface: ipc.TriMesh, edge_length: float) -> tuple[np.ndarray, np.ndarray]:
        made.append(edge_length)
        return GOOD.vertices * np.ptp(surface.vertices), GOOD.tets.copy()

    monkeypatch.setattr("ipc.meshes.tetwild._fill", fill)
    return made


def _npz(vertices: np.ndarray, tets: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, vertices=vertices, tets=tets)
    return stream.getvalue()


def _flipped(data: bytes) -> bytes:
    place = data.index(GOOD.vertices[-1].tobytes()) + 6
    return data[:place] + bytes([data[place] ^ 0x01]) + data[place + 1 :]


HARMS: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "cut by a byte": lambda data: data[:-1],
    "flipped": _flipped,
    "garbage": lambda data: np.random.default_rng(0).bytes(len(data)),
    "no digest": lambda data: _npz(vertices=GOOD.vertices, tets=GOOD.tets),
    "twice as large": lambda data: _npz(vertices=2 * GOOD.vertices, tets=GOOD.tets),
    "not finite": lambda data: _npz(vertices=np.nan * GOOD.vertices, tets=GOOD.tets),
    "objects": lambda data: _npz(vertices=GOOD.vertices.astype(object), tets=GOOD.tets),
}


@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_mesh_is_made_again(tmp_path: Path, fills: list[float], harm: str) -> None:
    tetrahedralize(BOX, 0.5, tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(HARMS[harm](path.read_bytes()))
    with pytest.warns(RuntimeWarning, match=f"{path.name} in the cache cannot be used and is made again"):
        mesh = tetrahedralize(BOX, 0.5, tmp_path)
    assert len(fills) == 2
    np.testing.assert_array_equal(mesh.vertices, GOOD.vertices)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tetrahedralize(BOX, 0.5, tmp_path)
    assert len(fills) == 2 and list(tmp_path.iterdir()) == [path]


def test_a_mesh_of_another_surface_or_target_is_not_used(tmp_path: Path, fills: list[float]) -> None:
    """Also where it lies, whole, under the name of this one."""
    for surface, length in ((BOX, 0.5), (ipc.box_surface((2.0, 2.0, 2.0)), 0.5), (BOX, 0.25)):
        tetrahedralize(surface, length, tmp_path)
    assert len(fills) == 3 and len(list(tmp_path.iterdir())) == 3
    tetrahedralize(BOX, 0.5, tmp_path / "own")
    (own,) = (tmp_path / "own").iterdir()
    for path in tmp_path.glob("*.npz"):
        if path.name == own.name:
            continue
        (tmp_path / own.name).write_bytes(path.read_bytes())
        with pytest.warns(RuntimeWarning, match="made for another surface or edge length"):
            mesh = tetrahedralize(BOX, 0.5, tmp_path)
        np.testing.assert_array_equal(mesh.vertices, GOOD.vertices)


def test_what_is_no_file_is_replaced_and_not_waited_for(tmp_path: Path, fills: list[float]) -> None:
    tetrahedralize(BOX, 0.5, tmp_path)
    (path,) = tmp_path.iterdir()
    path.unlink()
    os.mkfifo(path)
    with pytest.warns(RuntimeWarning, match="no regular file"):
        tetrahedralize(BOX, 0.5, tmp_path)
    tetrahedralize(BOX, 0.5, tmp_path)
    assert len(fills) == 2


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path, fills: list[float]) -> None:
    (tmp_path / "file").write_text("")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(3):
            assert len(tetrahedralize(BOX, 0.5, tmp_path / "file" / "tets").tets) == 6
    assert len(fills) == 3 and len(caught) == 1 and "cannot be written (Not a directory)" in str(caught[0].message)


def test_a_full_disk_leaves_no_half(tmp_path: Path, fills: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ipc.meshes.tetwild.os.fsync", full)
    with pytest.warns(RuntimeWarning, match="No space left on device"):
        tetrahedralize(BOX, 0.5, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_without_a_home_folder_nothing_is_kept(homeless: None, fills: list[float]) -> None:
    with pytest.warns(RuntimeWarning, match="there is no home folder"):
        tetrahedralize(BOX, 0.5)
    assert len(fills) == 1
