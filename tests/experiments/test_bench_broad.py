"""The benchmark of the broad phase, small."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from raytac.errors import InputError
from raytac.io.metrics import read_metrics

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """The experiment, which imports others as a script does."""
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        return importlib.import_module("bench_broad")
    finally:
        sys.path.remove(str(EXPERIMENTS))


@pytest.mark.parametrize("options", [{"scenes": "pile"}, {"envs": "0"}, {"seconds": 0.0}])
def test_bad_options_are_refused_before_anything_is_written(bench: ModuleType, tmp_path: Path, options: dict) -> None:
    with pytest.raises(InputError):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_every_scene_is_searched_both_ways(bench: ModuleType, tmp_path: Path) -> None:
    bench.main(bench.Args(out=tmp_path, device="cpu", most=800, envs="1,2", seconds=0.01, scenes="plate,mat,heap,peg"))
    found = read_metrics(tmp_path / "metrics.json")
    numbers = {key: float(value) for key, value in found.items() if not isinstance(value, str)}
    for key in ("cpu.plate.132", "cpu.mat.144", "cpu.heap.240x2", "cpu.peg.726x2"):
        assert numbers[f"{key}.pairs"] > 0 and numbers[f"{key}.lists_ms"] > 0 and numbers[f"{key}.bvh_ms"] > 0
        assert numbers[f"{key}.bvh_speedup"] == pytest.approx(numbers[f"{key}.lists_ms"] / numbers[f"{key}.bvh_ms"])
    assert numbers["cpu.peg.726x2.one_bvh_ms"] > 0 and "cpu.peg.726.one_bvh_ms" not in numbers
    assert not any(key.startswith("cpu.plate.1392") for key in numbers)
