"""Playing: a film's pictures, the success rate of a scripted policy and of a checkpoint, and what is refused."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.envs.roll_ball import RollBall
from raytac.errors import InputError
from raytac.io.metrics import read_metrics

pytest.importorskip("stable_baselines3")

from experiments import training_curves
from experiments.play import Args, Film, _together, main, moments
from experiments.ppo_learner import Checkpoint, Learner, Recipe
from experiments.training_curves import draw_curves


def test_the_rate_of_a_scripted_policy_and_of_a_checkpoint(tmp_path: Path) -> None:
    found = main(Args(policy="scripted", task="RollBall", episodes=2, num_envs=2, film=False, out=tmp_path / "scripted"))
    assert found["success"] == 1.0 and float(found["success_low"]) < 0.5 and found["length"] == 150
    learner = Learner(Recipe("RollBall", "none", 0, 10, num_envs=1, n_steps=2, hidden=4))
    learner.checkpoint().save(tmp_path / "policy.pt", resumable=False)
    found = main(Args(policy=str(tmp_path / "policy.pt"), episodes=2, num_envs=2, film=False, out=tmp_path / "trained"))
    assert found["task"] == "RollBall" and 0.0 <= found["success"] <= 1.0  # type: ignore[operator]
    assert read_metrics(tmp_path / "trained" / "metrics.json")["episodes"] == 2


def test_as_many_episodes_are_played_as_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same held-out seeds, however many environments there are."""
    monkeypatch.setattr(RollBall, "max_episode_steps", 40)
    found = {}
    for episodes, num_envs in ((1, 16), (3, 16), (3, 2)):
        args = Args(policy="scripted", task="RollBall", episodes=episodes, num_envs=num_envs, film=False, out=tmp_path / "run")
        found[episodes, num_envs] = main(args)
        assert found[episodes, num_envs]["episodes"] == episodes
    assert found[3, 2]["return"] == pytest.approx(found[3, 16]["return"], rel=1e-5)
    assert [_together(Args(episodes=n)) for n in (0, 1, 16, 17, 20, 100)] == [1, 1, 16, 9, 10, 15]


def test_a_film_has_the_colours_of_a_sensor_and_its_help_names_policies_that_are_there() -> None:
    assert Args().optics == "raytrace"
    root = Path(__file__).parents[2]
    named = {
        (path.name, name)
        for path in sorted((root / "experiments").glob("*.py"))
        for name in re.findall(
            r"\b(?:experiments|scenes|lights|docs)/[\w/]+\.\w+", ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
        )
    }
    assert ("play.py", "experiments/policies/balance_pole_wrench.pt") in named and len(named) > 20
    assert {(script, name) for script, name in named if not (root / name).is_file()} == set()


def test_policies_that_are_shipped_fit_their_environments() -> None:
    folder = Path(__file__).parents[2] / "experiments" / "policies"
    shipped = sorted(set(folder.glob("*.pt")) - set(folder.glob("*_ppo.pt")))  # those of train_gpu.py: tests/envs/test_rsl.py
    assert shipped
    for path in shipped:
        saved = Checkpoint.load(path)
        learner = Learner(replace(saved.recipe, num_envs=1, processes=1))
        learner.restore(saved)
        assert path.stat().st_size < 2e6 and np.isfinite(learner.predict(learner.normaliser.reset())).all()  # type: ignore[arg-type]


def test_what_is_shown_in_a_film_is_hidden_from_the_policy() -> None:
    recipe = Recipe("RollBall", "wrench", 0, 10, num_envs=1, n_steps=2, hidden=4)
    from raytac.observe import ObservationSettings

    rich = Learner(recipe, hidden=("markers",), tactile=ObservationSettings(("markers", "wrench")))
    poor = Learner(recipe)
    poor.restore(rich.checkpoint())
    seen, same = (learner.normaliser.observation_space for learner in (rich, poor))
    assert seen == same and "sensor_markers" in rich.base.observation_space.spaces  # type: ignore[attr-defined]
    assert "sensor_markers" not in rich.normaliser.reset()


