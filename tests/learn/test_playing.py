"""Policies played from the wheel: success rates, films, the command, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from raytac.cli import main
from raytac.envs import FlatPolicy
from raytac.envs.roll_ball import RollBall
from raytac.errors import InputError
from raytac.io import read_metrics
from raytac.learn import (
    Film,
    PolicyPlayer,
    PpoSettings,
    ScriptedPlayer,
    find_player,
    gif_pictures,
    moments,
    play_policy,
    shipped_policies,
    success_rate,
)
from tests.opengl import drawing_environment, run_drawing


def test_the_command_plays_a_scripted_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--task", "RollBall", "--episodes", "2", "--num-envs", "2", "--no-film", "--out", str(tmp_path)]
    assert main(["play", "scripted", *options]) == 0
    read = read_metrics(tmp_path / "metrics.json")
    assert read["success"] == 1.0 and float(read["success_low"]) < 0.5 and read["length"] == 150
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    assert "RollBall: success 2/2" in capsys.readouterr().out


def test_as_many_episodes_are_played_as_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same held-out seeds, however many environments there are."""
    monkeypatch.setattr(RollBall, "max_episode_steps", 40)
    sizes, result = [], {}
    made = ScriptedPlayer.episodes
    monkeypatch.setattr(ScriptedPlayer, "episodes", lambda self, count, **on: sizes.append(count) or made(self, count, **on))
    for episodes, num_envs in ((1, 16), (3, 16), (3, 2)):
        result[episodes, num_envs] = success_rate(ScriptedPlayer("RollBall"), episodes, num_envs=num_envs)
        assert result[episodes, num_envs].episodes == episodes
    assert result[3, 2].mean_return == pytest.approx(result[3, 16].mean_return, rel=1e-5)
    assert sizes == [1, 3, 2]


def test_shipped_policies_fit_their_environments() -> None:
    shipped = shipped_policies()
    assert set(shipped) == {"balance_pole_ppo", "lift_cube_ppo", "push_cube_ppo", "roll_ball_ppo"}
    assert sum(path.stat().st_size for path in shipped.values()) < 2e6
    for name, path in shipped.items():
        assert FlatPolicy.is_one(path)
        player = find_player(name)
        assert isinstance(player, PolicyPlayer) and player.name == name
        vector = player.policy.vector(1)
        actions = player.policy(vector.buffers["actor"])
        assert actions.shape == vector.buffers["action"].shape and np.isfinite(actions).all()


@pytest.mark.renderer
def test_a_shipped_policy_is_filmed_by_name(tmp_path: Path) -> None:
    """In a process of its own: the GL backend is chosen when MuJoCo is imported. An episode is cut to 0.25 s, since frames take long."""
    code = (
        "import sys; from raytac.envs.push_cube import PushCube; PushCube.max_episode_steps = 12; from raytac.cli import main; "
    )
    options = ["play", "push_cube_ppo", "--episodes", "1", "--optics", "phong", "--out", str(tmp_path)]
    command = [sys.executable, "-c", code + "sys.exit(main(sys.argv[1:]))", *options]
    done = subprocess.run(command, env=drawing_environment(), capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    read = read_metrics(tmp_path / "metrics.json")
    assert (read["task"], read["policy"], read["episodes"]) == ("PushCube", "push_cube_ppo", 1) and float(read["return"]) > 0.0
    if "no film" in done.stderr:
        pytest.skip(f"no offscreen OpenGL here: {done.stderr.strip()[-200:]}")
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 4 and film.size[0] > film.size[1]  # type: ignore[attr-defined]
        first = np.asarray(film.convert("RGB"), float)
        film.seek(film.n_frames - 1)  # type: ignore[attr-defined]
        assert np.abs(np.asarray(film.convert("RGB"), float) - first).mean() > 1.0
    assert (tmp_path / "strip.png").stat().st_size > 10_000


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9, 100])
def test_a_gif_ends_with_the_last_picture(count: int) -> None:
    shown = [int(picture) for picture in gif_pictures([np.array(k) for k in range(count)])]
    assert shown[-1] == count - 1 and shown[0] < 3 and set(np.diff(shown)) <= {3}


