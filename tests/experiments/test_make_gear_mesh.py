"""The gear script refuses gears that cannot be, before it writes."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from raytac.errors import InputError


@pytest.mark.parametrize("options", [{"teeth": 0}, {"teeth": 11}, {"module_mm": 0.0}, {"width_mm": 1.0}])
def test_impossible_gears_are_refused(options: dict[str, float], tmp_path: Path) -> None:
    script = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "make_gear_mesh.py"))
    (name,) = options
    with pytest.raises(InputError, match=name):
        script["main"](script["Args"](out=tmp_path / "out", **options))
    assert not (tmp_path / "out").exists()
