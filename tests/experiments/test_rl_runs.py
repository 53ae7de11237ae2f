"""The benchmark and the soak test of the environments, small, from end to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import bench_rl as bench
from experiments import soak, turns
from raytac.envs import batch as env_batch
from raytac.errors import InputError, RaytacError
from raytac.io.metrics import read_metrics
from tests.clock import steady_clock


def test_environment_steps_are_timed_and_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policy and step take one reading of the clock each; physics and observation are as the environment counts them."""
    steady_clock(monkeypatch, bench)
    steady_clock(monkeypatch, env_batch)
    bench.main(bench.Args(out=tmp_path, device="cpu", envs=2, modes="none", steps=3))
    found = read_metrics(tmp_path / "metrics.json")
    assert [found[f"push.none.{part}_ms"] for part in ("physics", "observation", "policy")] == pytest.approx([1.0, 1.0, 1.0])
    for key in ("env_steps_per_s", "env_steps_per_s_best"):
        assert found[f"push.none.{key}"] == pytest.approx(2 / 2e-3)


def test_frames_are_timed_without_physics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(bench.FRAMES, "table", "phong")  # a table would be baked
    bench.main(bench.Args(out=tmp_path, device="cpu", envs=3, modes="table", steps=3, frames=True, size="24x18"))
    found = read_metrics(tmp_path / "metrics.json")
    assert found["cpu.table.touched_share"] == 1.0
    for part in ("", "numpy_"):
        call = 1e-3 * float(found[f"cpu.table.{part}call_ms"])
        assert float(found[f"cpu.table.{part}frames_per_s"]) == pytest.approx(3 / call)


@pytest.mark.timeout(1200)  # it compiles MuJoCo Warp for the CPU
def test_environment_steps_on_the_device_are_timed_with_the_pads_pressed(tmp_path: Path) -> None:
    pytest.importorskip("mujoco_warp")
    pytest.importorskip("torch")
    bench.main(bench.Args(out=tmp_path, device="cpu", engine="mujoco_warp", envs=2, modes="touch", steps=3))
    found = {name: float(value) for name, value in read_metrics(tmp_path / "metrics.json").items() if "push.touch" in name}
    assert found["warp.push.touch.env_steps_per_s"] == pytest.approx(2e3 / found["warp.push.touch.ms_per_step"])
    assert 0.5 <= found["warp.push.touch.pressed"] <= 1.0 and found["warp.push.touch.failed"] == 0.0


def test_each_gpu_has_a_process_that_sees_no_other_and_speeds_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "bench_rl.py"
    monkeypatch.setattr(bench, "__file__", str(script))
    script.write_text(
        "import json, os, pathlib, sys\n"
        "gpu = float(os.environ['CUDA_VISIBLE_DEVICES'])\n"
        "out = pathlib.Path(sys.argv[sys.argv.index('--out') + 1]); out.mkdir(parents=True)\n"
        "values = {'experiment': 'x', 'device': 'cuda', 'seed': 0, 'wall_s': 1.0, 'versions.x': '1',\n"
        "          'gpu.push.fots.env_steps_per_s': 100.0 + gpu, 'gpu.push.fots.pressed': 0.5 + 0.1 * gpu}\n"
        "(out / 'metrics.json').write_text(json.dumps(values))\n"
    )
    found = bench.timed_on_gpus("fots", bench.Args(gpus=3))
    assert found == {"env_steps_per_s": 303.0, "least": 100.0, "most": 102.0, "pressed": 0.5, "gpus": 3}
    script.write_text("raise SystemExit('broken on purpose')")
    with pytest.raises(RaytacError, match="broken on purpose"):
        bench.timed_on_gpus("fots", bench.Args(gpus=2))


def test_bad_options_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options: dict[str, Any]
    for options, text in (
        ({"modes": "table"}, "push|none"),
        ({"frames": True, "modes": "fots"}, "table"),
        ({"size": "3x"}, "WIDTH"),
    ):
        with pytest.raises(InputError, match=text):
            bench.main(bench.Args(out=out, device="cpu", **options))
    for options, text in (({"task": "pull"}, "InsertPeg"), ({"steps": 0}, "1 or more"), ({"modalities": "smell"}, "markers")):
        with pytest.raises(InputError, match=text):
            soak.main(soak.Args(out=out, device="cpu", **options))
    assert not out.exists()


def test_a_soak_run_counts_and_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {
        "out": tmp_path,
        "device": "cpu",
        "envs": 2,
        "modalities": "wrench",
        "block": 4,
        "task": "RollBall",
    }
    with monkeypatch.context() as patch:
        write, calls = soak.store, []

        def stop(*record) -> None:
            write(*record)
            calls.append(record)
            if len(calls) == 2:
                raise KeyboardInterrupt

        patch.setattr(soak, "store", stop)
        with pytest.raises(KeyboardInterrupt):
            soak.main(soak.Args(steps=20, **options))
    assert not (tmp_path / "metrics.json").exists()
    soak.main(soak.Args(steps=20, **options))
    found = read_metrics(tmp_path / "metrics.json")
    assert found["RollBall.steps"] == 20 and found["RollBall.sittings"] == 2
    assert found["RollBall.nonfinite"] == found["RollBall.failed"] == 0 and float(found["RollBall.memory_mb"]) > 50.0
    with pytest.raises(InputError, match="other settings"):
        soak.main(soak.Args(steps=20, **{**options, "envs": 3}))


