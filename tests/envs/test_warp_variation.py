"""Variations of an episode on MuJoCo Warp: against those of C MuJoCo, seeds, resets by mask, and what they do."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")
pytest.importorskip("torch")

import torch

from raytac.envs import SCRIPTED, BalancePole, LiftCube, PushCube, Task, TaskBatch, WarpBatch
from raytac.errors import InputError
from raytac.markers import MarkerPerturbation
from raytac.observe import ObservationSettings, Randomization
from raytac.world.engine.mjwarp import _VARIED

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes

WIDTHS: dict[str, Any] = {
    "body_mass": 0.3, "body_friction": 0.2, "youngs_modulus": 0.2, "friction": 0.2, "pad_shift": 3e-4, "pad_turn": 0.02,
}  # fmt: skip
DIFFERS = Randomization(**WIDTHS)
NUMBERS = ("inverse_weight", "gel_stiffness", "gel_friction", "body_friction")


def numbers(batch: WarpBatch) -> dict[str, np.ndarray]:
    """All that variations change in the worlds, (B, …)."""
    model, contact = batch.world.engine.model, batch.world.contact.numbers
    found = {name: getattr(model, name).numpy().copy() for name in _VARIED if getattr(model, name).size}
    return found | {name: getattr(contact, name).numpy().copy() for name in NUMBERS}


def same_variation(task: type[Task], count: int) -> tuple[TaskBatch, WarpBatch]:
    """Both engines with the host's draws of starts and variations."""
    options: dict[str, Any] = {"num_envs": count, "tactile": ("wrench",), "randomization": DIFFERS, "max_episode_steps": 10**6}
    host, warp = TaskBatch(task(), **options), WarpBatch(task(), **options, device="cpu", launches=4)
    drawn = host._variations.draw(range(count))
    host._variations.draw = lambda envs: drawn  # type: ignore[method-assign]
    host.reset(range(count), [np.random.default_rng(k) for k in range(count)])
    u = torch.tensor(np.stack([np.random.default_rng(k).random(task.draws) for k in range(count)]))
    starts = warp.task.starts(u, warp.start_tool, warp.start_body)
    tensors = {kind: {name: torch.tensor(values) for name, values in given.items()} for kind, given in vars(drawn).items()}
    warp._draw = lambda: starts  # type: ignore[method-assign]
    warp._draw_variation = lambda: type(drawn)(**tensors)  # type: ignore[method-assign]
    warp.reset()
    return host, warp


@pytest.mark.parametrize("task", [PushCube, BalancePole, LiftCube])
def test_numbers_of_the_worlds_are_those_of_c_mujoco(task: type[Task]) -> None:
    """But for the inverse weights of the arm, which know nothing of where the pad is mounted: 1 %."""
    host, warp = same_variation(task, 2)
    found, models = numbers(warp), host.world.models
    for name in _VARIED:
        if name in found:
            expected = np.stack([getattr(models[b], name) for b in range(2)]).reshape(found[name].shape)
            tolerance = 1e-2 if name in ("body_invweight0", "dof_invweight0", "actuator_acc0", "tendon_invweight0") else 1e-6
            if name == "body_subtreemass":  # nothing reads those of the bodies that carry a free one
                free = [body.index for body in host.world.composed.touched if body.is_free]
                expected, found[name] = expected[:, free], found[name][:, free]
            np.testing.assert_allclose(found[name], expected, rtol=tolerance, atol=1e-7, err_msg=name)
    for name, expected in zip(
        NUMBERS, (models.inverse_weight, models.gel_stiffness, models.gel_friction, models.friction_on_gel), strict=True
    ):
        np.testing.assert_allclose(found[name], expected, rtol=1e-2 if name == "inverse_weight" else 1e-12, err_msg=name)
    mass = found["body_mass"]
    assert (mass[0] != mass[1]).any() or task is BalancePole
    apart = np.abs(host.body - warp._body_now().numpy())[:, :3, 3].max()
    assert apart < 1e-6


def test_a_press_differs_as_it_does_on_c_mujoco() -> None:
    host, warp = same_variation(PushCube, 2)
    forces = []
    for _ in range(14):
        actions = SCRIPTED["PushCube"](host)
        host.step(actions)
        warp.step(torch.tensor(actions))
        forces.append([host.world.state().wrench["sensor"][:, 2], warp.wrench["sensor"][:, 2].numpy().copy()])
    warp.check()
    own, other = np.array(forces)[:, 0], np.array(forces)[:, 1]
    assert (own[-1] < -1.0).all() and np.linalg.norm(other - own) < 0.01 * np.linalg.norm(own)
    assert np.abs(own[-1, 0] - own[-1, 1]) > 0.02 * np.abs(own[-1]).max(), "both are alike"


