"""A result folder is whole or absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from raytac.errors import InputError
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
