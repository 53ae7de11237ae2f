"""Kept presses: what was written is read, under no other circumstances, and nothing half-written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.gel.coat_mesh import DeformedCoat
from raytac.markers.calibration_presses import QUICK_FIT, PressStates
from raytac.report.press_store import PressStore, press_code
from raytac.specs import SensorSpec, load_sensor
from tests.markers.pads import coat_mesh

PRESS = QUICK_FIT[0]


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    return load_sensor("gelsight_mini")


@pytest.fixture
def states(sensor: SensorSpec) -> PressStates:
    mesh, rng = coat_mesh(sensor), np.random.default_rng(0)
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, :3, 3] = rng.standard_normal((3, 3))
    return PressStates(
        ("start", "normal", "shear"), poses, DeformedCoat(mesh, mesh.rest + rng.standard_normal((3, *mesh.rest.shape)))
    )


def store(
    folder: Path, sensor: SensorSpec, said: list[str], pad: str = "coarse", device: str = "cpu", code: str = "0"
) -> PressStore:
    return PressStore(folder, sensor.gelpad, pad=pad, device=device, code=code, say=said.append)


def test_a_press_is_read_back_by_another_store(tmp_path: Path, sensor: SensorSpec, states: PressStates) -> None:
    said: list[str] = []
    store(tmp_path, sensor, said).write(PRESS, states)
    again = store(tmp_path, sensor, said)
    kept = again.read(PRESS)
    assert kept is not None and again.reused == 1 and not said
    assert kept.loads == states.loads
    np.testing.assert_array_equal(kept.poses, states.poses)
    np.testing.assert_array_equal(kept.coat.positions, states.coat.positions)
    for name in ("rest", "faces", "lines_x", "lines_y"):
        np.testing.assert_array_equal(getattr(kept.coat.mesh, name), getattr(states.coat.mesh, name))
    assert len(list(tmp_path.iterdir())) == 1


def test_it_is_of_this_press_gel_pad_device_and_code_only(tmp_path: Path, sensor: SensorSpec, states: PressStates) -> None:
    said: list[str] = []
    store(tmp_path, sensor, said).write(PRESS, states)
    softer = replace(sensor, gelpad=replace(sensor.gelpad, youngs_modulus=1e5))
    assert store(tmp_path, sensor, said).read(replace(PRESS, depth=PRESS.depth * 1.01)) is None
    assert store(tmp_path, softer, said).read(PRESS) is None
    assert store(tmp_path, sensor, said, pad="medium").read(PRESS) is None
    assert store(tmp_path, sensor, said, device="cuda").read(PRESS) is None
    assert store(tmp_path, sensor, said, code="1").read(PRESS) is None
    assert store(tmp_path, sensor, said).read(PRESS) is not None and not said


@pytest.mark.solver
def test_the_code_is_that_of_solver_physics_and_presses(monkeypatch: pytest.MonkeyPatch) -> None:
    before, read = press_code(), Path.read_bytes
    seen = set()

    def edited(path: Path) -> bytes:
        seen.add(f"{path.parent.name}/{path.name}")
        return read(path) + (b"\n" if path.name == "newton.py" else b"")

    monkeypatch.setattr(Path, "read_bytes", edited)
    assert press_code() != before  # a line more in the solver
    assert {"soft/pad.py", "rigid/pad.py", "soft/coat_surface.py"} <= seen
    assert {"friction.py", "calibration_presses.py"} <= {name.partition("/")[2] for name in seen}


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty"])
def test_a_damaged_file_is_said_and_not_used(harm: str, tmp_path: Path, sensor: SensorSpec, states: PressStates) -> None:
    said: list[str] = []
    kept = store(tmp_path, sensor, said)
    kept.write(PRESS, states)
    (path,) = tmp_path.iterdir()
    data = bytearray(path.read_bytes())
    if harm == "flipped":
        data[len(data) // 2] ^= 0xFF
    path.write_bytes(data if harm == "flipped" else data[: len(data) // 2 if harm == "cut" else 0])
    assert kept.read(PRESS) is None and kept.reused == 0
    assert len(said) == 1 and "pressed again" in said[0] and path.name in said[0]


def test_an_interrupt_while_writing_leaves_nothing(
    tmp_path: Path, sensor: SensorSpec, states: PressStates, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("raytac.io.atomic.os.fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        store(tmp_path, sensor, []).write(PRESS, states)
    assert list(tmp_path.iterdir()) == []