def test_a_soak_run_sees_what_is_not_finite_and_what_grows() -> None:
    assert soak.count_nonfinite({"a": np.array([0.0, np.nan]), "b": np.zeros(2), "c": np.array([[np.inf]])}) == 2
    blocks = [soak.Block(s, 10, 1, 0, n, 0.5, m) for s, n, m in ((0, 0, 100.0), (0, 2, 130.0), (1, 0, 500.0), (1, 0, 510.0))]
    found = soak.summary(blocks)
    assert found["memory_growth_mb"] == 30.0 and found["nonfinite"] == 2 and found["steps"] == 40
    assert found["env_steps_per_s"] == pytest.approx(20.0)
    made_once = [soak.Block(0, 10, 1, 0, 0, 0.5, m) for m in (100.0, *[150.0] * 18, 151.0)]
    assert soak.summary(made_once)["memory_growth_mb"] == 1.0


def test_two_checkouts_take_turns_and_the_ratio_is_that_of_the_medians(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first round is not counted; the order changes from turn to turn, which a machine that slows down would show."""
    other, ours = tmp_path / "other", Path(bench.__file__).resolve().parents[1]
    (other / "ipc").mkdir(parents=True)
    (other / "ipc" / "world.py").write_text("")
    calls: list[tuple[Path, str]] = []
    started: list[int] = []

    class Turn:
        def __init__(self, checkout: Path, scene: str, processes: int) -> None:
            self.checkout, self.scene = checkout, scene
            started.append(processes)

        def step(self) -> tuple[float, float]:
            calls.append((self.checkout, self.scene))
            time = (1e-3 if self.checkout == ours else 3e-3) * (1.0 if len(calls) > 2 * turns.steps_of(self.scene) else 100.0)
            return time, time if self.checkout == ours else 2.0 * time

        def end(self) -> None:
            pass

    monkeypatch.setattr(turns, "Turn", Turn)
    found = bench.main(bench.Args(out=tmp_path / "out", device="cpu", modes="fots,ball", against=other, rounds=2, envs=3))
    assert [checkout for checkout, _ in calls[:4]] == [ours, other, other, ours]
    assert {scene for _, scene in calls} == {"push:fots:3", "ball:rigid"}
    name = found["against"]
    assert found[f"push.fots.speedup_vs_{name}"] == found["push.fots.speedup_most"] == pytest.approx(3.0)
    assert found["push.fots.processor_ms_per_step"] == pytest.approx(1.0)
    assert found[f"push.fots.wall_speedup_vs_{name}"] == pytest.approx(6.0)
    written = read_metrics(tmp_path / "out" / "metrics.json")
    assert written[f"ball_rolling.rigid.speedup_vs_{name}"] == pytest.approx(3.0)
    assert set(started) == {1}
    calls.clear()
    started.clear()
    shared = bench.Args(out=tmp_path / "shared", device="cpu", modes="fots", against=other, rounds=1, envs=4, processes=2)
    bench.main(shared)
    assert {scene for _, scene in calls} == {"push:fots:2"} and set(started) == {2}
    with pytest.raises(InputError, match="must be a multiple of the 2 processes"):
        bench.main(replace(shared, envs=3))
    with pytest.raises(InputError, match="must not have ball"):
        bench.main(replace(shared, modes="ball"))


@pytest.mark.slow
def test_steps_of_worlds_in_turn_with_its_own(tmp_path: Path) -> None:
    """This checkout against itself."""
    bench.main(bench.Args(out=tmp_path, modes="none,ball", envs=2, rounds=1, against=Path(bench.__file__).resolve().parents[1]))
    found = read_metrics(tmp_path / "metrics.json")
    ratios = [float(value) for key, value in found.items() if "speedup_vs_" in key]
    assert len(ratios) == 4 and all(0.4 < ratio < 2.5 for ratio in ratios)


def test_what_cannot_take_turns_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    here, out = Path(bench.__file__).resolve().parents[1], tmp_path / "out"
    for options, message in (
        ({"device": "cuda"}, "device = 'cuda': must be the CPU with --against"),
        ({"frames": True}, "is for environment steps, not for --frames"),
        ({"rounds": 0}, "rounds = 0"),
        ({"modes": "sight"}, "modes"),
    ):
        with pytest.raises(InputError, match=message):
            bench.main(bench.Args(**{"device": "cpu", "out": out, "against": here, **options}))
    with pytest.raises(InputError, match="checkout"):
        bench.main(bench.Args(device="cpu", out=tmp_path / "out", against=tmp_path / "nowhere"))
