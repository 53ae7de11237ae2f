"""Warp starts where the user's cache is missing or cannot be written, and keeps nothing there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import os, sys
if sys.argv[1] == "homeless":
    os.getuid = lambda: 4242424
import warp as wp
from ipc.warp_start import start_warp
wp.config.log_level = wp.LOG_WARNING
start_warp()
start_warp()
print(wp.config.kernel_cache_dir, os.path.isdir(wp.config.kernel_cache_dir))
"""


@pytest.mark.parametrize("home", ["homeless", "closed", "own"])
def test_warp_starts_without_a_cache_of_the_user(home: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    env = {"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin", "TMPDIR": str(tmp_path)}
    env |= {"homeless": {}, "closed": {"HOME": str(tmp_path / "file" / "home")}, "own": {"HOME": str(tmp_path / "home")}}[home]
    done = subprocess.run([sys.executable, "-c", CODE, home], capture_output=True, text=True, env=env, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    folder, is_there = done.stdout.split()
    assert is_there == "True"
    if home == "own":
        assert Path(folder).is_relative_to(tmp_path / "home/.cache/warp") and "cannot be written" not in done.stderr
    else:
        assert done.stderr.count("WARP_CACHE_PATH names another folder") == 1
        assert Path(folder).parent.name.startswith("warp-kernels-") and not Path(folder).exists(), "removed at the end"
        assert not (tmp_path / "~").exists()
