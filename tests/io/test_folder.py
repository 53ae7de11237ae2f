"""A result folder is whole or absent."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from raytac.errors import AssetError, InputError
from raytac.io.folder import result_folder


def test_files_arrive_together_and_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    out.mkdir(parents=True)
    (out / "notes.txt").write_text("mine")
    (out / "a.txt").write_text("old")
    with result_folder(out) as folder:
        (folder / "a.txt").write_text("new")
        assert (out / "a.txt").read_text() == "old"
    assert (out / "a.txt").read_text() == "new"
    assert (out / "notes.txt").read_text() == "mine"
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupt_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), result_folder(tmp_path / "out") as folder:
        (folder / "a.txt").write_text("half")
        raise error
    assert not list(tmp_path.iterdir())


def test_metrics_come_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    real = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (moved.append(Path(a).name), real(a, b)))
    with result_folder(tmp_path / "out") as folder:
        for name in ("z.png", "metrics.json", "a.exr"):
            (folder / name).write_text("")
    assert sorted(moved[:2]) == ["a.exr", "z.png"] and moved[2] == "metrics.json"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="a file of that name exists"), result_folder(tmp_path / "out"):
        pass


def test_what_an_earlier_run_wrote_and_this_one_does_not_is_removed(tmp_path: Path) -> None:
    owned = ("rgb.png", "height.npy", "metrics.json")
    for names in (owned, ("height.npy", "metrics.json")):
        with result_folder(tmp_path / "out", owned) as folder:
            for name in names:
                (folder / name).write_text("")
        (tmp_path / "out" / "notes.txt").write_text("mine")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"height.npy", "metrics.json", "notes.txt"}
    with pytest.raises(RuntimeError), result_folder(tmp_path / "out", owned):
        raise RuntimeError
    assert (tmp_path / "out" / "height.npy").exists()


def fill(out: Path) -> dict[str, str]:
    """An earlier result."""
    out.mkdir()
    for name in ("rgb.png", "height.npy", "metrics.json"):
        (out / name).write_text(f"old {name}")
    return {path.name: path.read_text() for path in out.iterdir()}


@pytest.mark.parametrize("known", [True, False])
def test_a_folder_where_a_file_is_to_be_written_is_named_and_nothing_changes(tmp_path: Path, known: bool) -> None:
    """Of files that the command says it writes, before any work; else before any of them is put there."""
    out = tmp_path / "out"
    fill(out)
    (out / "rgb.png").unlink()
    (out / "rgb.png").mkdir()
    ran = False
    with (
        pytest.raises(InputError, match=r"holds a folder 'rgb\.png'"),
        result_folder(out, ("rgb.png",) if known else ()) as folder,
    ):
        ran = True
        for name in ("rgb.png", "height.npy", "metrics.json"):
            (folder / name).write_text("new")
    assert ran is not known
    assert {path.name for path in out.iterdir()} == {"rgb.png", "height.npy", "metrics.json"}
    assert (out / "height.npy").read_text() == "old height.npy" and (out / "metrics.json").read_text() == "old metrics.json"


def test_a_link_to_nothing_is_named_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"is a link to .*nowhere, which does not exist"), result_folder(tmp_path / "out"):
        pytest.fail("the work began")


def test_a_link_to_a_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    with result_folder(tmp_path / "out") as folder:
        (folder / "a.txt").write_text("new")
    assert (tmp_path / "out").is_symlink() and (tmp_path / "real" / "a.txt").read_text() == "new"


def test_a_full_disk_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    before = fill(tmp_path / "out")
    with (
        pytest.raises(InputError, match=r"No space left on device.*nothing in it has changed"),
        result_folder(tmp_path / "out") as folder,
    ):
        (folder / "height.npy").write_text("new")
        with open("/dev/full", "w") as full:
            full.write("x")
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize("fails_at", range(1, 6))
def test_a_move_that_fails_puts_back_what_was_there(tmp_path: Path, fails_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    before = fill(tmp_path / "out")
    real, calls = os.replace, 0

    def replace(a: Path, b: Path) -> None:
        nonlocal calls
        calls += 1
        if calls == fails_at:
            raise OSError(28, "No space left on device", str(a))
        real(a, b)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(InputError, match="No space left"), result_folder(tmp_path / "out", ("rgb.png",)) as folder:
        for name in ("height.npy", "metrics.json"):
            (folder / name).write_text("new")
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize(
    "error",
    [
        AssetError("the folder scenes/ cannot be found"),
        OSError("the camera is gone"),
        TimeoutError("the server does not answer"),
        OSError(errno.EBADF, "Bad file descriptor", 99),
        PermissionError(errno.EACCES, "Permission denied", "/elsewhere"),
        OSError(errno.ENOSPC, "No space left on device", "/elsewhere"),
    ],
    ids=repr,
)
def test_an_error_of_something_else_stays_what_it_is(tmp_path: Path, error: OSError) -> None:
    with pytest.raises(OSError, match=re.escape(str(error))) as caught, result_folder(tmp_path / "out"):
        raise error
    assert caught.value is error and not list(tmp_path.iterdir())


def test_a_file_of_the_folder_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"cannot be written \(Is a directory\)"), result_folder(Path("out")) as folder:
        (folder / "a").mkdir()
        (folder.absolute() / "a").write_text("")


@pytest.mark.parametrize("kind", ["npy", "npz", "exr", "png"])
def test_a_disk_that_fills_up_is_told_for_every_kind_of_file(tmp_path: Path, kind: str) -> None:
    """A limit on the length of files stands for the disk, since libraries report both alike."""
    code = """if True:
        import resource, sys
        from pathlib import Path
        import numpy as np
        from raytac.errors import AssetError, InputError
        from raytac.io.images import write_exr
        from raytac.io.folder import result_folder
        from raytac.io.arrays import npy_bytes
        from raytac.io.images import write_png

        noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), np.uint8)
        write = {
            "npy": lambda path: path.write_bytes(npy_bytes(noise)),
            "npz": lambda path: np.savez(path, a=noise),
            "exr": lambda path: write_exr(path, {"Z": noise[..., 0] / 7}),
            "png": lambda path: write_png(path, noise),
        }[sys.argv[1]]
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            with result_folder(Path(sys.argv[2])) as folder:
                write(folder / f"a.{sys.argv[1]}")
        except InputError as error:
            print(error)
    """
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", code, kind, str(tmp_path / "out")]
    said = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
    assert "cannot be written (" in said and "nothing in it has changed" in said
    assert not list(tmp_path.iterdir())


def test_an_error_that_is_not_of_the_folder_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="elsewhere"), result_folder(tmp_path / "out"):
        (tmp_path / "elsewhere").read_text()
