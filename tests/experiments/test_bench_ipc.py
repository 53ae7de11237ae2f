"""The solver's benchmarks, small, and the scenes that they time."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io.metrics import read_metrics

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def modules() -> dict[str, ModuleType]:
    """The experiments, which import each other as scripts do."""
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        names = ("bench_ipc_scenes", "bench_ipc", "bench_ipc_accuracy", "bench_ipc_pyuipc")
        return {name: importlib.import_module(name) for name in names}
    finally:
        sys.path.remove(str(EXPERIMENTS))


@pytest.fixture
def small(modules: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """Coarse pads under the known names."""
    cells = {300: (4, 4, 1), 1400: (6, 8, 2), 5300: (4, 4, 2), 18000: (6, 6, 2)}
    for module in modules.values():
        monkeypatch.setattr(module, "CELLS", cells)
    return modules


@pytest.mark.parametrize("options", [{"sizes": "300,17"}, {"envs": "0"}, {"envs": "two"}, {"spread": 1.0}, {"limit_s": 0.0}])
def test_bad_options_are_refused_before_anything_is_written(
    modules: dict[str, ModuleType], tmp_path: Path, options: dict
) -> None:
    bench = modules["bench_ipc"]
    with pytest.raises(InputError):
        bench.main(bench.Args(out=tmp_path / "out", device="cpu", **options))
    assert not (tmp_path / "out").exists()


def test_press_is_timed_for_each_size_and_number_of_environments(small: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = small["bench_ipc"]
    assert bench.main(bench.Args(out=tmp_path, device="cpu", sizes="300,5300", envs="1,3", spread=0.5, stages=True)) == 0
    found = read_metrics(tmp_path / "metrics.json")
    numbers = {key: float(value) for key, value in found.items() if not isinstance(value, str)}
    for key in ("cpu.300", "cpu.300x3", "cpu.5300"):
        assert numbers[f"{key}.ms_per_step"] > 0 and numbers[f"{key}.first_step_s"] > 0 and numbers[f"{key}.ms_per_hold_step"] > 0
        assert numbers[f"{key}.converged"] == 1 and numbers[f"{key}.steps"] == 25 and numbers[f"{key}.min_gap_um"] > 0
        assert math.isfinite(numbers[f"{key}.memory_mb_per_env"]) and numbers[f"{key}.force_n"] > 0.01
        stages = {name: value for name, value in numbers.items() if name.startswith(f"{key}.stage_ms.")}
        whole = stages.pop(f"{key}.stage_ms.step")
        assert len(stages) > 5 and 0.5 * whole < sum(stages.values()) < 1.001 * whole
    assert numbers["cpu.300.vertices"] == 5 * 5 * 2 and "cpu.5300x3.ms_per_step" not in numbers
    assert numbers["cpu.300x3.env_steps_per_s"] > 0
    # Each environment goes less deep than it might: with differing depths the most loaded is the deepest.
    assert numbers["cpu.300x3.force_n"] > numbers["cpu.300.force_n"]


def test_a_checkout_is_compared_with_one_that_is_there(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = modules["bench_ipc"]
    with pytest.raises(InputError, match="must be a checkout of this project"):
        bench.main(bench.Args(out=tmp_path / "out", sizes="300", against=tmp_path))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_steps_of_a_checkout_in_turn_with_its_own(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = modules["bench_ipc"]
    bench.main(bench.Args(out=tmp_path, sizes="300", against=EXPERIMENTS.parent))
    found = read_metrics(tmp_path / "metrics.json")
    ratios = [float(value) for key, value in found.items() if key.startswith("cpu.300.speedup_vs_")]
    assert len(ratios) == 1 and 0.5 < ratios[0] < 2.0
    assert float(found["cpu.300.speedup_least"]) <= float(found["cpu.300.speedup_most"])


def test_a_measurement_stops_when_its_time_is_up(small: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = small["bench_ipc"]
    bench.main(bench.Args(out=tmp_path, device="cpu", sizes="300", limit_s=1e-6))
    assert read_metrics(tmp_path / "metrics.json")["cpu.300.steps"] == 2


def test_the_sphere_is_driven_down_and_then_rests(modules: dict[str, ModuleType]) -> None:
    scenes = modules["bench_ipc_scenes"]
    heights = np.array([scenes.ball_height(step) for step in range(scenes.PRESS + scenes.HOLD)])
    assert heights[scenes.PRESS - 1] == pytest.approx(scenes.RADIUS + scenes.GAP - 1e-3, abs=1e-15)
    assert np.ptp(np.diff(heights[: scenes.PRESS])) < 1e-15 and np.ptp(heights[scenes.PRESS - 1 :]) == 0


def test_sizes_are_what_their_names_say(modules: dict[str, ModuleType]) -> None:
    scenes = modules["bench_ipc_scenes"]
    for size, cells in scenes.CELLS.items():
        assert abs(math.prod(n + 1 for n in cells) / size - 1) < 0.03
    assert 130 <= math.prod(n + 1 for n in scenes.PEG_CELLS) <= 145


def test_the_hole_is_a_closed_surface_with_the_volume_of_a_block_less_the_hole(modules: dict[str, ModuleType]) -> None:
    half, chamfer, depth, outer = 2.0, 0.5, 3.0, 5.0
    hole = modules["bench_ipc_scenes"].square_hole(half, chamfer, depth, outer)
    edges = np.concatenate([hole.faces[:, [0, 1]], hole.faces[:, [1, 2]], hole.faces[:, [2, 0]]])
    forward, backward = {tuple(e) for e in edges}, {tuple(e[::-1]) for e in edges}
    assert len(forward) == len(edges) and forward == backward
    corners = hole.vertices[hole.faces]
    volume = np.linalg.det(corners).sum() / 6
    # The chamfer's part is a frustum of a pyramid.
    low, high = (2 * half) ** 2, (2 * (half + chamfer)) ** 2
    removed = low * (depth - chamfer) + chamfer / 3 * (low + high + math.sqrt(low * high))
    assert volume == pytest.approx((2 * outer) ** 2 * depth - removed)


def test_the_grip_closes_evenly_and_holds_the_peg_against_gravity(modules: dict[str, ModuleType]) -> None:
    scenes = modules["bench_ipc_scenes"]
    world = scenes.peg_world(2, "cpu")
    pads = 2 * math.prod(scenes.PEG_PAD) * scenes.PEG_THICKNESS
    phases, weight = [], 1000.0 * (scenes.PEG_SIDE**2 * scenes.PEG_LENGTH + pads) * scenes.GRAVITY
    for phase in scenes.peg_drive(world):
        report = world.step()
        assert report.converged.all() and (report.min_gap > 0).all() and (report.min_det > 0.5).all()
        phases.append(phase)
        if phases.count("lower") == 3:
            break
    left, right = world.wrench("left").force, world.wrench("right").force
    # Equal and opposite across, and together they carry the peg and the gel, which move evenly: to 3 %, since what sticks is so stiff
    # that the 20 µm at which a step stops are felt.
    np.testing.assert_allclose(left[:, 0], -right[:, 0], rtol=1e-3)
    assert (right[:, 0] > 1.0).all()
    np.testing.assert_allclose((left + right)[:, 2], -weight, rtol=0.03)
    A, p = world.affine_pose("peg")
    slip = p[:, 2] - world.frame("left")[1][:, 2]
    assert (np.abs(slip) < 20e-6).all() and (np.abs(p[:, :2]) < 1e-6).all()
    # A step stops when nothing would move 20 µm any more: 1 mrad at the peg's ends.
    np.testing.assert_allclose(A, np.broadcast_to(np.eye(3), A.shape), atol=1e-3)
    np.testing.assert_allclose(p[0], p[1], atol=1e-9)
    assert p[0, 2] == pytest.approx(-3 * scenes.PEG_SPEED * scenes.PEG_DT, abs=20e-6)


@pytest.mark.slow
def test_the_peg_finds_its_way_into_the_hole(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    bench = modules["bench_ipc"]
    bench.main(bench.Args(out=tmp_path, device="cpu", pads="peg", envs="2"))
    found = read_metrics(tmp_path / "metrics.json")
    assert found["cpu.peg140x2.converged"] == 1 and float(found["cpu.peg140x2.min_gap_um"]) > 0
    # It started further off the axis than the clearance, so it got in by way of the chamfer, pushed aside by its walls.
    assert 9.4 < float(found["cpu.peg140x2.lowered_mm"]) < 9.7 and float(found["cpu.peg140x2.slip_um"]) < 100
    assert float(found["cpu.peg140x2.hole_force_n"]) > 0.05 and 0.1 < float(found["cpu.peg140x2.tilt_deg"]) < 3


def test_heights_of_an_affine_surface_are_exact(modules: dict[str, ModuleType]) -> None:
    accuracy = modules["bench_ipc_accuracy"]
    rng = np.random.default_rng(0)
    line = np.linspace(-1, 1, 7)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    inner = (np.abs(x) < 1) & (np.abs(y) < 1)
    x, y = x + 0.1 * inner * rng.uniform(-1, 1, x.size), y + 0.1 * inner * rng.uniform(-1, 1, y.size)
    corner = (np.arange(6)[:, None] * 7 + np.arange(6)).ravel()
    triangles = np.concatenate(
        [np.stack(t, axis=1) for t in ((corner, corner + 1, corner + 8), (corner, corner + 8, corner + 7))]
    )
    plane = 0.3 + 0.7 * x - 0.2 * y
    at = np.linspace(-0.99, 0.99, 40)
    u, v = np.meshgrid(at, at)
    heights = accuracy.surface_heights(np.stack([x, y, plane], axis=1), triangles, u, v)
    np.testing.assert_allclose(heights, 0.3 + 0.7 * u - 0.2 * v, atol=1e-12)
    # A bent surface is linear on its triangles: exact at the vertices, not between them.
    bent = accuracy.surface_heights(np.stack([x, y, x**2], axis=1), triangles, x[inner], y[inner])
    np.testing.assert_allclose(bent, x[inner] ** 2, atol=1e-12)
    assert np.isnan(accuracy.surface_heights(np.stack([x, y, plane], axis=1), triangles, 1.5, 0.0))


def test_accuracy_keeps_its_reference_and_errs_less_on_a_finer_pad(
    small: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    accuracy = small["bench_ipc_accuracy"]
    options = {"device": "cpu", "tolerances": "1e-3,1e-5", "reference": 1400}
    accuracy.main(accuracy.Args(out=tmp_path, sizes="300,1400", **options))
    found = read_metrics(tmp_path / "metrics.json")
    # The reference's own mesh shows what the tolerance does, and at the reference's tolerance there is nothing to show.
    assert 0 < float(found["cpu.mirrored.1400.1e-3.rms_um.contact"]) < 0.1 * float(found["cpu.mirrored.300.1e-3.rms_um.contact"])
    assert "cpu.mirrored.1400.1e-5.rms_um.contact" not in found
    assert float(found["cpu.300.1e-5.max_um.around"]) >= float(found["cpu.300.1e-5.rms_um.around"]) > 0
    assert 0 < float(found["cpu.1400.1e-5.force_error"]) < float(found["cpu.300.1e-5.force_error"])
    assert 0 < float(found["cpu.1400.1e-3.tolerance_rms_um.contact"]) < float(found["cpu.1400.1e-3.rms_um.contact"])
    assert (tmp_path / "error_cost.png").stat().st_size > 10_000
    capsys.readouterr()
    kept = list((tmp_path / "references").iterdir())
    accuracy.main(accuracy.Args(out=tmp_path, sizes="300", **options))
    assert list((tmp_path / "references").iterdir()) == kept and "kept as" not in capsys.readouterr().out
    again = read_metrics(tmp_path / "metrics.json")
    assert again["cpu.300.1e-5.rms_um.contact"] == found["cpu.300.1e-5.rms_um.contact"]


@pytest.mark.parametrize(
    ("case", "parsed"),
    [("1400", (1400, 1, "diag")), ("128x1400-mas", (1400, 128, "mas")), ("cube", "cube"), ("doctor", "doctor")],
)
def test_cases_of_the_comparison(modules: dict[str, ModuleType], case: str, parsed: object) -> None:
    assert modules["bench_ipc_pyuipc"].parse_case(case) == parsed


@pytest.mark.parametrize("case", ["1400-amg", "0x300", "x300", "13", "cubes", "300x128"])
def test_unknown_cases_of_the_comparison_are_refused(modules: dict[str, ModuleType], case: str) -> None:
    with pytest.raises(InputError):
        modules["bench_ipc_pyuipc"].parse_case(case)


def test_coefficients_give_the_moduli_that_are_asked_for(modules: dict[str, ModuleType]) -> None:
    """Second derivatives at rest of both energies along a uniaxial strain and in shear: λ + 2 μ and μ of linear elasticity."""
    mu_l, lam_l = 3.4e4, 3.1e5

    def plain(F: np.ndarray, mu: float, lam: float) -> float:
        J = np.linalg.det(F)
        return mu / 2 * ((F**2).sum() - 3) - mu * (J - 1) + lam / 2 * (J - 1) ** 2

    def log(F: np.ndarray, mu: float, lam: float) -> float:
        J, I_C = np.linalg.det(F), (F**2).sum()
        return mu / 2 * (I_C - 3) + lam / 2 * (J - 1 - 3 * mu / (4 * lam)) ** 2 - mu / 2 * np.log(I_C + 1)

    for name, energy in (("plain", plain), ("log", log)):
        mu, lam = modules["bench_ipc_pyuipc"].ENERGIES[name](mu_l, lam_l)
        for row, column, expected in ((2, 2, lam_l + 2 * mu_l), (0, 1, mu_l)):
            h, H = 1e-4, np.zeros((3, 3))
            H[row, column] = h
            second = (energy(np.eye(3) + H, mu, lam) - 2 * energy(np.eye(3), mu, lam) + energy(np.eye(3) - H, mu, lam)) / h**2
            assert second == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("stats", "count"),
    [({}, None), ({"newton_iterations": 7}, 7), ({"solver": {"newton": {"iterations": 5}}}, 5), ({"pcg": 3, "ok": True}, None)],
)
def test_newton_iterations_are_found_wherever_they_stand(modules: dict[str, ModuleType], stats: dict, count: int | None) -> None:
    assert modules["bench_ipc_pyuipc"].newton_iterations(stats) == count
