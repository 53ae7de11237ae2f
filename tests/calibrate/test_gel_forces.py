"""A gel fitted to forces: from a pad's own forces its stiffness comes back, and a rig's yield is told from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate import ForceTable, GelFit, ball_forces, fit_gel, modulus_factor
from raytac.calibrate.gel_forces import RATIOS, fits_of
from raytac.cli import main
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.physics import Ipc, Rigid
from raytac.report.gel_forces import check_apart
from raytac.specs import SensorSpec, load_sensor

RADIUS, DEPTHS = 7.5e-3, 1e-3 * np.array([0.5, 1.0, 1.5, 2.0])
MINI = load_sensor("gelsight_mini")


def with_gel(sensor: SensorSpec, modulus: float, ratio: float) -> SensorSpec:
    return replace(sensor, gelpad=replace(sensor.gelpad, youngs_modulus=modulus, poisson_ratio=ratio))


def table_file(path: Path, depth: np.ndarray, force: np.ndarray) -> Path:
    rows = [f"{1e3 * d:.6g},{f:.9g}" for d, f in zip(depth, force, strict=True)]
    path.write_text("\n".join(["# made up", "depth_mm,force_n", *rows]) + "\n", "utf-8")
    return path


def by_name(fits: list[GelFit]) -> dict[str, GelFit]:
    return {fit.name: fit for fit in fits}


@pytest.mark.parametrize(("modulus", "ratio"), [(615e3, 0.42), (250e3, 0.47)])
def test_a_gels_modulus_and_ratio_are_recovered(modulus: float, ratio: float) -> None:
    """From four forces of a rigid pad; a modulus alone leaves errors at depths that it was not fitted to."""
    force = ball_forces(with_gel(MINI, modulus, ratio), [Rigid()], RADIUS, DEPTHS)[0]
    fits = by_name(fit_gel(MINI, ForceTable(DEPTHS, force), RADIUS, [Rigid()]))
    both = fits["poisson_ratio"]
    assert both.youngs_modulus == pytest.approx(modulus, rel=0.02) and both.poisson_ratio == pytest.approx(ratio, abs=0.006)
    assert np.abs(both.held_out).max() < 0.01
    assert fits["modulus"].poisson_ratio == MINI.gelpad.poisson_ratio
    assert fits["modulus"].held_out_rms > 3.0 * both.held_out_rms


def test_a_rig_that_yields_is_recovered() -> None:
    """Forces of the sensor's own gel, 1.3 times as stiff, on a rig of 8 µm/N: each depth is the gel's and the rig's."""
    gel_depths = np.linspace(0.1e-3, 2.0e-3, 40)
    own = 1.3 * ball_forces(MINI, [Rigid()], RADIUS, gel_depths)[0]
    force = np.interp(DEPTHS, gel_depths + 8e-6 * own, own)
    fit = by_name(fit_gel(MINI, ForceTable(DEPTHS, force), RADIUS, [Rigid()]))["compliance"]
    assert fit.compliance == pytest.approx(8e-6, rel=0.1) and fit.poisson_ratio == MINI.gelpad.poisson_ratio
    assert fit.youngs_modulus == pytest.approx(1.3 * MINI.gelpad.youngs_modulus, rel=0.03)
    assert np.abs(fit.held_out).max() < 0.02


def test_a_held_out_depth_has_no_part_in_its_own_error() -> None:
    """A force that is off by a half changes the errors at other depths, and its own by what it is off itself."""
    presses = {ratio: np.array([DEPTHS**1.9 * (1.0 + ratio * 1e3 * DEPTHS) * 1e7]) for ratio in RATIOS}
    force = presses[0.44][0]
    right = by_name(fits_of(presses, 0.44, ForceTable(DEPTHS, force), 1e5))
    wrong = by_name(fits_of(presses, 0.44, ForceTable(DEPTHS, force * [1.0, 1.0, 1.0, 1.5]), 1e5))
    assert np.abs(right["modulus"].held_out).max() < 1e-9 and np.abs(right["poisson_ratio"].held_out).max() < 1e-3
    for name in ("modulus", "poisson_ratio"):
        assert wrong[name].held_out[0, 3] == pytest.approx((1.0 + right[name].held_out[0, 3]) / 1.5 - 1.0, abs=1e-9)
        assert np.abs(wrong[name].held_out[0, :3]).min() > 0.01


