"""The cache of baked tables: found again, kept apart by what shapes a table, whole or not there."""

from __future__ import annotations

import errno
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from raytac.io import code_digest
from raytac.optics.taxim import cache as table_cache
from raytac.optics.taxim.bake import bake
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.table import PolyTable, TaximConstants
from raytac.specs.sensor import SensorSpec
from tests.conftest import make_sensor_spec

SPEC = make_sensor_spec()


def made_up(seed: int) -> PolyTable:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
    return PolyTable(
        gradients=rng.normal(size=(3, 5, 5, 6)),
        covered=rng.random((5, 5)) > 0.5,
        background=image.astype(np.float32),
        pixel_pitch=(1e-4, 1e-4),
        rest_image=image,
        constants=TaximConstants(background_sigma=1.0),
        provenance={"source": f"made up {seed}"},
    )


@pytest.fixture
def baker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[PolyTable, int]]:
    """``baker(**arguments)``: ``baked_table`` and how many tables were baked so far."""
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "cache"))
    calls: list[dict[str, Any]] = []

    def fake(sensor: SensorSpec, **arguments: Any) -> SimpleNamespace:
        calls.append(arguments)
        return SimpleNamespace(table=made_up(len(calls)))

    monkeypatch.setattr(bake, "bake", fake)

    def call(spec: SensorSpec = SPEC, **arguments: Any) -> tuple[PolyTable, int]:
        return bake.baked_table(spec, progress=False, **arguments), len(calls)

    return call


def entries(tmp_path: Path) -> list[Path]:
    folder = tmp_path / "cache" / "tables"
    return sorted(folder.iterdir()) if folder.is_dir() else []


def test_the_second_time_it_is_read(baker: Callable[..., Any], tmp_path: Path) -> None:
    first, baked = baker()
    second, still = baker()
    assert baked == still == 1 and len(entries(tmp_path)) == 1
    for name in ("gradients", "covered", "background", "rest_image"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert second.provenance == {"source": "made up 1"}


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"resolution": (160, 120)},
        {"settings": BakeSettings(images=7)},
        {"spec": replace(SPEC, coat=replace(SPEC.coat, specular=0.3))},
        {
            "spec": replace(
                SPEC, lights=replace(SPEC.lights, leds=(replace(SPEC.lights.leds[0], lobe=2.0), *SPEC.lights.leds[1:]))
            )
        },
    ],
)
def test_what_shapes_a_table_keeps_it_apart(baker: Callable[..., Any], other: dict[str, Any]) -> None:
    baker()
    assert baker(**other)[1] == 2
    assert baker(**other)[1] == 2 and baker()[1] == 2


def test_where_files_lie_and_the_device_do_not_matter(baker: Callable[..., Any]) -> None:
    baker()
    assert baker(replace(SPEC, source=Path("elsewhere.toml")))[1] == 1
    assert baker(device="cpu")[1] == 1
    assert baker(resolution=SPEC.camera.resolution)[1] == 1


