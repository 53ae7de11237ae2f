"""Whole files: an error leaves what was there, links are replaced and not followed, and pipes are not waited for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from raytac.io.atomic import read_regular, write_atomic


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    for data in (b"one", b"two, longer", b""):
        write_atomic(path, data)
        assert read_regular(path) == data
    assert [item.name for item in tmp_path.iterdir()] == ["kept"]
    old = os.umask(0o027)
    try:
        write_atomic(path, b"")
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_link_is_replaced_and_what_it_points_to_stays(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "kept").symlink_to("precious")
    write_atomic(tmp_path / "kept", b"new")
    assert (tmp_path / "precious").read_text() == "mine" and not (tmp_path / "kept").is_symlink()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    write_atomic(tmp_path / "kept", b"old")
    with monkeypatch.context() as patch:
        patch.setattr(f"raytac.io.atomic.os.{step}", full)
        with pytest.raises(OSError, match="No space left"):
            write_atomic(tmp_path / "kept", b"new")
    assert (tmp_path / "kept").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_contents_reach_the_disk_before_the_name_and_the_name_before_the_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(
        "raytac.io.atomic.os.fsync",
        lambda f: (done.append("folder" if os.path.isdir(f"/proc/self/fd/{f}") else "file"), fsync(f)),
    )
    monkeypatch.setattr("raytac.io.atomic.os.replace", lambda a, b: (done.append("rename"), replace(a, b)))
    write_atomic(tmp_path / "kept", b"data")
    assert done == ["file", "rename", "folder"]


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zeros").symlink_to("/dev/zero")
    for name in ("pipe", "zeros", "."):
        with pytest.raises(OSError, match="Not a regular file"):
            read_regular(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "none")