def test_a_strip_shows_moments_that_differ() -> None:
    """Nothing moves for 60 of 100 frames, then a bar of the scene goes its way; what sensors show does not count."""
    frames = []
    for k in range(100):
        frame = np.full((30, 60, 3), 255, np.uint8)
        at = max(0, (k - 60) // 2)
        frame[:, at : at + 4] = 0
        frame[:, 40:] = 37 * k % 255
        frames.append(frame)
    found = moments(Film(frames, 0.02, ("sensor",)), 4)
    assert found[0] == 0 and found[-1] == 99
    assert found[1:3] == pytest.approx([60 + 40 / 3, 60 + 80 / 3], abs=3)
    still = Film(frames[:1] * 31, 0.02, ("sensor",))
    assert moments(still, 4).tolist() == [0, 10, 20, 30]
    assert moments(Film(frames[:1], 0.02, ()), 4).tolist() == [0, 0, 0, 0]


def test_bad_input(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for wrong in ({"policy": "nothing.pt"}, {"task": "Juggle"}, {"episodes": -1}, {"num_envs": 0}, {"optics": "fong"}):
        with pytest.raises(InputError, match=f"{next(iter(wrong))} = |checkpoint = "):
            main(Args(out=out, **wrong))  # type: ignore[arg-type]
    assert not out.exists()
    with pytest.raises(InputError, match="must hold trainings"):
        draw_curves(tmp_path)
    with pytest.raises(InputError, match="of this task and these observations"):
        Learner(Recipe("RollBall", "none", 0, 10, num_envs=1, n_steps=2)).restore(
            Learner(Recipe("RollBall", "none", 0, 10, num_envs=1, n_steps=2, hidden=4)).checkpoint()
        )


def test_a_checkpoint_of_another_shape_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    import torch

    learner = Learner(Recipe("RollBall", "none", 0, 10, num_envs=1, n_steps=2, hidden=4))
    sound = learner.checkpoint()
    sound.save(tmp_path / "sound.pt")
    values = torch.load(tmp_path / "sound.pt", weights_only=True)
    policy, normaliser = values["policy"], values["normaliser"]
    weight, seen = next(iter(policy)), next(iter(normaliser["observation"]))
    moments = normaliser["observation"][seen]
    for changed in (
        {"policy": [1]},
        {"policy": policy | {weight: "x"}},
        {"policy": policy | {weight: policy[weight] * float("nan")}},
        {"normaliser": 5},
        {"steps": -5},
        {"steps": "x"},
        {"recipe": values["recipe"] | {"hidden": 10**9}},
        {"recipe": values["recipe"] | {"gamma": "x"}},
        {"recipe": values["recipe"] | {"learning_rate": float("nan")}},
    ):
        torch.save(values | changed, tmp_path / "bad.pt")
        with pytest.raises(InputError, match="must be a checkpoint of train_ppo"):
            Checkpoint.load(tmp_path / "bad.pt")
    before = {name: tensor.clone() for name, tensor in learner.model.policy.state_dict().items()}
    for observation in (
        {},
        5,
        {seen: {"mean": torch.zeros(1), "var": torch.zeros(1), "count": 1.0}},
        {seen: moments | {"var": -moments["var"] - 1}},
        {seen: moments | {"mean": moments["mean"] * float("nan")}},
        {seen: moments | {"count": "x"}},
    ):
        other = observation if observation in ({}, 5) else normaliser["observation"] | observation
        with pytest.raises(InputError, match="normaliser"):
            learner.restore(replace(sound, normaliser=normaliser | {"observation": other}))
    with pytest.raises(InputError, match="of this task and these observations"):
        learner.restore(replace(sound, policy={name: 2 * one for name, one in policy.items()} | {weight: torch.zeros(3, 3)}))
    assert all(torch.equal(tensor, before[name]) for name, tensor in learner.model.policy.state_dict().items())


def test_curves_are_drawn_from_runs_that_differ_in_length(tmp_path: Path) -> None:
    for kind in ("task", "none"):
        for seed, steps in enumerate(([10, 20, 30], [10, 20])):
            folder = tmp_path / kind / f"seed{seed}"
            folder.mkdir(parents=True)
            rows = "".join(f"{n},{n / 30},{n}\n" for n in steps)
            (folder / "evaluation.csv").write_text("steps,success,return\n" + rows, encoding="utf-8")
    assert draw_curves(tmp_path).stat().st_size > 1000


def test_trainings_of_several_folders_are_one_figure(tmp_path: Path) -> None:
    for name, kind, seed in (("a_0", "task", 0), ("a_1", "task", 1), ("b_0", "none", 0), ("again", "none", 0)):
        folder = tmp_path / name / kind / f"seed{seed}"
        folder.mkdir(parents=True)
        (folder / "evaluation.csv").write_text("steps,success,return\n10,0.5,1\n20,1.0,2\n", encoding="utf-8")
    out = tmp_path / "curves.png"
    draw = training_curves.Args((f"Both={tmp_path}/a_?,{tmp_path}/b_0", f"Felt={tmp_path}/a_0"), out=out)
    assert training_curves.main(draw) == out and out.stat().st_size > 1000
    assert training_curves.main(training_curves.Args((str(tmp_path / "a_0"),))) == tmp_path / "a_0" / "curves.png"
    for panels, text in (
        ((f"x={tmp_path}/b_0,{tmp_path}/again",), "none/seed0"),
        ((f"x={tmp_path}/c_*",), "must match"),
        (("x=",), "TITLE=FOLDER"),
        ((f"x={tmp_path}/a_0", f"x={tmp_path}/a_1"), "title of its own"),
        ((), "must name"),
    ):
        with pytest.raises(InputError, match=text):
            training_curves.main(training_curves.Args(panels, out=out))


_SCRIPT = """
import sys
import gymnasium, mujoco, numpy as np
try:
    mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
except Exception as error:
    print(error)
    sys.exit(77)
import raytac.envs
from raytac.envs import PushCubeVectorEnv
from raytac.observe import ObservationSettings
shown = ObservationSettings(("rgb", "markers"), resolution=(32, 24), optics="phong")
env = gymnasium.make("raytac/PushCube-v0", render_mode="rgb_array", tactile=shown)
env.reset(seed=0)
before = env.render()
for _ in range(6):
    env.step(np.array([0, 0, -1.0], np.float32))
after = env.render()
assert before.shape == after.shape and before.dtype == np.uint8 and before.shape[0] == 240 and before.shape[1] > 320
changed = (before != after).any(axis=2)
assert changed[:, 320:].any(), "the pad that is pressed looks as before"
assert (before[:, :320] == 235).all(axis=2).mean() > 0.1 and (before[:, :320] != 235).any()
green = (before[..., 1].astype(int) - before[..., 0] > 60) & (before[..., 1].astype(int) - before[..., 2] > 60)
assert green[:, :320].sum() > 3, "no goal is seen"
env.close()
many = PushCubeVectorEnv(2, render_mode="rgb_array", tactile=None)
many.reset(seed=0)
first, second = many.render()
assert first.shape == (240, 320, 3) and (first != second).any()
many.close()
"""


def test_pictures_of_environments() -> None:
    """In a process of its own: the GL backend is chosen when MuJoCo is imported."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    environment.setdefault("MUJOCO_GL", "egl")
    done = subprocess.run([sys.executable, "-c", _SCRIPT], env=environment, capture_output=True, text=True, timeout=200)
    if done.returncode == 77 or "EGL" in done.stderr or "OpenGL" in done.stderr:
        pytest.skip(f"no offscreen OpenGL here: {(done.stdout + done.stderr).strip()[-200:]}")
    assert done.returncode == 0, done.stderr


def test_a_render_mode_that_is_not_there() -> None:
    from raytac.envs import RollBallEnv, RollBallVectorEnv

    for make in (RollBallEnv, RollBallVectorEnv):
        with pytest.raises(InputError, match="rgb_array"):
            make(render_mode="human", tactile=None)
    env = RollBallEnv(render_mode="rgb_array", tactile=None)
    with pytest.raises(InputError, match="reset"):
        env.render()
    assert RollBallEnv(tactile=None).render() is None
