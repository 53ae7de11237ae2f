"""Tasks on MuJoCo Warp, all on one device: against ``TaskBatch`` on C MuJoCo, episodes that end, no copies to the host."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")
pytest.importorskip("torch")

import torch
import warp as wp

from raytac.envs import SCRIPTED, BalancePole, InsertPeg, LiftCube, OpenDrawer, PushCube, RollBall, Task, TaskBatch, WarpBatch
from raytac.errors import InputError
from raytac.markers import MarkerPerturbation
from raytac.observe import MODALITIES, ObservationSettings, Randomization

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


class Both:
    """The same episodes on both engines; actions are those of the scripted policy on C MuJoCo."""

    def __init__(
        self, task: type[Task], device: str, *, tactile: tuple[str, ...] | ObservationSettings = ("wrench",), count: int = 2
    ) -> None:
        self.host = TaskBatch(task(), num_envs=count, tactile=tactile, max_episode_steps=10**6)
        self.warp = WarpBatch(task(), num_envs=count, tactile=tactile, max_episode_steps=10**6, device=device, launches=4)
        self.host.reset(range(count), [np.random.default_rng(k) for k in range(count)])
        u = np.stack([np.random.default_rng(k).random(task.draws) for k in range(count)])
        starts = self.warp.task.starts(torch.tensor(u, device=self.warp.device), self.warp.start_tool, self.warp.start_body)
        self.warp._draw = lambda: starts  # type: ignore[method-assign]
        self.warp.reset()
        self.policy = SCRIPTED[task.__name__]

    def play(self, steps: int) -> dict[str, np.ndarray]:
        """Of every step: forces of both, and distances of bodies and tools."""
        forces, apart, seen = [], [], []
        for _ in range(steps):
            actions = self.policy(self.host)
            one, two = self.host.step(actions), self.warp.step(torch.tensor(actions, device=self.warp.device))
            own = [wrench[:, :3] for wrench in self.host.world.state().wrench.values()]
            other = [wrench[:, :3].cpu().numpy() for wrench in self.warp.wrench.values()]
            forces.append((np.stack(own, axis=1), np.stack(other, axis=1)))
            body = self.warp.world.state["bodies"].numpy()[:, self.warp._body_at]
            tool = self.warp.world.state["tool"].numpy()
            apart.append([np.abs(a - b)[:, :3, 3].max() for a, b in ((self.host.body, body), (self.host.tool, tool))])
            seen.append(
                [np.abs(one.observation[name] - two.observation[name].cpu().numpy()).max() for name in one.observation]
                + [np.abs(one.reward - two.reward.cpu().numpy()).max()]
            )
        self.warp.check()
        return {"force": np.array(forces), "apart": np.array(apart), "seen": np.array(seen)}


def contact_steps(force: np.ndarray) -> np.ndarray:
    """True in the steps in which a pad is touched."""
    return np.abs(force).sum(axis=-1) > 0.0


@pytest.mark.parametrize("device", DEVICES)
def test_a_press_is_that_of_c_mujoco(device: str) -> None:
    found = Both(PushCube, device, count=1).play(20)
    own, other = found["force"][:, 0], found["force"][:, 1]
    assert found["apart"].max() < 2e-5 and own[-1].any()
    assert np.linalg.norm(other - own) < 0.01 * np.linalg.norm(own)
    assert found["seen"].max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("task", [PushCube, RollBall, LiftCube, OpenDrawer])
def test_200_steps_of_a_scripted_policy_agree(task: type[Task], device: str) -> None:
    """Poses to 0.5 mm, forces to 3 % RMS, contact in the same steps ± 1."""
    found = Both(task, device).play(200)
    own, other = found["force"][:, 0], found["force"][:, 1]
    assert found["apart"].max() < 0.5e-3
    assert np.linalg.norm(other - own) < 0.03 * np.linalg.norm(own)
    one, two = contact_steps(own), contact_steps(other)
    for k in np.argwhere(one != two):
        near = slice(max(k[0] - 1, 0), k[0] + 2)
        assert (one[near, *k[1:]] != one[k[0], *k[1:]]).any() or (two[near, *k[1:]] != two[k[0], *k[1:]]).any(), k


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_a_pole_stands_as_on_c_mujoco(device: str) -> None:
    """An unstable balance, whose differences grow: 60 steps."""
    found = Both(BalancePole, device).play(60)
    own, other = found["force"][:, 0], found["force"][:, 1]
    assert found["apart"].max() < 0.5e-3 and np.linalg.norm(other - own) < 0.03 * np.linalg.norm(own)


def test_markers_are_those_of_the_host() -> None:
    both = Both(PushCube, "cpu", tactile=("markers", "wrench"), count=1)
    seen = both.play(16)["seen"]
    markers = list(both.host.arrays).index("sensor_markers")
    assert seen[:, markers].max() < 5e-3 and seen[-3:, markers].max() < 1e-3  # 5 µm at first touch, then 1 µm
    assert np.abs(both.host.observers["sensor"].last()["markers"]).max() > 0.02  # the pad is pressed


@pytest.mark.renderer
def test_every_modality_is_that_of_the_host() -> None:
    """With the history that a stack keeps, images with the markers' dots, and the difference to rest."""
    seen = ObservationSettings(MODALITIES, resolution=(32, 24), optics="phong", map_shape=(6, 8), stack=2, difference=True)
    both = Both(PushCube, "cpu", tactile=seen)
    found: dict[str, list[float]] = {}
    for _ in range(12):
        actions = both.policy(both.host)
        one, two = both.host.step(actions).observation, both.warp.step(torch.tensor(actions)).observation
        assert one.keys() == two.keys() == both.warp.arrays.keys() == both.host.arrays.keys()
        for name, values in one.items():
            other = two[name].numpy()
            assert values.dtype == other.dtype and values.shape == other.shape == (2, *both.warp.arrays[name].shape)
            found.setdefault(name, []).append(np.abs(values.astype(float) - other).max())
    assert both.host.observers["sensor"].last()["contact"].max() > 0.5  # the pad is pressed
    worst = {name.removeprefix("sensor_"): max(values) for name, values in found.items()}
    assert worst["rgb"] <= 1.0 and worst["marker_visible"] == 0.0
    # Poses differ by some µm: 5 µm of markers and heights, a node or two at the rim of the contact, 20 mN.
    assert max(worst["markers"], worst["height"], worst["indentation"]) < 5e-3
    assert worst["contact"] < 0.1 and worst["wrench"] < 2e-3
    assert found["sensor_traction"][-1] < 0.02 * np.abs(both.host.observers["sensor"].last()["traction"]).max()


