"""What the command says before kernels are compiled."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import warp as wp

from raytac.cli import main
from raytac.cli.shared import SolverOptions
from raytac.warp_messages import has_compiled_kernels


def test_the_command_says_once_that_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    SolverOptions().prepare_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    caplog.clear()
    with caplog.at_level(logging.INFO, logger="raytac"):
        assert not has_compiled_kernels()
        SolverOptions().prepare_warp()
        assert [record.getMessage() for record in caplog.records] == ["compiling kernels: up to a minute, once on a machine"]
        (tmp_path / "wp_raytac.gel_0123456").mkdir()
        SolverOptions().prepare_warp()
        assert has_compiled_kernels() and len(caplog.records) == 1
        # A soft pad needs the solver's kernels too, which take longer.
        assert not has_compiled_kernels(solver=True)
        SolverOptions().prepare_warp(soft=True)
        assert len(caplog.records) == 2
        (tmp_path / "wp_ipc.solver.pcg_0123456").mkdir()
        SolverOptions().prepare_warp(soft=True)
    assert has_compiled_kernels(solver=True) and len(caplog.records) == 2


@pytest.mark.parametrize(
    ("command", "soft"),
    [
        ("dataset demo", False),
        ("dataset demo --physics ipc", True),
        ("play scripted --task LiftCube", False),
        ("play scripted --task LiftCube --physics ipc", True),
        ("play push_cube_ppo", False),
    ],
)
def test_a_command_asks_for_the_kernels_of_its_physics(
    command: str, soft: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Asked(Exception):
        pass

    def prepare_warp(self: SolverOptions, *, soft: bool = False) -> None:
        raise Asked(soft)

    monkeypatch.setattr(SolverOptions, "prepare_warp", prepare_warp)
    with pytest.raises(Asked) as asked:
        main([*command.split(), "--out", str(tmp_path)])
    assert asked.value.args == (soft,)
