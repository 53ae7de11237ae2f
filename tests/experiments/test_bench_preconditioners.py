"""Does ``experiments/bench_preconditioners.py`` run, and does the rest inverse save iterations there?"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    """The experiment, which imports its scene as scripts do."""
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        return importlib.import_module("bench_preconditioners")
    finally:
        sys.path.remove(str(EXPERIMENTS))


def test_metrics(bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "PRESS", 3)
    kinds = "block_jacobi,rest_alone,rest_inverse,rest_whole"
    assert bench.main(bench.Args(out=tmp_path, device="cpu", sizes="300", poisson="0.45", kinds=kinds)) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    its = {kind: metrics[f"cpu.300.nu45.{kind}.pcg_per_solve"] for kind in kinds.split(",")}
    assert 0 < its["rest_inverse"] < its["rest_alone"]
    assert its["rest_inverse"] < its["block_jacobi"] / 3
    assert abs(its["rest_inverse"] - its["rest_whole"]) <= 0.5


def test_unknown_kind_is_refused(bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(bench.Args(out=tmp_path / "none", device="cpu", kinds="multigrid")) == 2
    assert "rest_inverse" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
