"""Rotations and poses of NumPy arrays and of PyTorch tensors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raytac.se3 import pose, rotations

torch = pytest.importorskip("torch")


def vectors() -> np.ndarray:
    """Rotation vectors (40, 3): ordinary ones, none, tiny ones and half turns about each axis."""
    result = np.random.default_rng(0).normal(0.0, 1.5, (40, 3))
    result[0], result[1:4], result[4:7], result[7] = 0.0, 1e-9 * np.eye(3), np.pi * np.eye(3), [1e-200, 0.0, 0.0]
    return result


def test_rotations_are_scipys_in_both_libraries() -> None:
    v = vectors()
    expected = Rotation.from_rotvec(v).as_matrix()
    np.testing.assert_allclose(rotations(v), expected, atol=1e-15)
    np.testing.assert_array_equal(rotations(v[9]), rotations(v)[9])
    np.testing.assert_array_equal(rotations(v.reshape(4, 10, 3)), rotations(v).reshape(4, 10, 3, 3))
    np.testing.assert_allclose(rotations(torch.asarray(v)).numpy(), expected, atol=1e-15)
    single = rotations(torch.asarray(v, dtype=torch.float32))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), expected, atol=1e-6)


def test_a_pose_takes_a_rotation_each_or_one_for_all() -> None:
    turns, places = rotations(vectors()), np.random.default_rng(1).normal(size=(40, 3))
    each = pose(turns, places)
    for k in range(40):
        np.testing.assert_array_equal(each[k], np.block([[turns[k], places[k, :, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
    np.testing.assert_array_equal(pose(turns[9], places)[:, :3, :3], np.broadcast_to(turns[9], (40, 3, 3)))
    np.testing.assert_array_equal(pose(turns[9], places[9]), each[9])
    tensor = pose(torch.asarray(turns, dtype=torch.float32), torch.asarray(places, dtype=torch.float32))
    assert tensor.dtype == torch.float32
    np.testing.assert_array_equal(tensor.numpy(), each.astype(np.float32))
