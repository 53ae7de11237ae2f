"""A digest of code: of all that a module imports, and of nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from raytac.io.code_digest import code_digest, module_sources


def test_code_of_a_mode_is_all_that_it_imports() -> None:
    names = set(module_sources(["raytac.optics.trace.fast_tracer"]))
    assert {
        "raytac.optics.trace.interreflection",
        "raytac.optics.trace.reference",
        "raytac.optics.response",
        "raytac.gel.surface",
    } <= names
    assert all(name.startswith(("raytac.optics", "raytac.gel")) for name in names)
    assert "raytac.optics.trace.fast_tracer" not in module_sources(["raytac.optics.trace.reference"])
    assert not module_sources(["raytac.optics.no_such_module"])


def test_code_of_a_table_is_that_of_its_bake_and_not_of_the_mode_that_uses_it() -> None:
    baked, used = (set(module_sources([f"raytac.optics.taxim.{name}"])) for name in ("bake.bake", "mode"))
    assert {
        "raytac.gel.pyramid",
        "raytac.shapes.underside",
        "raytac.optics.trace.fast_tracer",
        "raytac.optics.taxim.bake.shadow",
    } <= baked
    assert not {"raytac.optics.taxim.mode", "raytac.optics.taxim.shadow", "raytac.optics.image.phong"} & baked
    assert used >= baked | {"raytac.optics.taxim.shadow"}  # the mode imports the bake, inside a function


def test_digest_changes_with_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = code_digest("raytac.optics.camera")
    assert before == code_digest("raytac.optics.camera") != code_digest("raytac.optics.response")
    changed = tmp_path / "camera.py"
    changed.write_text("x = 1\n")
    monkeypatch.setattr("raytac.io.code_digest.module_sources", lambda roots: {"raytac.optics.camera": changed})
    one = code_digest("raytac.optics.camera")
    changed.write_text("x = 2\n")
    assert one != code_digest("raytac.optics.camera")
