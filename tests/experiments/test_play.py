"""Checkpoints of ``train_ppo.py``: played, shipped ones, what is refused; curves of trainings."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io.metrics import read_metrics

pytest.importorskip("stable_baselines3")

from experiments import training_curves
from experiments.play import Args, main
from experiments.ppo_learner import Checkpoint, Learner, Recipe
from experiments.training_curves import draw_curves


def test_the_rate_of_a_checkpoint(tmp_path: Path) -> None:
    learner = Learner(Recipe("RollBall", "none", 0, 10, num_envs=1, n_steps=2, hidden=4))
    learner.checkpoint().save(tmp_path / "policy.pt", resumable=False)
    found = main(Args(checkpoint=tmp_path / "policy.pt", episodes=2, num_envs=2, film=False, out=tmp_path / "trained"))
    assert found["task"] == "RollBall" and 0.0 <= found["success"] <= 1.0  # type: ignore[operator]
    assert read_metrics(tmp_path / "trained" / "metrics.json")["episodes"] == 2


def test_help_names_files_that_are_there() -> None:
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
    shipped = sorted(folder.glob("*.pt"))  # those of raytac train: tests/learn/test_playing.py
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


def test_bad_input(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="checkpoint = "):
        main(Args(checkpoint=tmp_path / "nothing.pt", out=out))
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