@pytest.mark.parametrize("device", DEVICES)
def test_episodes_that_end_begin_again_and_leave_the_others_to_the_bit(device: str) -> None:
    """On CUDA to rounding: MuJoCo Warp's list of contacts, and so the order of sums, differs from run to run there."""
    one, other = (
        WarpBatch(PushCube(), num_envs=3, tactile=("markers", "wrench"), device=device, seed=1, max_episode_steps=50)
        for _ in range(2)
    )
    for batch in (one, other):
        batch.reset(7)
    other.steps[1] = 45  # its episode ends in the fifth step
    rng = np.random.default_rng(0)
    for step in range(8):
        actions = torch.tensor(rng.uniform(-1.0, 1.0, (3, 3)), device=one.device)
        a, b = one.step(actions), other.step(actions)
        assert b.truncated.tolist() == [False, step == 4, False]
        for name, values in a.observation.items():
            tolerance = 0.0 if device == "cpu" else 1e-3 if name == "body" else 1e-4  # its velocities: 1 mm/s, 1 mrad/s
            torch.testing.assert_close(
                values[[0, 2]], b.observation[name][[0, 2]], rtol=0.0, atol=tolerance, msg=f"{name}: {{}}".format
            )
    assert other.steps.tolist() == [8, 3, 8] and not torch.equal(a.observation["state"][1], b.observation["state"][1])


