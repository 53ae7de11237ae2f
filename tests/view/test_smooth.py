"""Sharp edges get vertices of their own, round shapes keep theirs."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from raytac.view.scene_view import split_creases, vertex_normals


def test_a_box_falls_into_six_flat_faces():
    box = trimesh.creation.box()
    source, faces = split_creases(box.vertices, box.faces)
    assert len(source) == 24
    vertices = box.vertices[source]
    assert vertices[faces] == pytest.approx(box.vertices[box.faces])  # the same triangles, turned the same way
    normals = vertex_normals(vertices, faces)
    assert np.abs(normals).max(axis=1) == pytest.approx(np.ones(24))


def test_a_ball_stays_one_smooth_shape():
    ball = trimesh.creation.icosphere(subdivisions=2)
    source, faces = split_creases(ball.vertices, ball.faces)
    assert sorted(source) == list(range(len(ball.vertices)))
    assert (source[faces] == ball.faces).all()


def test_a_cylinder_is_round_along_its_side_and_sharp_at_its_rims():
    rod = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=32)
    source, faces = split_creases(rod.vertices, rod.faces)
    assert len(source) == len(rod.vertices) + 64  # both rims twice
    vertices = rod.vertices[source]
    normals = vertex_normals(vertices, faces)
    side = np.abs(normals[:, 2]) < 0.5
    assert np.abs(normals[side, 2]).max() < 1e-6 and np.abs(normals[~side, 2]).min() > 1.0 - 1e-6
    outwards = vertices[side, :2] / np.linalg.norm(vertices[side, :2], axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", outwards, normals[side, :2]).min() > 0.99


def test_open_sheets_and_faces_without_area_do_no_harm():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 4, 2]])
    source, split = split_creases(vertices, faces)
    assert vertices[source][split] == pytest.approx(vertices[faces])
    assert split[0, 0] == split[1, 0] and split[0, 2] == split[1, 1]
