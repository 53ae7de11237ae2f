"""Policies on rigid and soft pads: files read without PyTorch, what is played, and what is refused."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from experiments import soft_policies
from raytac.envs import FlatPolicy, read_tensors
from raytac.errors import InputError
from raytac.io import read_metrics

pytestmark = pytest.mark.usefixtures("few_cells")


def written(path: Path, program: bytes) -> Path:
    """A file like one of ``torch.save`` with this pickle in it, and two numbers."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("policy/data.pkl", program)
        archive.writestr("policy/data/0", np.arange(6.0, dtype="<f4").tobytes())
    return path


def test_tensors_have_their_strides_and_nothing_else_is_run(tmp_path: Path) -> None:
    # ((storage, "FloatStorage", "0", "cpu", 6), offset 1, size (2, 2), stride (1, 2)), as torch writes it in protocol 2.
    program = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
    program += b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x06tQK\x01K\x02K\x02\x86K\x01K\x02\x86\x89NtR."
    np.testing.assert_array_equal(read_tensors(written(tmp_path / "tensor.pt", program)), [[1.0, 3.0], [2.0, 4.0]])
    outside = program.replace(b"QK\x01", b"QK\x05")
    for bad in (outside, pickle.dumps(io.BytesIO), b"cos\nsystem\n(X\x04\x00\x00\x00trueltR.", b"no pickle"):
        with pytest.raises(InputError, match=r"must be a file of torch\.save"):
            read_tensors(written(tmp_path / "bad.pt", bad))
    with pytest.raises(InputError, match="must be a file that exists"):
        read_tensors(tmp_path / "nothing.pt")


def test_a_policy_pushes_the_cube_on_rigid_pads_and_a_run_goes_on(tmp_path: Path) -> None:
    """Success needs the right network: 252 of 256 in docs/measurements/learning.md."""
    args = soft_policies.Args(policies="push_cube_ppo", episodes=4, num_envs=4, device="cpu", out=tmp_path)
    row = soft_policies.played("push_cube_ppo", "rigid", args)
    assert row["task"] == "PushCube" and row["successes"] >= 3 and row["failed"] == 0  # type: ignore[operator]
    settings = {"episodes": 4, "num_envs": 4, "device": "cpu"}
    soft_policies.store(tmp_path / "rows.json", settings, [row, {**row, "physics": "ipc", "success": 0.25}])
    soft_policies.main(args)  # both are there already
    found = read_metrics(tmp_path / "metrics.json")
    assert found["PushCube.rigid.success"] == row["success"] and found["PushCube.ipc.success"] == 0.25


def test_what_cannot_be_played_is_refused(tmp_path: Path) -> None:
    for wrong, text in (({"policies": "nothing.pt"}, "policy = nothing.pt"), ({"episodes": 0}, "episodes = 0")):
        with pytest.raises(InputError, match=text):
            soft_policies.main(soft_policies.Args(out=tmp_path / "out", device="cpu", **wrong))  # type: ignore[arg-type]
    (tmp_path / "text.pt").write_text("no policy")
    assert not FlatPolicy.is_one(tmp_path / "text.pt")
