"""The script of random presses: what it draws, what it counts, and that it goes on where it was stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import stress
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.physics.soft.pad import SoftPad
from raytac.sensor import TactileSensor
from raytac.specs import load_press, load_sensor
from raytac.specs.press import PressScene, StageSpec


def small_press(physics: str, seed: int, number: int, deepest: float) -> tuple[str, str, PressScene]:
    """A light press of a ball, a millimetre to the right for each number; the second is refused, as it begins off the pad."""
    place = (0.09 if number == 1 else 1e-3 * number, 0.0, 0.0)
    thing = replace(load_press("sphere").object, position=place)
    return "gelsight_mini", "sphere", PressScene("sphere", thing, (StageSpec("indent", depth=0.1e-3),))


def test_presses_are_drawn_by_seed_and_number_and_fit_the_pad() -> None:
    drawn = [stress.random_press("ipc", 0, number, 0.6) for number in range(50)]
    assert drawn[7] == stress.random_press("ipc", 0, 7, 0.6) != stress.random_press("ipc", 1, 7, 0.6)
    assert {name for _, name, _ in drawn} == set(stress.OBJECTS) and {sensor for sensor, _, _ in drawn} == set(stress.SENSORS)
    for sensor, _, scene in drawn:
        gelpad, stage = load_sensor(sensor).gelpad, scene.trajectory[0]
        assert (np.abs(scene.object.position[:2]) < 0.5 * np.asarray(gelpad.size)).all()
        assert stage.depth is None or 0.0 < stage.depth <= 0.6 * gelpad.thickness
    assert max(scene.trajectory[0].depth or 0.0 for _, _, scene in drawn) > 2e-3
    assert {kind for _, _, scene in drawn for kind in [stage.kind for stage in scene.trajectory]} == {"indent", "shear", "twist"}
    assert all(scene.object.dynamics != "soft" for _, _, scene in (stress.random_press("rigid", 0, n, 0.9) for n in range(20)))


def test_a_run_counts_what_it_finds_and_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stress, "random_press", small_press)
    options: dict[str, Any] = {"out": tmp_path, "device": "cpu", "rigid": 4, "ipc": 3}
    with monkeypatch.context() as patch:
        write, calls = stress.store, []

        def stop(*record: Any) -> None:
            write(*record)
            calls.append(record)
            if len(calls) == 5:
                raise KeyboardInterrupt

        patch.setattr(stress, "store", stop)
        with pytest.raises(KeyboardInterrupt):
            stress.main(stress.Args(**options))
    assert not (tmp_path / "metrics.json").exists() and "rigid 4 of 4" in capsys.readouterr().out
    stress.main(stress.Args(**options))
    assert "rigid" not in [line.split()[0] for line in capsys.readouterr().out.splitlines()]  # those are done
    found = read_metrics(tmp_path / "metrics.json")
    for physics, presses in (("rigid", 4), ("ipc", 3)):
        assert found[f"stress.{physics}.presses"] == found[f"stress.{physics}.shallow"] == presses
        assert found[f"stress.{physics}.refused"] == 1 and found[f"stress.{physics}.exceptions"] == 0
        assert found[f"stress.{physics}.failed"] == found[f"stress.{physics}.nonfinite"] == 0
    assert found["stress.rigid.below_bond"] == found["stress.rigid.unbalanced"] == found["stress.ipc.unmarked"] == 0
    with pytest.raises(InputError, match="other settings"):
        stress.main(stress.Args(**options, seed=1))


def test_what_is_wrong_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each fault is found where it is, and what is marked as failed counts for none."""
    monkeypatch.setattr(stress, "random_press", small_press)
    args = stress.Args(device="cpu")
    sensors = {"gelsight_mini": stress.make_sensor("gelsight_mini", "rigid", args, "cpu")}
    update = TactileSensor.update

    def spoilt(change):
        def updated(sensor: TactileSensor, state: Any) -> Any:
            frame = update(sensor, state)
            change(frame)
            return frame

        return updated

    def raises(frame: Any) -> None:
        raise IndexError("index -9223372036854775808")

    faults = {
        "below_bond": lambda frame: frame.surface.height.fill(-4.1e-3),
        "unbalanced": lambda frame: frame.traction.__imul__(1.02),
        "nonfinite": lambda frame: frame.traction.fill(np.nan),
        "failed": lambda frame: (frame.failed.fill(True), frame.surface.height.fill(-1.0)),
        "exception": raises,
    }
    for key, change in faults.items():
        monkeypatch.setattr(TactileSensor, "update", spoilt(change))
        row = stress.pressed("rigid", 0, args, sensors)
        assert row[key] and not (key == "failed" and row.get("below_bond"))
        found = stress.summary("rigid", [row])
        assert found["presses"] == 1 and found["exceptions" if key == "exception" else key] == 1
        assert ("IndexError" if key == "exception" else key) in stress.line(row)


def test_states_of_the_soft_pad_that_are_not_sound_are_seen() -> None:
    args = stress.Args(device="cpu")
    sensor = stress.make_sensor("gelsight_mini", "ipc", args, "cpu")
    _, _, scene = small_press("ipc", 0, 0, 0.6)
    pad = sensor.load(scene)
    assert isinstance(pad, SoftPad) and pad.solver is not None
    frame = sensor.update(pad.peak(pad.run()))
    assert stress.soft_faults(pad, frame) | {"unconverged_steps": 0} == {
        "failed": False,
        "unconverged_steps": 0,
        "penetrating": False,
        "nonfinite": False,
        "unconverged": False,
    }
    pad.solver.converged[0] = False
    # The object 1 mm deeper than the solver left it.
    state, body = pad.solver.world._potential, pad.solver.world.layout.names.index("object")
    position = state.t.numpy()
    position[0, body, 2] -= 1e-3
    state.t.assign(position)
    state.place_vertices(state.y, state.R, state.t, state.x)
    frame.wrench[0, 0] = np.inf
    row = stress.soft_faults(pad, frame) | {"share": 0.1}
    assert row["penetrating"] and row["nonfinite"] and row["unconverged"]
    assert stress.summary("ipc", [row])["unmarked"] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [({"physics": "mpm"}, "physics"), ({"ipc": 0}, "ipc = 0"), ({"deepest": 1.0}, "deepest"), ({"pad": "huge"}, "pad")],
)
def test_bad_options_are_told(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        stress.main(stress.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_sixty_presses_anywhere_on_the_soft_pad_are_sound_or_say_that_they_are_not(tmp_path: Path) -> None:
    found = stress.main(stress.Args(out=tmp_path, physics="ipc", ipc=60, deepest=0.6, seed=7, device="cpu"))
    assert found["stress.ipc.presses"] == 60
    for key in ("exceptions", "refused", "unmarked"):
        assert found[f"stress.ipc.{key}"] == 0, key
    assert int(found["stress.ipc.failed"]) <= 3
