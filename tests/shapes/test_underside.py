"""Undersides of shapes: closed forms, MuJoCo's ray caster as an independent judge, and meshes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from raytac.errors import InputError
from raytac.shapes.part import Part, hfield_part, mesh_part, primitive
from raytac.shapes.relief import looks_down, relief_part
from raytac.shapes.underside import object_bounds, object_height, object_radius

X = np.linspace(-6e-3, 6e-3, 49)
Y = np.linspace(-5e-3, 5e-3, 37)

GEOMS = {
    "sphere": (3e-3,),
    "capsule": (1.5e-3, 2.5e-3),
    "ellipsoid": (4e-3, 2e-3, 1e-3),
    "cylinder": (2.5e-3, 1.5e-3),
    "box": (3e-3, 2e-3, 1e-3),
}


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0.0:
        q[:, 0] *= -1.0
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q, rng.uniform(-2e-3, 2e-3, 3)
    return pose


def model_of(part: Part, pose: np.ndarray) -> mujoco.MjModel:
    """One geom of the same shape in MuJoCo, fixed at the pose."""
    spec = mujoco.MjSpec()
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
    geom = spec.worldbody.add_geom(pos=pose[:3, 3], quat=quaternion)
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{part.kind.upper()}")
    geom.size[: len(part.size)] = part.size
    return spec.compile()


def ray_heights(model: mujoco.MjModel, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z of MuJoCo's first hit on upward rays from z = −50 mm at pairs (x, y); inf for a miss."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = np.empty(len(x))
    geom = np.zeros(1, np.int32)
    for n, (px, py) in enumerate(zip(x, y, strict=True)):
        start = np.array([px, py, -0.05])
        distance = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, 1.0]), None, 1, -1, geom, np.zeros(3))
        found[n] = distance - 0.05 if distance >= 0.0 else np.inf
    return found


def assert_same(found: np.ndarray, expected: np.ndarray, atol: float) -> None:
    """Equal where both hit; hits and misses may differ only at a silhouette (few nodes)."""
    both = np.isfinite(found) & np.isfinite(expected)
    assert both.sum() > 20
    assert np.mean(np.isfinite(found) != np.isfinite(expected)) < 0.005
    np.testing.assert_allclose(found[both], expected[both], rtol=0.0, atol=atol)


def test_sphere_is_the_closed_form() -> None:
    centre = np.array([0.4e-3, -0.7e-3, 2e-3])
    pose = np.eye(4)
    pose[:3, 3] = centre
    found = object_height([primitive("sphere", (3e-3,))], pose[None], X, Y)[0]
    square = 9e-6 - (X[None, :] - centre[0]) ** 2 - (Y[:, None] - centre[1]) ** 2
    np.testing.assert_allclose(found[square >= 0.0], centre[2] - np.sqrt(square[square >= 0.0]), rtol=0.0, atol=1e-15)
    assert np.isinf(found[square < 0.0]).all()


@settings(max_examples=25, deadline=None)
@given(kind=st.sampled_from(sorted(GEOMS)), seed=st.integers(0, 10_000))
def test_primitives_agree_with_mujoco_rays(kind: str, seed: int) -> None:
    part, pose = primitive(kind, GEOMS[kind]), random_pose(seed)
    found = object_height([part], pose[None], X, Y)[0]
    xx, yy = np.meshgrid(X, Y)
    assert_same(found.ravel(), ray_heights(model_of(part, pose), xx.ravel(), yy.ravel()), 1e-9)


def surface_distance(part: Part, point: np.ndarray) -> np.ndarray:
    """Signed distance (N,) of part-frame points (3, N) to a torus or a rounded cone."""
    rho = np.hypot(point[0], point[1])
    if part.kind == "torus":
        return np.hypot(rho - part.size[0], point[2]) - part.size[1]
    radius, height, tip = part.size  # convex hull of the tip's disc and the base: three support functions in the half plane
    toward = np.arctan2(radius, height - tip) - np.arcsin(tip / np.hypot(radius, height - tip))
    flank = (rho * np.cos(toward)) - (point[2] - tip) * np.sin(toward) - tip
    below = point[2] < tip - tip * np.sin(toward)
    return np.where(below, np.hypot(rho, point[2] - tip) - tip, np.maximum(flank, point[2] - height))


@settings(max_examples=12, deadline=None)
@given(kind=st.sampled_from(["torus", "cone"]), seed=st.integers(0, 10_000))
@example(kind="torus", seed=327)  # lines that graze the inside of the tube, where a step by the slope jumps over it
@example(kind="torus", seed=394)
@example(kind="torus", seed=466)
def test_torus_and_cone_lie_on_their_surface_with_nothing_below(kind: str, seed: int) -> None:
    part = primitive(kind, (3e-3, 1e-3) if kind == "torus" else (2.5e-3, 4e-3, 0.6e-3))
    pose = random_pose(seed)
    found = object_height([part], pose[None], X, Y)[0]
    j, i = np.nonzero(np.isfinite(found))
    assert len(i) > 50

    def distance(z: np.ndarray) -> np.ndarray:
        return surface_distance(part, pose[:3, :3].T @ (np.stack([X[i], Y[j], z]) - pose[:3, 3:]))

    z = found[j, i]
    np.testing.assert_allclose(distance(z), 0.0, atol=1e-9)
    for t in np.linspace(0.05, 1.0, 20):
        assert (distance(z - t * 12e-3) > -1e-9).all()
    missed_j, missed_i = np.nonzero(np.isinf(found))
    for z0 in np.linspace(-6e-3, 6e-3, 61):
        point = np.stack([X[missed_i], Y[missed_j], np.full(len(missed_i), z0)])
        assert (surface_distance(part, pose[:3, :3].T @ (point - pose[:3, 3:])) > -1e-9).all()


def test_plane_that_looks_down_is_a_ceiling_and_one_that_looks_up_is_nothing() -> None:
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[:3, 3] = 0.0, 0.0, 1e-3
    np.testing.assert_allclose(object_height([primitive("plane")], down[None], X, Y), 1e-3)
    assert np.isinf(object_height([primitive("plane")], np.eye(4)[None], X, Y)).all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_mesh_agrees_with_the_box_it_describes(seed: int) -> None:
    import trimesh

    size, pose = (3e-3, 2e-3, 1e-3), random_pose(seed)
    box = trimesh.creation.box(2.0 * np.array(size))
    mesh = mesh_part(box.vertices, box.faces[:, ::-1])  # inside out on purpose: it must be turned
    assert mesh.closed
    expected = object_height([primitive("box", size)], pose[None], X, Y)[0]
    assert_same(object_height([mesh], pose[None], X, Y)[0].ravel(), expected.ravel(), 1e-12)
    open_mesh = mesh_part(np.asarray(box.vertices), np.concatenate([box.faces, box.faces[:1]]))
    assert not open_mesh.closed
    assert_same(object_height([open_mesh], pose[None], X, Y)[0].ravel(), expected.ravel(), 1e-12)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_concave_mesh_agrees_with_mujoco_rays(seed: int) -> None:
    import trimesh

    torus = trimesh.creation.torus(3e-3, 1e-3, major_sections=24, minor_sections=12)
    pose = random_pose(seed)
    found = object_height([mesh_part(torus.vertices, torus.faces)], pose[None], X, Y)[0]
    spec = mujoco.MjSpec()
    placed = torus.vertices @ pose[:3, :3].T + pose[:3, 3]
    spec.add_mesh(name="torus", uservert=placed.ravel(), userface=torus.faces.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="torus")
    xx, yy = np.meshgrid(X, Y)
    assert_same(found.ravel(), ray_heights(spec.compile(), xx.ravel(), yy.ravel()), 2e-8)  # MuJoCo keeps vertices in float32


def test_sphere_and_its_mesh_give_one_height_field() -> None:
    import trimesh

    radius = 4e-3
    ball = trimesh.creation.icosphere(5, radius)
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = 0.2e-3, 0.1e-3, 3e-3
    exact = object_height([primitive("sphere", (radius,))], pose, X, Y)[0]
    mesh = object_height([mesh_part(ball.vertices, ball.faces)], pose, X, Y)[0]
    longest = ball.edges_unique_length.max()
    sagitta = longest**2 / 6.0 / radius  # circumradius² / 2R of an equilateral facet, with the slope's factor below
    rho = np.hypot(X[None, :] - 0.2e-3, Y[:, None] - 0.1e-3)
    inner = rho < 0.7 * radius
    steepest = 1.0 / np.sqrt(1.0 - 0.7**2)
    difference = mesh[inner] - exact[inner]
    assert difference.min() > -1e-12  # the mesh is inscribed
    assert difference.max() < sagitta * steepest


def test_hfield_agrees_with_mujoco() -> None:
    rng = np.random.default_rng(3)
    rows, columns = 7, 9
    elevation = rng.uniform(0.0, 1.0, (rows, columns))
    size = (4e-3, 3e-3, 1e-3, 0.5e-3)
    spec = mujoco.MjSpec()
    spec.add_hfield(name="h", nrow=rows, ncol=columns, size=size, userdata=elevation.ravel())
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="h", quat=(0.0, 1.0, 0.0, 0.0))
    model = spec.compile()
    normalised = np.asarray(model.hfield_data, float).reshape(rows, columns)  # MuJoCo stretches the data to [0, 1]
    x, y = X + 1e-5, Y + 1e-5  # off the border, where MuJoCo's rays slip through the side wall
    found = object_height([hfield_part(size, normalised)], turn[None], x, y)[0]
    xx, yy = np.meshgrid(x, y)
    assert_same(found.ravel(), ray_heights(model, xx.ravel(), yy.ravel()), 1e-8)


def test_relief_face_down_is_its_elevation_and_tilts_like_a_plane() -> None:
    width, step = 4e-3, 1e-3
    part = relief_part(np.full((65, 65), step), width)
    inside = np.maximum(np.abs(X[None, :]), np.abs(Y[:, None])) < width - 1e-9
    found = object_height([part], np.eye(4)[None], X, Y)[0]
    np.testing.assert_allclose(found[inside], -step, atol=1e-15)
    assert np.isinf(found[~inside & (np.maximum(np.abs(X[None, :]), np.abs(Y[:, None])) > width + 1e-9)]).all()
    angle = 0.2
    pose = np.eye(4)
    pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    tilted = object_height([part], pose[None], X, Y)[0]
    plane = np.broadcast_to((Y * np.tan(angle) - step / np.cos(angle))[:, None], tilted.shape)
    seen = np.isfinite(tilted)
    assert seen.sum() > 500
    np.testing.assert_allclose(tilted[seen], plane[seen], atol=1e-12)


def test_relief_iteration_and_its_triangles_agree() -> None:
    line = np.linspace(-4e-3, 4e-3, 257)
    bump = 2e-3 * np.maximum(1.0 - (line[None, :] ** 2 + line[:, None] ** 2) / 3e-3**2, 0.0) ** 2
    part = relief_part(bump, 4e-3)
    assert part.vertices is not None and part.faces is not None
    triangles = mesh_part(part.vertices, part.faces)
    for angle, iterated in ((0.0, True), (0.2, True), (0.9, False)):
        pose = np.eye(4)
        pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        assert looks_down(part, pose) == iterated
        found, expected = (object_height([p], pose[None], X, Y)[0].ravel() for p in (part, triangles))
        both = np.isfinite(found) & np.isfinite(expected)
        assert both.sum() > 200 and np.mean(np.isfinite(found) != np.isfinite(expected)) < 0.02  # the rim's last cell
        np.testing.assert_allclose(found[both], expected[both], atol=2e-6)


def test_union_batch_and_bounds() -> None:
    parts = [primitive("sphere", (2e-3,)), primitive("box", (3e-3, 1e-3, 1e-3))]
    poses = np.stack([random_pose(s) for s in range(3)])
    together = object_height(parts, poses, X, Y)
    alone = [object_height([p], poses, X, Y) for p in parts]
    np.testing.assert_array_equal(together, np.minimum(*alone))
    for b in range(3):
        np.testing.assert_array_equal(together[b], object_height(parts, poses[b : b + 1], X, Y)[0])
        low, high = object_bounds(parts, poses[b])
        hit = np.isfinite(together[b])
        assert together[b][hit].min() >= low[2] - 1e-12 and together[b][hit].max() <= high[2] + 1e-12
        assert X[hit.any(axis=0)].min() >= low[0] - 1e-12 and Y[hit.any(axis=1)].max() <= high[1] + 1e-12


@pytest.mark.parametrize("kind", [*sorted(GEOMS), "plane", "cone", "torus"])
def test_environments_with_nodes_of_their_own_are_as_alone(kind: str) -> None:
    """Upright, tilted and lost ones in one batch."""
    part = primitive(kind, {**GEOMS, "plane": (), "cone": (2e-3, 3e-3, 0.5e-3), "torus": (2e-3, 1e-3)}[kind])
    poses = np.stack([np.eye(4), random_pose(1), np.full((4, 4), np.nan), random_pose(2)])
    x, y = (np.stack([line + shift for shift in (0.0, 1e-3, -2e-3, 5e-4)]) for line in (X, Y))
    together = object_height([part], poses, x, y)
    for b in range(4):
        np.testing.assert_array_equal(together[b], object_height([part], poses[b : b + 1], x[b], y[b])[0])
    assert np.isnan(together[2]).all() and np.isfinite(together[[0, 1, 3]]).any()


BODIES = {**GEOMS, "cone": (3e-3, 4e-3, 0.5e-3), "torus": (3e-3, 1e-3)}


def body(kind: str) -> Part:
    if kind != "mesh":
        return primitive(kind, BODIES[kind])
    import trimesh

    ball = trimesh.creation.icosphere(3, 3e-3)
    return mesh_part(ball.vertices, ball.faces)


@pytest.mark.parametrize("kind", [*BODIES, "mesh"])
def test_below_only_leaves_out_what_is_above_it(kind: str) -> None:
    part = body(kind)
    for seed in range(6):
        pose = random_pose(seed)[None]
        full = object_height([part], pose, X, Y)
        below = float(np.quantile(full[np.isfinite(full)], 0.2))
        cut = object_height([part], pose, X, Y, below=below)
        assert (full < below).any() and (full > below).any()
        np.testing.assert_array_equal(full[full < below], cut[full < below])
        assert (cut[full >= below] >= below).all()
        alone = object_height([part], pose, X[None], Y[None], below=below)  # as an environment with nodes of its own
        np.testing.assert_array_equal(full[full < below], alone[full < below])


@pytest.mark.parametrize("kind", [*BODIES, "mesh"])
def test_the_radius_holds_the_object(kind: str) -> None:
    from dataclasses import replace

    from raytac.shapes.triangulate import object_surface

    part = replace(body(kind), object_from_part=random_pose(4))
    away = float(np.linalg.norm(object_surface([part]).vertices, axis=1).max())
    assert away <= object_radius([part]) * (1 + 1e-12) and object_radius([part]) < away + np.linalg.norm(random_pose(4)[:3, 3])
    centred = replace(part, object_from_part=np.eye(4))
    assert object_radius([centred]) == pytest.approx(np.linalg.norm(object_surface([centred]).vertices, axis=1).max(), rel=0.01)
    assert object_radius([primitive("plane")]) == np.inf


def test_pose_that_is_not_finite_spoils_only_its_environment() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, 0, 3] = np.nan
    found = object_height([primitive("sphere", (3e-3,))], poses, X, Y)
    assert np.isnan(found[0]).all() and not np.isnan(found[1]).any()


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("blob", (1.0,)),
        ("sphere", ()),
        ("sphere", (-1.0,)),
        ("box", (1.0, np.nan, 1.0)),
        ("torus", (1.0, 2.0)),
        ("cone", (1.0, 2.0, 3.0)),
    ],
)
def test_impossible_primitives_are_refused(kind: str, size: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"kind|size"):
        primitive(kind, size)


def test_impossible_meshes_are_refused() -> None:
    corner = np.eye(3)
    with pytest.raises(InputError, match="finite"):
        mesh_part(corner * np.nan, np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match="index"):
        mesh_part(corner, np.array([[0, 1, 3]]))
    with pytest.raises(InputError, match="F > 0"):
        mesh_part(corner, np.zeros((0, 3), int))
    with pytest.raises(InputError, match="B, 4, 4"):
        object_height([primitive("sphere", (1e-3,))], np.eye(4), X, Y)


@pytest.mark.parametrize("kind", ["mesh", "relief"])
def test_no_vertex_is_placed_of_a_surface_that_is_away(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from raytac.shapes import underside

    elevation = 1e-3 * np.random.default_rng(0).uniform(size=(9, 9))
    part = body("mesh") if kind == "mesh" else relief_part(elevation, 3e-3)
    placed: list[int] = []
    candidates = underside._candidates
    monkeypatch.setattr(underside, "_candidates", lambda *given: (placed.append(1), candidates(*given))[1])
    for seed in range(20):
        pose = random_pose(seed)
        if kind == "relief" and looks_down(part, pose):
            continue
        assert part.vertices is not None
        points = part.vertices @ pose[:3, :3].T + pose[:3, 3]
        for axis, line in ((0, X), (1, Y)):
            aside = pose.copy()
            aside[axis, 3] += line[-1] - points[:, axis].min() + 6e-3
            assert np.isinf(object_height([part], aside[None], X, Y)).all()
        assert np.isinf(object_height([part], pose[None], X, Y, below=points[:, 2].min() - 6e-3)).all()
        assert not placed
        object_height([part], pose[None], X, Y, below=points[:, 2].min() + 1e-6)
        assert placed.pop() and not placed
        assert part.faces is not None
        centre, half = part.blocks
        corners = part.vertices[part.faces]
        held = (np.abs(corners[:, None] - centre[:, None]) <= half[:, None] + 1e-12).all(axis=(2, 3))
        assert len(centre) > 8 and np.any(held, axis=1).all()