def test_two_pads_are_fitted_together_and_two_depths_give_a_modulus_alone() -> None:
    pads = Rigid(), Ipc(level="coarse")
    depth = DEPTHS[:2]
    forces = ball_forces(MINI, pads, RADIUS, depth, device="cpu")
    assert forces.shape == (2, 2) and abs(forces[1, 1] / forces[0, 1] - 1.0) > 0.05
    presses = {ratio: forces for ratio in RATIOS}
    (fit,) = fits_of(presses, 0.48, ForceTable(depth, 1.2 * forces[0]), 430e3)
    assert fit.name == "modulus" and fit.held_out.shape == (2, 2)
    alone = [430e3 * modulus_factor(force, 1.2 * forces[0]) for force in forces]
    assert alone[0] == pytest.approx(1.2 * 430e3) and alone[1] + 5e3 < fit.youngs_modulus < alone[0] - 5e3
    with pytest.raises(InputError, match="at least one pad"):
        fit_gel(MINI, ForceTable(depth, forces[0]), RADIUS, [])


def test_the_command_writes_a_sensor_that_presses_as_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    force = ball_forces(with_gel(MINI, 615e3, 0.42), [Rigid()], RADIUS, DEPTHS)[0]
    data, out = table_file(tmp_path / "forces.csv", DEPTHS, force), tmp_path / "run"
    command = ["calibrate", str(data), "--ball-diameter-mm", "15", "--pads", "rigid", "--device", "cpu"]
    assert main([*command, "--out", str(out)]) == 0
    text, metrics = capsys.readouterr().out, read_metrics(out / "metrics.json")
    assert "Written: modulus and Poisson's ratio" in text and "held" not in (out / "sensor.toml").read_text("utf-8").split("[")[1]
    sensor = load_sensor(out / "sensor.toml")
    assert sensor.gelpad.youngs_modulus == pytest.approx(615e3, rel=0.02)
    assert replace(sensor, gelpad=MINI.gelpad, name=MINI.name, source=MINI.source) == MINI
    np.testing.assert_allclose(ball_forces(sensor, [Rigid()], RADIUS, DEPTHS)[0], force, rtol=0.01)
    assert max(abs(float(metrics[f"error.rigid.{name}"])) for name in ("0.5", "1", "1.5", "2")) < 0.01
    # A sensor of the user's own is named by the path from the new file to it.
    again = ["--sensor", str(out / "sensor.toml"), "--out", str(tmp_path / "again")]
    assert main([*command, *again]) == 0
    assert 'base = "../run/sensor.toml"' in (tmp_path / "again" / "sensor.toml").read_text("utf-8")
    assert load_sensor(tmp_path / "again" / "sensor.toml").gelpad.youngs_modulus == pytest.approx(615e3, rel=0.02)


def test_tables_and_options_that_say_nothing_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = {
        "depth_mm\n1\n": "columns",
        "depth_mm,force_n\n1,x\n2,3\n": "numbers",
        "depth_mm,force_n\n1,2\n1,3\n": "each depth once",
        "depth_mm,force_n\n1,-2\n2,3\n": "above 0",
    }
    for text, message in cases.items():
        (tmp_path / "force.csv").write_text(text, "utf-8")
        with pytest.raises(InputError, match=message):
            ForceTable.read(tmp_path / "force.csv")
    with pytest.raises(InputError, match="cannot be read"):
        ForceTable.read(tmp_path / "none.csv")
    data, out = table_file(tmp_path / "force.csv", DEPTHS, np.array([1.0, 3.0, 7.0, 12.0])), tmp_path / "run"
    options = {
        "ball_diameter_mm": [],
        "pads": ["--ball-diameter-mm", "15", "--pads", "hard"],
        "sides": ["--ball-diameter-mm", "15", "--sides", "4,2,3"],
        "level": ["--ball-diameter-mm", "15", "--level", "coarse"],
    }
    for name, option in options.items():
        assert main(["calibrate", str(data), *option, "--device", "cpu", "--out", str(out)]) == 2
        assert name in capsys.readouterr().err
    assert not out.exists()


def test_the_sensors_own_file_is_never_written_over(tmp_path: Path) -> None:
    own = tmp_path / "gel" / "sensor.toml"
    own.parent.mkdir()
    own.write_text('base = "gelsight_mini"\n', "utf-8")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.toml").write_text('base = "../gel/sensor.toml"\n', "utf-8")
    for source in (own, tmp_path / "other" / "mine.toml"):
        with pytest.raises(InputError, match=r"read from sensor\.toml in it"):
            check_apart(source, own.parent)
        check_apart(source, tmp_path / "fitted")
    assert own.read_text("utf-8") == 'base = "gelsight_mini"\n'


@pytest.mark.parametrize(("ratio", "at_end"), [(0.20, True), (0.42, False), (0.495, True)])
def test_a_ratio_at_an_end_of_what_is_tried_is_marked(ratio: float, at_end: bool) -> None:
    force = ball_forces(with_gel(MINI, 430e3, ratio), [Rigid()], RADIUS, DEPTHS)[0]
    assert by_name(fit_gel(MINI, ForceTable(DEPTHS, force), RADIUS, [Rigid()]))["poisson_ratio"].at_end is at_end
