"""The blocks of ``docs/guide/own-model.md`` run one after the other, on the gripper of the example."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def test_the_blocks_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(ROOT / "examples" / "gripper.xml", tmp_path)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "guide" / "own-model.md").read_text(encoding="utf-8"), flags=re.S
    )
    assert len(blocks) == 5
    names: dict[str, Any] = {}
    forces = []
    for block in blocks:
        exec(compile(block, "docs/guide/own-model.md", "exec"), names)
        if "frame" in names:
            frame = names.pop("frame")
            forces.append(frame.force[:, 2])
            assert not frame.failed.any()
    assert [len(force) for force in forces] == [2, 1, 1]
    np.testing.assert_allclose(names["still"].site("left_pad").xmat.reshape(3, 3)[:, 2], [0.0, -1.0, 0.0], atol=1e-12)
    assert (forces[0] < -1.0).all() and forces[2][0] < -1.0
    np.testing.assert_array_equal(forces[0][0], forces[0][1])
    assert names["reader"].read(names["data"])["left"].surface.indentation.max() > 5e-5
