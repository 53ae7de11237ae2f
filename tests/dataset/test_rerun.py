"""A recording of an episode holds its frames: read back by Rerun's own command."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from raytac.dataset import Episode, write_rerun
from raytac.errors import BackendError, InputError

EPISODE = Episode(
    {
        "left_rgb": np.random.default_rng(0).integers(0, 256, (3, 4, 5, 3), np.uint8),
        "wrench": np.arange(18.0).reshape(3, 6) + 0.25,
        "height": np.ones((3, 6, 7), np.float32),
        "contact": np.ones((3, 6, 7), bool),
        "reward": np.array([0.5, 1.5, 2.5], np.float32),
    },
    10.0,
    "press",
    {"object": "coin"},
)


def test_frames_are_read_back(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    path = write_rerun(tmp_path / "episode.rrd", EPISODE)
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env={"HOME": str(tmp_path), "PATH": ""})
    rows = {name: int(count) for count, name in re.findall(r"with (\d+) rows? \([^)]*\) - /(\w+)", done.stdout)}
    assert {name: rows[name] for name in EPISODE.arrays} == dict.fromkeys(EPISODE.arrays, 3) and rows["about"] == 1
    for values in ("0.25, 1.25, 2.25, 3.25, 4.25, 5.25", "12.25, 13.25, 14.25, 15.25, 16.25, 17.25", "PT0.2S", "object: coin"):
        assert values in done.stdout
    for kind in ("Image:buffer", "Scalars:scalars", "Tensor:data", "TextDocument:text"):
        assert kind in done.stdout
    with pytest.raises(InputError, match="must not exist"):
        write_rerun(path, EPISODE)


def test_what_is_no_episode_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="episode"):
        write_rerun(tmp_path / "episode.rrd", [EPISODE])  # type: ignore[arg-type]


def test_without_rerun_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BackendError, match=r"pip install 'raytac\[rerun\]'"):
        write_rerun(tmp_path / "episode.rrd", EPISODE)
    assert not any(tmp_path.iterdir())
