"""The cache of baked tables: found again, kept apart by what shapes a table, whole or not there."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io import code_digest
from raytac.optics import bake, table_cache
from raytac.optics.bake_settings import BakeSettings
from raytac.optics.table import PolyTable, TaximConstants
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

    def fake(sensor: SensorSpec, **arguments: Any) -> PolyTable:
        calls.append(arguments)
        return made_up(len(calls))

    monkeypatch.setattr(bake, "bake_table", fake)

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
    changed = tmp_path / "fast.py"
    changed.write_text("changed = True\n")
    sources = code_digest.module_sources
    monkeypatch.setattr(code_digest, "module_sources", lambda roots: sources(roots) | {"raytac.optics.fast": changed})
    assert table_cache.table_key(*asked) != before


@pytest.mark.parametrize("name", ["polycalib.npz", "dataPack.npz", "params.json", "raytac.npz"])
def test_a_truncated_entry_is_baked_again_with_a_warning(baker: Callable[..., Any], tmp_path: Path, name: str) -> None:
    baker()
    damaged = entries(tmp_path)[0] / name
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.warns(RuntimeWarning, match="damaged and is baked again"):
        table, baked = baker()
    assert baked == 2 and table.provenance == {"source": "made up 2"}
    assert baker()[1] == 2 and len(entries(tmp_path)) == 1


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
from raytac.optics.table_cache import keep
from tests.optics.test_table_cache import made_up
for k in range(40):
    keep(made_up(int(sys.argv[1])), Path(sys.argv[2]) / str(k))
"""


def test_writers_at_once_leave_whole_tables(tmp_path: Path) -> None:
    """Readers find a whole table or none at any time, whoever is writing."""
    writers = [subprocess.Popen([sys.executable, "-c", _WRITER, str(k), str(tmp_path)]) for k in (1, 2, 3)]
    read = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        while any(writer.poll() is None for writer in writers):
            read += sum(table_cache.cached(tmp_path / str(k)) is not None for k in range(40))
        assert [writer.returncode for writer in writers] == [0, 0, 0] and read > 0
        found = [table_cache.cached(tmp_path / str(k)) for k in range(40)]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(str(k) for k in range(40))
    assert {table.provenance["source"] for table in found if table} <= {"made up 1", "made up 2", "made up 3"} and all(found)


def test_a_cache_that_cannot_be_written_names_itself(
    baker: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "file"))
    with pytest.raises(InputError, match="RAYTAC_CACHE"):
        baker()


def test_root_of_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path / "own"))
    assert table_cache.cache_root() == tmp_path / "own"
    monkeypatch.delenv("RAYTAC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert table_cache.cache_root() == tmp_path / "xdg" / "raytac"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert table_cache.cache_root() == tmp_path / ".cache" / "raytac"
