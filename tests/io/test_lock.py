"""The lock of a folder: one at a time, nothing of others is touched, and nothing stays where nothing was done."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from raytac.errors import InputError
from raytac.io.folder import FolderLock


def test_one_at_a_time(tmp_path: Path) -> None:
    with FolderLock(tmp_path), pytest.raises(InputError, match="in use by another run"):
        FolderLock(tmp_path)
    lock = FolderLock(tmp_path)
    lock.release()
    lock.release()
    with FolderLock(tmp_path):
        pass
    assert (tmp_path / ".lock").exists()


def test_it_goes_with_the_process_however_it_ends(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from raytac.io.folder import FolderLock\n"
    code += "lock = FolderLock(Path(sys.argv[1])); print('locked', flush=True); time.sleep(60)"
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=env)
    try:
        assert process.stdout is not None and process.stdout.readline() == "locked\n"
        with pytest.raises(InputError, match="in use by another run"):
            FolderLock(tmp_path)
    finally:
        process.kill()
        process.wait()
    FolderLock(tmp_path).release()


@pytest.mark.parametrize("there", ["link", "dangling link", "pipe", "folder"])
def test_a_lock_that_is_no_file_of_ours_is_refused_and_untouched(tmp_path: Path, there: str) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "out").mkdir()
    lock = tmp_path / "out" / ".lock"
    if there == "pipe":
        os.mkfifo(lock)
    elif there == "folder":
        lock.mkdir()
    else:
        lock.symlink_to(tmp_path / ("precious" if there == "link" else "none"))
    with pytest.raises(InputError, match="must be a file that can be written, and no link"):
        FolderLock(tmp_path / "out")
    assert (tmp_path / "precious").read_text() == "mine" and not (tmp_path / "none").exists()


def test_a_folder_in_which_nothing_was_done_is_removed_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="late"), FolderLock(tmp_path / "out"):
        raise ValueError("late")
    assert not (tmp_path / "out").exists()
    with FolderLock(tmp_path / "out"):
        (tmp_path / "out" / "work").write_text("")
    assert (tmp_path / "out" / "work").exists()
    (tmp_path / "empty").mkdir()
    FolderLock(tmp_path / "empty").release()
    assert (tmp_path / "empty").exists(), "it was there before"


def test_a_folder_given_as_text(tmp_path: Path) -> None:
    with FolderLock(str(tmp_path / "out")), pytest.raises(InputError, match="in use by another run"):
        FolderLock(str(tmp_path / "out"))


@pytest.mark.parametrize("then", ["nothing", "file", "folder of another run"])
def test_a_folder_that_is_removed_meanwhile_hides_no_error(then: str, tmp_path: Path) -> None:
    out, gone, handles = tmp_path / "out", tmp_path / "gone", set(os.listdir("/proc/self/fd"))
    with pytest.raises(ValueError, match="of the block"), FolderLock(out):
        out.rename(gone)
        if then == "file":
            out.write_text("mine")
        elif then != "nothing":
            out.mkdir()
            (out / ".lock").write_text("")
        raise ValueError("of the block")
    assert set(os.listdir("/proc/self/fd")) == handles
    assert (out / ".lock").exists() == (then == "folder of another run")


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(InputError, match="must be a folder that can be written"):
            FolderLock(folder)