@contextmanager
def no_copies(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the copies to the host, and of the waits, that are asked for inside."""
    counted: list[str] = []

    def count(owner: type, name: str) -> None:
        kept = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, **k: (counted.append(name), kept(*a, **k))[1])

    with monkeypatch.context():
        for name in ("numpy", "list"):
            count(wp.array, name)
        for name in ("cpu", "numpy", "item", "tolist", "__bool__", "__float__", "__int__", "nonzero"):
            count(torch.Tensor, name)
        for name in ("synchronize", "synchronize_device", "synchronize_stream"):
            count(wp, name)
        yield counted


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_copies_nothing_to_the_host(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tuple(name for name in MODALITIES if name != "rgb")  # images are another library's
    differs = Randomization(
        body_mass=0.2, youngs_modulus=0.2, pad_shift=1e-4, markers=MarkerPerturbation(noise_px=0.2, dropout=0.1)
    )
    batch = WarpBatch(PushCube(), num_envs=2, tactile=ObservationSettings(seen, stack=2), randomization=differs, device=device)
    batch.reset()
    actions = torch.zeros(2, 3, device=batch.device)
    batch.step(actions)
    if device == "cuda":
        torch.cuda.set_sync_debug_mode("error")
    try:
        with no_copies(monkeypatch) as counted:
            for _ in range(3):
                batch.step(actions)
            assert counted == []
            batch.check()
            assert "numpy" in counted  # the counter counts
    finally:
        if device == "cuda":
            torch.cuda.set_sync_debug_mode("default")


def test_what_is_not_on_the_device_is_refused() -> None:
    for settings, name in (
        (("taste",), "modalities"),
        (ObservationSettings(("markers",), markers="surface"), "markers"),
    ):
        with pytest.raises(InputError) as error:
            WarpBatch(PushCube(), tactile=settings, device="cpu")
        assert error.value.name == name
    batch = WarpBatch(PushCube(), tactile=None, device="cpu")
    with pytest.raises(InputError, match="reset"):
        batch.step(torch.zeros(1, 3))
    batch.reset()
    with pytest.raises(InputError, match="actions"):
        batch.step(torch.zeros(2, 3))


@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.parametrize("task", [PushCube, BalancePole, LiftCube, RollBall, InsertPeg, OpenDrawer])
def test_a_million_random_steps_stay_finite_and_bounded(task: type[Task]) -> None:
    """Environments that fail are marked and begin again; nothing that is observed grows."""
    batch = WarpBatch(task(), num_envs=2048, tactile=("markers", "wrench"), device="cuda", contacts=40, rows=200)
    batch.reset(0)
    generator = torch.Generator(batch.device).manual_seed(0)
    steps, failed = 490, torch.zeros((), device=batch.device)
    halves = []
    greatest = torch.zeros((), device=batch.device)
    sound = torch.ones((), dtype=torch.bool, device=batch.device)
    for k in range(steps):
        actions = 2.0 * torch.rand(2048, batch.size, generator=generator, device=batch.device) - 1.0
        result = batch.step(actions)
        values = torch.cat([array.reshape(2048, -1) for array in result.observation.values()], dim=1)
        sound &= torch.isfinite(values).all() & torch.isfinite(result.reward).all()
        greatest = torch.maximum(greatest, values.abs().max())
        failed += result.failed.sum()
        if k in (steps // 2, steps - 1):
            halves.append(float(greatest))
            greatest.zero_()
    batch.check()
    assert bool(sound) and 2048 * steps > 1_000_000
    assert float(failed) < 1e-3 * 2048 * steps, f"{float(failed)} failed"
    assert halves[1] < 3.0 * halves[0] < 1e3, halves