def test_other_code_is_another_key(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked = SPEC, BakeSettings(), 0, (320, 240)
    before = table_cache.table_key(*asked)
    assert before == table_cache.table_key(*asked)
    changed = tmp_path / "fast_tracer.py"
    changed.write_text("changed = True\n")
    sources = code_digest.module_sources
    monkeypatch.setattr(
        code_digest, "module_sources", lambda roots: sources(roots) | {"raytac.optics.trace.fast_tracer": changed}
    )
    assert table_cache.table_key(*asked) != before


FILES = ("polycalib.npz", "dataPack.npz", "gelmap.npy", "params.json", "raytac.npz", table_cache.CHECKSUMS)


def test_a_damaged_entry_is_baked_again_with_a_warning(baker: Callable[..., Any], tmp_path: Path) -> None:
    baker()
    damaged = entries(tmp_path)[0] / "polycalib.npz"
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.warns(RuntimeWarning, match=r"is damaged and is baked again: polycalib\.npz differs from its checksum"):
        table, baked = baker()
    assert baked == 2 and table.provenance == {"source": "made up 2"}
    assert baker()[1] == 2 and len(entries(tmp_path)) == 1


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty", "missing"])
@pytest.mark.parametrize("name", FILES)
def test_damage_to_any_file_is_told(tmp_path: Path, name: str, harm: str) -> None:
    folder = tmp_path / "key"
    assert table_cache.keep(made_up(1), folder) and table_cache.cached(folder) is not None
    data = bytearray((folder / name).read_bytes())
    if harm == "missing":
        (folder / name).unlink()
    else:
        data[len(data) // 2] ^= 0x10
        (folder / name).write_bytes({"cut": data[: len(data) // 2], "flipped": data, "empty": b""}[harm])
    with pytest.warns(RuntimeWarning, match="damaged and is baked again"):
        assert table_cache.cached(folder) is None
    assert table_cache.keep(made_up(2), folder)
    table = table_cache.cached(folder)
    assert table is not None and table.provenance == {"source": "made up 2"} and [*tmp_path.iterdir()] == [folder]


def test_a_change_that_no_reader_would_notice_is_noticed(tmp_path: Path) -> None:
    """The height of the gel at rest has no checksum of its own, and any height is a valid one."""
    folder = tmp_path / "key"
    table_cache.keep(made_up(1), folder)
    gel = np.load(folder / "gelmap.npy")
    gel[3, 4] = 17.0
    np.save(folder / "gelmap.npy", gel)
    with pytest.warns(RuntimeWarning, match=r"gelmap\.npy differs from its checksum"):
        assert table_cache.cached(folder) is None


def test_files_of_another_table_do_not_mix_in(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    for seed, folder in enumerate((one, other)):
        table_cache.keep(made_up(seed), folder)
    (one / "shadowTable.npz").write_bytes((other / "polycalib.npz").read_bytes())
    (other / "raytac.npz").write_bytes((one / "raytac.npz").read_bytes())
    for folder in (one, other):
        with pytest.warns(RuntimeWarning, match="baked again"):
            assert table_cache.cached(folder) is None


def test_what_is_no_folder_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "key"
    folder.write_text("a file of that name")
    assert table_cache.cached(folder) is None
    assert table_cache.keep(made_up(1), folder) and table_cache.cached(folder) is not None


def test_an_interrupt_leaves_nothing(baker: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(table: PolyTable, folder: Path) -> None:
        folder.mkdir()
        (folder / "polycalib.npz").write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(table_cache, "save_calibration", interrupted)
        with pytest.raises(KeyboardInterrupt):
            baker()
    assert entries(tmp_path) == []
    assert baker()[1] == 2


_WRITER = """
import sys
from pathlib import Path
from types import SimpleNamespace
from raytac.optics.taxim.cache import keep
from tests.optics.test_table_cache import made_up
for k in range(20):
    keep(made_up(int(sys.argv[1])), Path(sys.argv[2]) / str(k))
"""


def test_writers_at_once_leave_whole_tables(tmp_path: Path) -> None:
    """Readers find a whole table or none at any time, whoever is writing."""
    writers = [subprocess.Popen([sys.executable, "-c", _WRITER, str(k), str(tmp_path)]) for k in (1, 2)]
    read = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        while any(writer.poll() is None for writer in writers):
            read += sum(table_cache.cached(tmp_path / str(k)) is not None for k in range(20))
        assert [writer.returncode for writer in writers] == [0, 0] and read > 0
        found = [table_cache.cached(tmp_path / str(k)) for k in range(20)]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(str(k) for k in range(20))
    assert {table.provenance["source"] for table in found if table} <= {"made up 1", "made up 2"} and all(found)


def test_a_cache_that_cannot_be_written_is_done_without(
    baker: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "file"))
    for count in (1, 2):
        with pytest.warns(RuntimeWarning, match=r"file/tables cannot be written \(Not a directory\).*RAYTAC_CACHE") as told:
            table, baked = baker()
        assert baked == count and table.provenance == {"source": f"made up {count}"} and len(told) == 1


def test_a_disk_that_is_full_keeps_no_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(table_cache.os, "replace", full)
    with pytest.warns(RuntimeWarning, match="No space left on device"):
        assert not table_cache.keep(made_up(1), tmp_path / "key")
    assert list(tmp_path.iterdir()) == []


def test_without_a_home_folder_it_is_baked_and_not_kept(baker: Callable[..., Any], homeless: None) -> None:
    with pytest.warns(RuntimeWarning, match="there is no home folder"):
        assert baker()[1] == 1