def test_seeds_repeat_and_a_reset_by_mask_leaves_the_others_to_the_bit() -> None:
    noise = MarkerPerturbation(noise_px=0.3, dropout=0.1)
    camera = {"exposure": 0.1, "white_balance": 0.05, "gamma": 0.05, "noise": 1.0}
    differs = Randomization(**WIDTHS, **camera, markers=noise)
    seen = ObservationSettings(
        ("rgb", "markers", "marker_visible"), resolution=(16, 12), optics="phong", difference=True, stack=2
    )
    one, other = (
        WarpBatch(PushCube(), num_envs=3, tactile=seen, randomization=differs, device="cpu", max_episode_steps=50)
        for _ in range(2)
    )
    first, again = one.reset(7), other.reset(7)
    begun = numbers(one)
    assert all(torch.equal(values, again[name]) for name, values in first.items())
    assert all(np.array_equal(values, numbers(other)[name]) for name, values in begun.items())
    assert np.ptp(begun["body_mass"], axis=0).max() > 1e-3 and np.ptp(begun["body_pos"], axis=0).any()
    half = first["sensor_rgb"][..., :3].float().mean(dim=(1, 2))
    assert half.std(dim=0).max() < 1.0  # compared with the same camera at rest
    assert set(first["sensor_marker_visible"].flatten().tolist()) == {0, 1}
    lost = first["sensor_marker_visible"] == 0
    assert not first["sensor_markers"][lost].any() and first["sensor_markers"][~lost].std() > 0.003
    other.steps[1] = 48  # its episode ends in the second step
    for step in range(3):
        actions = torch.zeros(3, 3)
        a, b = one.step(actions), other.step(actions)
        assert b.truncated.tolist() == [False, step == 1, False]
        for name, values in a.observation.items():
            assert torch.equal(values[[0, 2]], b.observation[name][[0, 2]]), name
    kept, drawn = numbers(one), numbers(other)
    for name, values in kept.items():
        assert np.array_equal(values, begun[name]) and np.array_equal(values[[0, 2]], drawn[name][[0, 2]])
    assert all((drawn[name][1] != kept[name][1]).any() for name in ("body_mass", "geom_friction", "body_pos", "gel_stiffness"))
    one.reset(8)
    assert not np.array_equal(numbers(one)["gel_stiffness"], begun["gel_stiffness"])


def test_cameras_are_those_of_the_host_in_distribution() -> None:
    """Exposure brightens all channels alike, the white balance each; without widths images are the nominal ones."""
    seen = ObservationSettings(("rgb",), resolution=(16, 12), optics="phong")

    def images(**widths: float) -> np.ndarray:
        batch = WarpBatch(PushCube(), num_envs=32, tactile=seen, randomization=Randomization(**widths), device="cpu")  # type: ignore[arg-type]
        return batch.reset(3)["sensor_rgb"].numpy().astype(float).mean(axis=(1, 2))

    nominal = images()
    assert not np.ptp(nominal, axis=0).any()
    host = TaskBatch(PushCube(), num_envs=32, tactile=seen, randomization=Randomization(exposure=0.2))
    expected = host.reset(range(32), [np.random.default_rng(k) for k in range(32)])["sensor_rgb"].mean(axis=(1, 2))
    bright, balanced = images(exposure=0.2), images(white_balance=0.2)
    for values in (bright, expected):
        ratio = values / nominal
        assert ratio.std(axis=0).min() > 0.02 and 0.8 < ratio.min() < 0.95 and 1.05 < ratio.max() < 1.2
    assert np.ptp(bright / nominal, axis=1).max() < 0.02 < np.ptp(balanced / nominal, axis=1).max()


def test_what_does_not_vary_on_the_device_is_refused() -> None:
    with pytest.raises(InputError, match=r"perturbation.*noise_px"):
        WarpBatch(PushCube(), randomization=Randomization(markers=MarkerPerturbation(shift=1e-4)), device="cpu")
    with pytest.raises(InputError, match="randomization"):
        WarpBatch(PushCube(), randomization={"body_mass": 0.1}, device="cpu")  # type: ignore[arg-type]
