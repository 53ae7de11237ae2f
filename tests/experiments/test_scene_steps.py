"""Shipped task scenes: at their step of MuJoCo no contact is lost, nothing sinks, and their scripted policies succeed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments import scene_steps
from experiments.scene_steps import CASES, play
from raytac.assets import asset_root
from raytac.envs import SCRIPTED, TaskBatch
from raytac.errors import InputError
from raytac.io.metrics import read_metrics
from raytac.specs import load_task
from raytac.world.compose import compose


def test_every_shipped_scene_with_rigid_pads_is_measured() -> None:
    shipped = sorted(path.stem for path in (asset_root("scenes") / "tasks").glob("*.toml"))
    assert [name for name in shipped if load_task(name).physics == "rigid"] == sorted(CASES)


@pytest.mark.parametrize("name", sorted(name for name, case in CASES.items() if case.down))
def test_a_pad_that_stands_or_slides_keeps_its_contact_and_the_body_its_place(name: str) -> None:
    played = play(name, "pressed", 4, 0)
    assert played.lost == 0.0 and played.failed == 0
    assert played.sink_mm is not None and played.sink_mm < 0.04
    assert played.tilt_deg is None or played.tilt_deg < 0.1  # 0.07 mm under an edge of 40 mm


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CASES))
def test_scripted_policies_succeed_without_losing_a_contact(name: str) -> None:
    """A policy that lifts the pad by the force that it reads lets go of the cube once in a while; 10 ms lost it 9.5 times an episode."""
    played = play(name, "scripted", 4, 0)
    assert played.success == 4 and played.failed == 0
    assert played.lost <= (0.5 if name == "push_cube" else 0.0)
    assert played.sink_mm is None or played.sink_mm < 0.05


def test_what_is_measured_is_written_and_a_shorter_step_sinks_less(tmp_path) -> None:
    args = scene_steps.Args(out=tmp_path / "run", scenes=("push_cube",), steps_ms=(10.0, 2.0), episodes=2, device="cpu", seed=2)
    scene_steps.main(args)
    found = read_metrics(tmp_path / "run" / "metrics.json")
    assert found["scene_steps.push_cube.shipped_ms"] == 10.0
    for how in ("scripted", "pressed"):
        sink = [float(found[f"scene_steps.push_cube.{step}ms.{how}.sink_mm"]) for step in (10, 2)]
        assert sink[1] < 0.3 * sink[0] and sink[0] > 0.01
    with pytest.raises(InputError, match=r"scenes = 'push'.*push_cube"):
        scene_steps.main(scene_steps.Args(scenes=("push",)))


def test_mujoco_steps_twice_at_least_to_a_step_of_soft_pads() -> None:
    scene = load_task("push_cube")
    assert scene.timestep == scene.soft_timestep == 0.01
    assert [compose(scene, physics).model.opt.timestep for physics in ("rigid", "ipc")] == [0.01, 0.005]
    finer = replace(scene, timestep=0.001)
    assert [compose(finer, physics).timestep for physics in ("rigid", "ipc")] == [0.001, 0.001]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps", "sensor"),
    [("push_cube", 18, "sensor"), ("roll_ball", 12, "sensor"), ("balance_pole", 8, "sensor"), ("lift_cube_env", 8, None)],
)
def test_soft_pads_keep_their_contact_too(name: str, steps: int, sensor: str | None) -> None:
    """A few control steps of the scripted policy. A pad that is pressed bounced while MuJoCo's step was the solver's.

    The cube's face lands in the eighth step, and its force swings for five more.
    """
    case = CASES[name]
    batch = TaskBatch(case.task, num_envs=1, tactile=None, physics="ipc", scene=name, device="cpu")
    batch.reset([0], [np.random.default_rng(0)])
    forces = []
    for _ in range(steps):
        out = batch.step(SCRIPTED[case.policy](batch))
        assert not out.failed[0] and not out.terminated[0]
        forces += [] if sensor is None else [-float(batch.world.state().wrench[sensor][0, 2])]
    assert min(forces[-4:], default=1.0) > 0.2, "with the two steps alike it fell to 0.06 N in every other one"
