"""What needs an extra says which one, in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.forked import IMPORTED, ROOT, run_forked

VIEWER = "the viewer is not installed: pip install 'raytac[view]'"
VECTOR = "import gymnasium, raytac.envs; gymnasium.make_vec('raytac/PushCubeWarp-v0')"
MISSING = """
import importlib.abc, importlib.util, sys
lost = {lost!r}
known = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in lost else known(name, package)


class Without(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in lost:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)


sys.meta_path.insert(0, Without())
"""


@pytest.mark.parametrize(
    ("lost", "code", "message"),
    [
        (("msgspec",), "from raytac.cli import main; sys.exit(main(['view', 'coin']))", VIEWER),
        (("msgspec",), "from raytac.view import Viewer", VIEWER),
        (("gymnasium",), "from raytac.observe import AddTactile", "pip install 'raytac[envs]'"),
        (("gymnasium",), "import raytac.envs", "pip install 'raytac[envs]'"),
        (("gymnasium",), "from raytac.cli import main; sys.exit(main(['play', 'push_cube_ppo']))", "pip install 'raytac[envs]'"),
        (("torch",), "from raytac.cli import main; sys.exit(main(['train']))", "train_policies needs PyTorch, which is not installed: pip"),
        (("rsl_rl",), "from raytac.learn import Training", "Training needs "),
        (("torch",), "from raytac.envs import WarpBatch", "WarpBatch needs PyTorch, which is not installed: pip install 'raytac[rl]'"),
        (("h5py",), "from raytac.dataset import write_hdf5; write_hdf5('new.h5', [])", "pip install 'raytac[export]'"),
        (("zarr",), "from raytac.dataset import write_zarr; write_zarr('new.zarr', [])", "pip install 'raytac[export]'"),
        (("torch",), "from raytac.dataset import PressTensors", "PressTensors needs PyTorch, which is not installed: pip install torch"),
        (("torch",), VECTOR, "pip install 'raytac[rl]'"),
        (("mujoco_warp",), "import raytac; raytac.TactileWorld('push_cube', engine='mujoco_warp')", "pip install 'raytac[gpu]'"),
    ],
)  # fmt: skip
def test_what_is_not_installed_is_named_with_its_extra(lost: tuple[str, ...], code: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "asks.py").write_text(MISSING.format(lost=lost) + code)
    if set(lost) & set(IMPORTED):  # a fork has them
        asked = [sys.executable, str(tmp_path / "asks.py")]
        done = subprocess.run(asked, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False)
    else:
        done = run_forked(str(tmp_path / "asks.py"), cwd=tmp_path)
    assert done.returncode and message in done.stderr.strip().splitlines()[-1]