def test_the_script_of_a_checkout_plays_files_of_both_trainings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By what is in the file: those of ``raytac train`` without PyTorch, which the other reader imports."""
    from experiments import play

    found = play.main(
        play.Args(checkpoint=shipped_policies()["balance_pole_ppo"], episodes=1, num_envs=1, film=False, out=tmp_path)
    )
    assert (found["task"], found["policy"], found["episodes"]) == ("BalancePole", "balance_pole_ppo", 1)
    monkeypatch.setitem(sys.modules, "experiments.ppo_learner", SimpleNamespace(CheckpointPlayer=lambda path: path))
    theirs = Path(__file__).parents[2] / "experiments" / "policies" / "balance_pole_wrench.pt"
    assert play.player_of(theirs) == theirs
    with pytest.raises(InputError, match=r"is a checkpoint of train_ppo\.py.*experiments/play\.py"):
        find_player(str(theirs))


def test_bad_input(tmp_path: Path) -> None:
    for policy, task, text in (
        ("push_cub_ppo", None, "did you mean 'push_cube_ppo'"),
        (str(tmp_path / "nothing.pt"), None, "must be a file that exists"),
        ("scripted", None, "task: must be given"),
        ("scripted", "Juggle", "task = 'Juggle'.*RollBall"),
        ("push_cube_ppo", "PushCube", "leave it out"),
    ):
        with pytest.raises(InputError, match=text):
            find_player(policy, task)
    out = tmp_path / "out"
    for wrong in ({"episodes": -1}, {"num_envs": 0}, {"optics": "fong"}, {"physics": "hard"}, {"seed": -1}):
        with pytest.raises(InputError, match=f"{next(iter(wrong))} = "):
            play_policy(ScriptedPlayer("RollBall"), out, **wrong)  # type: ignore[arg-type]
    assert not out.exists()


def test_settings_of_a_training_that_would_have_no_effect_are_refused() -> None:
    for wrong, text in (
        ({"processes": 2, "worlds": "mujoco_warp"}, "processes = 2: must be 0"),
        ({"launches": 4}, "launches = 4: is a setting of worlds 'mujoco_warp'"),
        ({"deviation": 0.1}, r"deviation = 0.1: must be a number in \[0.2, 2.0\]"),
        ({"deviation": 2.5}, "deviation = 2.5"),
        ({"deviation_floor": 3.0}, "deviation_floor = 3.0"),
    ):
        with pytest.raises(InputError, match=text):
            PpoSettings(**wrong)  # type: ignore[arg-type]


def test_a_strip_shows_moments_that_differ() -> None:
    """Nothing moves for 60 of 100 frames, then a bar of the scene moves; what sensors show does not count."""
    frames = []
    for k in range(100):
        frame = np.full((30, 60, 3), 255, np.uint8)
        bar = max(0, (k - 60) // 2)
        frame[:, bar : bar + 4] = 0
        frame[:, 40:] = 37 * k % 255
        frames.append(frame)
    at = moments(Film(frames, 0.02, ("sensor",)), 4)
    assert at[0] == 0 and at[-1] == 99
    assert at[1:3] == pytest.approx([60 + 40 / 3, 60 + 80 / 3], abs=3)
    still = Film(frames[:1] * 31, 0.02, ("sensor",))
    assert moments(still, 4).tolist() == [0, 10, 20, 30]
    assert moments(Film(frames[:1], 0.02, ()), 4).tolist() == [0, 0, 0, 0]


_SCRIPT = """
import gymnasium
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
scene = before[:, :320].astype(int)
sky = (scene == (238, 241, 245)).all(axis=2)
assert 0.1 < sky.mean() < 0.9, sky.mean()
assert len(np.unique(scene.reshape(-1, 3), axis=0)) > 500, "edges and shadows have shades"
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
    run_drawing(_SCRIPT, timeout=200.0)


def test_a_render_mode_that_is_not_there() -> None:
    from raytac.envs import RollBallEnv, RollBallVectorEnv

    for make in (RollBallEnv, RollBallVectorEnv):
        with pytest.raises(InputError, match="rgb_array"):
            make(render_mode="human", tactile=None)
    env = RollBallEnv(render_mode="rgb_array", tactile=None)
    with pytest.raises(InputError, match="reset"):
        env.render()
    assert RollBallEnv(tactile=None).render() is None
