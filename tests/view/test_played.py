"""What the page plays: presses of a data set, scripted and trained policies, and why a policy cannot be played."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import played
from raytac.cli.played import dataset_session, policy_session, scripted_session
from raytac.cli.view import ViewArgs
from raytac.dataset import DatasetPlan, PressDataset, render_dataset
from raytac.errors import InputError
from raytac.learn import shipped_policies
from raytac.observe import ObservationSettings
from raytac.specs import PressRanges, SweepSpec, load_press, load_sensor

POLICIES = Path(__file__).parents[2] / "experiments" / "policies"
SHOWN = ObservationSettings(("rgb", "markers", "wrench"), resolution=(40, 30), optics="phong")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sweep = SweepSpec(
        name="few",
        sensors=(load_sensor("gelsight_mini_9x11"),),
        objects=(load_press("sphere"), load_press("edge")),
        count=4,
        ranges=PressRanges(depth=(0.4e-3, 0.8e-3), x=(-1e-3, 1e-3), y=(0.0, 0.0), yaw=(0.0, 0.0)),
        shard_size=4,
        seed=5,
        optics="phong",
        outputs=("rgb", "height", "depth", "normals", "wrench", "traction"),
        markers="fots",
        resolution=(32, 24),
        pitch=0.4e-3,
    )
    made = tmp_path_factory.mktemp("data") / "few"
    render_dataset(DatasetPlan(sweep), made, device="cpu", batch=4)
    return made


def test_presses_of_a_data_set_are_shown_one_by_one(folder):
    session, data = dataset_session(folder), PressDataset(folder)
    assert "4 presses" in session.title and {"object_sphere", "object_edge"} <= {solid.name for solid in session.solids}
    for k in range(4):
        if k:
            assert session.advance()
        shown, press = session.snapshot(), data[k]
        (pad,) = shown.pads.values()
        np.testing.assert_array_equal(pad.rgb, press["rgb"])
        assert pad.wrench is not None and pad.wrench[2] < 0.0 and pad.markers_px is not None and pad.rest_rgb is not None
        deepest = (data.shared(k)["rest_height"] - press["height"]).max()
        assert pad.values["indentation"].max() == pytest.approx(deepest, rel=1e-5)
        assert pad.height is not None and pad.height.min() == pytest.approx(-deepest, abs=0.15e-3)  # pixels lie between nodes
        name = shown.facts["object"]
        assert shown.poses.keys() == {f"object_{name}"} and f"object_{name}" not in shown.hidden and len(shown.hidden) == 1
    assert not session.advance()
    session.drive({"timeline": 0.0})
    assert session.advance() and session.snapshot().facts["press"] == "0 of 3"


def test_a_scripted_policy_plays_an_episode_to_its_end():
    session = scripted_session("BalancePole", shown=SHOWN, device="cpu", physics=None)
    assert session.controls == () and session.handle is None
    first = session.snapshot()
    (pad,) = first.pads.values()
    assert pad.rgb is not None and pad.markers_px is not None and first.time == 0.0
    for _ in range(5):
        assert session.advance()
    shown = session.snapshot()
    assert shown.facts["episode"] == "0, running" and float(shown.facts["return"]) > 0.0 and shown.time
    session._driver._batch.max_episode_steps = 6  # type: ignore[attr-defined]
    assert session.advance() and session.snapshot().facts["episode"] == "0, success" and not session.advance()
    session.resume()
    assert session.advance() and session.snapshot().facts["episode"] == "1, running"
    session.reset()
    again = session.snapshot()
    assert again.facts["episode"] == "0, at its start"
    for name, pose in first.poses.items():
        np.testing.assert_allclose(again.poses[name], pose, atol=1e-12)
    with pytest.raises(InputError, match="BalancePole, LiftCube"):
        scripted_session("balance", shown=SHOWN, device="cpu", physics=None)


def test_a_trained_policy_plays_without_pytorch():
    session = policy_session(shipped_policies()["balance_pole_ppo"], shown=SHOWN, device="cpu", physics=None)
    assert session.title == "BalancePole · balance_pole_ppo.pt"
    for _ in range(20):
        assert session.advance()
    shown = session.snapshot()
    assert shown.facts["episode"] == "0, running" and "PyTorch" not in shown.warning
    assert all(pad.rgb is not None for pad in shown.pads.values())


def test_a_shipped_policy_is_viewed_by_its_name():
    session = ViewArgs(scene="roll_ball_ppo", optics="phong", device="cpu")._played()
    assert session is not None and session.title == "RollBall · roll_ball_ppo.pt" and session.advance()


def test_a_policy_that_needs_pytorch_is_said_on_the_page(monkeypatch):
    monkeypatch.setattr(played, "_has_torch", lambda: False)
    session = policy_session(POLICIES / "push_cube_markers.pt", shown=SHOWN, device="cpu", physics=None)
    assert "needs PyTorch, which is not installed" in session.snapshot().warning and not session.advance()
    monkeypatch.setattr(played, "_has_torch", lambda: True)
    session = policy_session(POLICIES / "push_cube_markers.pt", shown=SHOWN, device="cpu", physics=None)
    assert "experiments/play.py" in session.snapshot().warning


def test_the_command_knows_what_is_played(folder, tmp_path):
    assert ViewArgs(scene="sphere")._played() is None
    session = ViewArgs(scene=str(folder))._played()
    assert session is not None and "4 presses" in session.title
    with pytest.raises(InputError, match="played as it is"):
        ViewArgs(scene=str(folder), sensor="gelsight_mini")._played()
    with pytest.raises(InputError, match="exists"):
        ViewArgs(scene=str(tmp_path / "none.npz"))._played()
    with pytest.raises(InputError, match="exists"):
        ViewArgs(scene=str(tmp_path / "none.pt"))._played()
    with pytest.raises(InputError, match="scripted"):
        ViewArgs(scene="LiftCube", policy="clever")._played()


@pytest.mark.parametrize(
    ("lacking", "scene", "extra"), [("gymnasium", "lift_cube_ppo", "raytac[envs]"), ("pyarrow", "presses", "raytac[dataset]")]
)
def test_what_is_played_names_the_extra_that_it_lacks(lacking, scene, extra, folder):
    scene = str(folder) if scene == "presses" else scene
    code = (
        f"import sys; sys.modules[{lacking!r}] = None; "
        f"from raytac.cli import main; sys.exit(main(['view', {scene!r}, '--port', '0']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2 and done.stderr.startswith("raytac: error: ") and f"pip install '{extra}'" in done.stderr
