"""Search for contacts by kernels: against the NumPy reference, and what a search must not depend on."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh

from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.physics.rigid.contacts import LAW_POINTS, PadContacts
from raytac.physics.rigid.law_kernels import BINS, PUNCH_BINS
from raytac.physics.rigid.layer_response import reduced_modulus
from raytac.physics.rigid.load_law import LoadLaw
from raytac.physics.rigid.regions import region_lines
from raytac.physics.rigid.search import PadSearch
from raytac.se3 import rotations
from raytac.shapes.part import Part, mesh_part, primitive
from raytac.shapes.relief import relief_part
from raytac.shapes.underside import object_height, object_radius
from raytac.specs import load_sensor
from raytac.specs.sensor import GelpadSpec
from tests.gel.layer_contact import ABSENT, Layer
from tests.physics.rigid.oracle import PadOverlap
from tests.physics.rigid.oracle_cover import Covered
from tests.physics.rigid.oracle_pierced import BondedFace
from tests.physics.rigid.pad_overlap import least_width

DOME = load_sensor("gelsight_mini").gelpad
FLAT = replace(DOME, dome_radius=(math.inf, math.inf))
PRIMITIVES = "sphere", "capsule", "ellipsoid", "cylinder", "box", "cone", "torus"
KINDS = (*PRIMITIVES, "plane", "ball_mesh", "ring_mesh", "open_mesh", "relief", "compound")
REACH = 50e-6
LAYER = Layer(384, 38.4e-3, FLAT.thickness, FLAT.poisson_ratio)


def part_of(kind: str, rng: np.random.Generator) -> Part:
    """A part whose narrowest side the reference's grid resolves."""
    length = rng.uniform
    if kind == "sphere":
        return primitive(kind, (length(2e-3, 12e-3),))
    if kind == "capsule":
        return primitive(kind, (length(1e-3, 6e-3), length(1e-3, 15e-3)))
    if kind in ("ellipsoid", "box"):
        return primitive(kind, tuple(length(1.5e-3, 20e-3, 3)))
    if kind == "cylinder":
        return primitive(kind, tuple(length(1.5e-3, 12e-3, 2)))
    if kind == "cone":
        return primitive(kind, (length(3e-3, 8e-3), length(3e-3, 10e-3), length(0.3e-3, 1e-3)))
    if kind == "torus":
        minor = length(1e-3, 3e-3)
        return primitive(kind, (minor + length(1e-3, 6e-3), minor))
    if kind == "plane":
        return primitive(kind)
    if kind == "ring_mesh":
        mesh = trimesh.creation.annulus(2e-3, 6e-3, 5e-3, sections=40)
        return mesh_part(mesh.vertices, mesh.faces)
    if kind == "relief":
        line = np.linspace(-1.0, 1.0, 41)
        pattern = np.clip(1.2 - np.hypot(*np.meshgrid(line, line)), 0.0, None) * (1.0 + 0.3 * np.sin(7.0 * line))
        return relief_part(0.4e-3 * pattern, 6e-3)
    mesh = trimesh.creation.icosphere(3, 1.0)
    if kind == "ball_mesh":
        return mesh_part(mesh.vertices * length(3e-3, 9e-3, 3), mesh.faces)
    bowl = mesh.faces[(mesh.vertices[mesh.faces][:, :, 2] < 0.4).all(axis=1)]
    return mesh_part(5e-3 * mesh.vertices, bowl)


def body_of(kind: str, rng: np.random.Generator) -> list[Part]:
    def moved(part: Part, most: float) -> Part:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations(rng.normal(size=(1, 3)))[0], rng.uniform(-most, most, 3)
        return replace(part, object_from_part=pose)

    if kind == "compound":
        return [moved(part_of(one, rng), 4e-3) for one in rng.choice((*PRIMITIVES, "ball_mesh"), rng.integers(2, 5))]
    part = part_of(kind, rng)
    return [part] if kind in ("plane", "relief") or rng.random() < 0.5 else [moved(part, 3e-3)]


def turn_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Any turn; planes and reliefs face the pad, flat faces often lie nearly flat on it."""
    turn = rng.normal(size=3)
    if kind == "plane":
        turn = np.array([math.pi, 0.0, 0.0]) + rng.normal(0.0, 0.04, 3)
    elif kind == "relief":
        turn = rng.normal(0.0, 0.1, 3)
    elif kind in ("box", "cylinder", "compound") and rng.random() < 0.4:
        turn = rng.normal(0.0, 0.02, 3)
    return rotations(turn[None])[0]


def pressed(gelpad: GelpadSpec, count: int, seed: int) -> tuple[list[list[Part]], np.ndarray]:
    """Bodies and poses (count, 4, 4) at which each overlaps the pad by 20 µm to 1.3 mm on nodes of 0.2 mm."""
    rng, grid = np.random.default_rng(seed), make_grid(gelpad, 0.2e-3)
    bodies, poses = [], []
    while len(bodies) < count:
        kind = KINDS[len(bodies) % len(KINDS)]
        body, pose = body_of(kind, rng), np.eye(4)
        pose[:3, :3], pose[:2, 3] = turn_of(kind, rng), rng.uniform(-9e-3, 9e-3, 2)
        least = (object_height(body, pose[None], grid.x, grid.y)[0] - grid.rest).min()
        if np.isfinite(least):
            pose[2, 3] -= least + 10.0 ** rng.uniform(-4.7, -2.9)
            bodies.append(body)
            poses.append(pose)
    return bodies, np.stack(poses)


def search_one(gelpad: GelpadSpec, body: list[Part], poses: np.ndarray, reach: float = REACH) -> PadContacts:
    """Contacts of one body at poses (n, 4, 4), each an environment."""
    search = PadSearch([gelpad], [body], num_envs=len(poses))
    return search.contacts(poses[:, None, None], np.arange(len(poses)), reach)


def same(one: PadContacts, other: PadContacts) -> None:
    for field in fields(PadContacts):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


@pytest.mark.parametrize("count", [4 * len(KINDS), pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("gelpad", [DOME, FLAT], ids=["dome", "flat"])
def test_contacts_are_those_of_the_reference(gelpad: GelpadSpec, count: int) -> None:
    """Random bodies of every kind on each gelpad: depth 1 µm, centroid 5 µm, force 0.5 %.

    That is between the same levels of the gap. Of few nodes, more levels find a region of more force, and the stiffness of more of
    them is computed: by two nodes' share and 1 % at most.
    """
    bodies, poses = pressed(gelpad, count, seed=7)
    contacts = PadSearch([gelpad], bodies, num_envs=1).contacts(poses[None, None], np.array([0]), REACH)
    np.testing.assert_array_equal(contacts.body, np.arange(len(bodies)))
    grid, missed = make_grid(gelpad, 0.2e-3), 0
    for k, body in enumerate(bodies):
        overlap = PadOverlap(gelpad, least_width(body, poses[k]))
        touches = overlap.touches(body, poses[k : k + 1], object_radius(body))
        name = f"{k} {body[0].kind}"
        if not len(touches.env):  # it gives up steep tips between nodes of 0.8 mm
            least = (object_height(body, poses[k : k + 1], grid.x, grid.y)[0] - grid.rest).min()
            assert 0.0 <= contacts.depth[k] + least < 50e-6, name
            missed += 1
            continue
        depth = touches.depth[0]
        assert contacts.depth[k] == pytest.approx(depth, abs=1e-6), name
        np.testing.assert_allclose(contacts.centre[k], touches.centre[0], atol=5e-6, err_msg=name)
        np.testing.assert_allclose(contacts.normal[k], touches.normal[0], atol=1e-6, err_msg=name)
        covered = Covered(body, poses[k], gelpad, (touches.x[0], touches.y[0]), round(math.sqrt(touches.cell[0]), 5))
        depths = contacts.deepest[k] * np.linspace(0.0, 1.0, LAW_POINTS) ** 2
        at = np.flatnonzero((depths > 0.8 * depth) & (depths <= (1.0 + 1e-9) * min(depth, gelpad.thickness)))
        assert len(at) and contacts.deepest[k] > depth
        gap = np.maximum(touches.gap[0] + depth, 0.0)
        highest = 0.5 * contacts.deepest[k]
        cells = covered.cells(highest - depth)
        slope, offset, _ = region_lines(gap, touches.x[0], touches.y[0], gelpad, highest, BINS, PUNCH_BINS, cells)
        force = (slope * depths[at, None] - offset).max(axis=1)
        nodes = np.count_nonzero(touches.gap[0] < 0.0)
        np.testing.assert_allclose(contacts.force[k, at], force, rtol=5e-3 if nodes >= 10 else 5e-2, err_msg=name)
        law = LoadLaw(gap, touches.x[0], touches.y[0], gelpad, cells=cells)
        finely = [law.force(d) for d in depths[at]]
        np.testing.assert_allclose(contacts.force[k, at], finely, rtol=1.5e-2 + 2.0 / nodes, err_msg=name)
        # Of contacts wider than the gel is thick, not all nodes count that the radius would need.
        for radius, d in zip(contacts.radius[k, at], depths[at], strict=True):
            wide = law.contact_radius(d) > gelpad.thickness
            assert radius == pytest.approx(law.contact_radius(d), rel=(5e-2 if wide else 2e-2) + 3.0 / nodes), name
    assert missed <= max(1, 3 * count // 250)


@pytest.fixture(scope="module")
def crowd() -> tuple[list[list[Part]], np.ndarray]:
    """26 bodies at poses (8, 26, 4, 4), in contact, near and apart."""
    bodies, poses = pressed(DOME, 26, seed=11)
    moved = np.repeat(poses[None], 8, axis=0)
    moved[..., 2, 3] += np.random.default_rng(1).choice([0.0, 20e-6, 1e-3, 2e-3, 30e-3], moved.shape[:2])
    return bodies, moved


def test_an_environment_is_as_it_is_alone_and_in_any_order(crowd: tuple[list[list[Part]], np.ndarray]) -> None:
    bodies, poses = crowd
    search, envs = PadSearch([DOME, FLAT], bodies, num_envs=8), np.arange(8)
    both = np.stack([poses, poses[::-1]], axis=1)
    together = search.contacts(both, envs, 1e-3)
    assert len(together.env) > 100 and (together.depth < 0.0).any()
    order = np.lexsort((together.body, together.pad, together.env))
    np.testing.assert_array_equal(order, np.arange(len(order)))
    rows = [search.contacts(both[b : b + 1], envs[b : b + 1], 1e-3) for b in range(8)]
    same(together, PadContacts(**{f.name: np.concatenate([getattr(r, f.name) for r in rows]) for f in fields(PadContacts)}))
    turned = search.contacts(both[::-1], envs[::-1], 1e-3)
    order = np.lexsort((turned.body, turned.pad, turned.env))
    same(together, PadContacts(**{f.name: getattr(turned, f.name)[order] for f in fields(PadContacts)}))


def test_a_pose_that_is_not_finite_gives_a_row_of_nan_and_spoils_no_other() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 4e-3 - 0.2e-3
    poses[1, 0, 3] = np.nan
    found, ball = (
        search_one(DOME, [primitive("sphere", (4e-3,))], poses),
        search_one(DOME, [primitive("sphere", (4e-3,))], poses[:1]),
    )
    assert found.env.tolist() == [0, 1, 2]
    for name in ("depth", "clearance", "deepest"):
        assert np.isnan(getattr(found, name)[1])
    assert np.isnan(found.force[1]).all() and np.isnan(found.centre[1]).all()
    assert found.depth[0] == found.depth[2] == ball.depth[0]


def ball_over(x: float, gap: float, radius: float = 4e-3) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, radius + gap
    return pose


@pytest.mark.parametrize("gap", [2e-6, 0.1e-3, 0.7e-3, 1.9e-3])
def test_a_gap_is_as_wide_as_it_is_and_has_the_law_of_the_contact_to_come(gap: float) -> None:
    """A ball over a flat pad: closed form for the gap and its place; the law is that of the ball when it touches."""
    ball = [primitive("sphere", (4e-3,))]
    found = search_one(FLAT, ball, ball_over(3.33e-3, gap)[None], reach=2e-3)
    assert found.depth[0] == pytest.approx(-gap, abs=1e-6)
    np.testing.assert_allclose(found.centre[0], [3.33e-3, 0.0, gap], atol=30e-6)
    np.testing.assert_allclose(found.normal[0], [0.0, 0.0, 1.0], atol=1e-12)
    assert found.clearance[0] == pytest.approx(FLAT.thickness + gap, abs=1e-6)
    assert found.deepest[0] == pytest.approx(max(2e-3 - gap, 10e-6), rel=1e-3)
    touching = search_one(FLAT, ball, ball_over(3.33e-3, -0.4e-3)[None], reach=0.0)
    depths = [one.deepest[0] * np.linspace(0.0, 1.0, LAW_POINTS) ** 2 for one in (found, touching)]
    if gap < 1e-3:
        ours, theirs = (np.interp(0.4e-3, d, one.force[0]) for d, one in zip(depths, (found, touching), strict=True))
        assert ours == pytest.approx(theirs, rel=0.02)
    assert not len(search_one(FLAT, ball, ball_over(3.33e-3, gap)[None], reach=0.99 * gap).env)


def test_a_gap_between_nodes_has_its_place_along_both_axes() -> None:
    """A mesh of a ball so small that no node is near enough for the law, which counts gaps 15 µm greater than the least."""
    sphere = trimesh.creation.icosphere(4, 0.5e-3)
    x, y = (
        np.linspace(-0.5 * size, 0.5 * size, round(size / 0.2e-3) + 1)[40] + np.array([0.1e-3, 0.08e-3]) for size in FLAT.size
    )
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = np.stack([x, y[::-1], np.full(2, 0.52e-3)], axis=1)
    found = search_one(FLAT, [mesh_part(sphere.vertices, sphere.faces)], poses)
    np.testing.assert_allclose(found.depth, -20e-6, atol=3e-6)
    np.testing.assert_allclose(found.centre[:, :2], poses[:, :2, 3], atol=10e-6)


def test_what_is_beside_above_or_behind_the_pad_gives_no_row() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [[40e-3, 0.0, 0.0], [0.0, 0.0, 20e-3], [0.0, 0.0, -30e-3], [18e-3, 0.0, 1e-3]]
    assert not len(search_one(DOME, [primitive("sphere", (4e-3,))], poses, reach=1e-3).env)
    up = np.eye(4)
    up[2, 3] = 1e-3  # a half-space that looks up has no underside
    assert not len(search_one(DOME, [primitive("plane")], up[None]).env)


@pytest.mark.parametrize("radius", [0.06e-3, 0.15e-3, 0.3e-3])
def test_a_thin_pin_is_seen_between_any_nodes(radius: float) -> None:
    """Upright, of a length that its bounding ball is wide; the depth is that of its flat end."""
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :2, 3] = rng.uniform(-5e-3, 5e-3, (30, 2))
    poses[:, 2, 3] = 10e-3 - 0.3e-3
    found = search_one(FLAT, [primitive("cylinder", (radius, 10e-3))], poses)
    assert found.env.tolist() == list(range(30))
    np.testing.assert_allclose(found.depth, 0.3e-3, atol=1e-9)
    np.testing.assert_allclose(found.centre[:, :2], poses[:, :2, 3], atol=0.1e-3)


def test_a_blade_across_the_pad_is_seen_at_any_angle() -> None:
    angles = np.linspace(0.03, 3.1, 13)  # at 45° exactly, its sides run through nodes
    poses = np.tile(np.eye(4), (13, 1, 1))
    poses[:, :3, :3] = rotations(angles[:, None] * [0.0, 0.0, 1.0])
    poses[:, :3, 3] = 0.33e-3, 0.11e-3, 5e-3 - 0.2e-3
    found = search_one(FLAT, [primitive("box", (4e-3, 0.1e-3, 5e-3))], poses)
    np.testing.assert_allclose(found.depth, np.full(13, 0.2e-3), atol=1e-9)
    np.testing.assert_allclose(found.centre, np.tile([0.33e-3, 0.11e-3, -0.2e-3], (13, 1)), atol=0.1e-3)


def test_an_edge_is_as_deep_as_it_is() -> None:
    """A cube on its edge, at angles at which a parabola through its faces would be off by hundreds of micrometres."""
    angle, half = np.array([0.05, 0.2, 0.5, 0.785, 1.2]), 8e-3
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = rotations(angle[:, None] * [1.0, 0.0, 0.0])
    poses[:, 2, 3] = half * (np.cos(angle) + np.sin(angle)) - 0.3e-3
    found = search_one(FLAT, [primitive("box", (half, half, half))], poses)
    slope = np.minimum(np.tan(angle), 1.0 / np.tan(angle))
    assert (found.depth < 0.3e-3 + 20e-6).all()
    assert (found.depth > 0.3e-3 - 0.5 * 0.82e-3 * slope - 1e-9).all()


@pytest.mark.parametrize("radius", [1.5e-3, 4e-3])
def test_a_flat_face_that_tilts_keeps_its_middle(radius: float) -> None:
    """A tilt in full contact changes the force at a depth of the middle by less than 2 %."""
    depth, poses = 0.13e-3, np.tile(np.eye(4), (3, 1, 1))
    for pose, share in zip(poses, (0.0, 0.25, 0.5), strict=True):
        tilt = share * depth / radius
        pose[:3, :3] = rotations(np.array([[tilt, 0.5 * tilt, 0.0]]) / math.sqrt(1.25))[0]
        pose[2, 3] = 2e-3 - depth
    contacts = search_one(FLAT, [primitive("cylinder", (radius, 2e-3))], poses)
    at = contacts.deepest[:, None] * np.linspace(0.0, 1.0, LAW_POINTS) ** 2
    force = [np.interp(d, line, row) for d, line, row in zip(contacts.depth, at, contacts.force, strict=True)]
    assert contacts.depth[2] > 1.4 * depth
    np.testing.assert_allclose(force, force[0], rtol=0.02)


def test_nodes_on_the_edges_of_the_pad_stand_for_the_cells_on_it() -> None:
    pose = np.eye(4)
    pose[1, 1] = pose[2, 2] = -1.0
    pose[2, 3] = -0.1e-3
    contacts = search_one(FLAT, [primitive("plane")], pose[None])
    x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / 0.8e-3) + 1) for size in FLAT.size)
    whole = LoadLaw(np.zeros((len(y), len(x))), x, y, FLAT)
    assert contacts.radius[0, -1] == pytest.approx(whole.contact_radius(0.1e-3), rel=1e-3)


def test_the_hole_of_a_torus_and_the_hollow_of_a_cup_stay_open() -> None:
    ring = np.eye(4)
    ring[2, 3] = 1e-3 - 0.2e-3
    torus = search_one(FLAT, [primitive("torus", (5e-3, 1e-3))], ring[None])
    np.testing.assert_allclose(torus.centre[0, :2], 0.0, atol=1e-9)
    line = LAYER.lines
    across = 1e-6 - (np.hypot(line[None, :], line[:, None]) - 5e-3) ** 2
    overlap = np.where(across > 0.0, 0.2e-3 - 1e-3 + np.sqrt(np.maximum(across, 0.0)), ABSENT)
    assert forces(torus)[0] == pytest.approx(layer_force(overlap), rel=0.17)  # of a thin ring the law is as much too stiff
    walls = [
        primitive("box", size, translated(at))
        for size, at in (
            ((6e-3, 0.5e-3, 3e-3), (0.0, 5.5e-3, 0.0)),
            ((6e-3, 0.5e-3, 3e-3), (0.0, -5.5e-3, 0.0)),
            ((0.5e-3, 6e-3, 3e-3), (5.5e-3, 0.0, 0.0)),
            ((0.5e-3, 6e-3, 3e-3), (-5.5e-3, 0.0, 0.0)),
            ((6e-3, 6e-3, 0.5e-3), (0.0, 0.0, 2.5e-3)),
        )
    ]
    cup = search_one(FLAT, walls, translated((0.0, 0.0, 3e-3 - 0.2e-3))[None])
    assert cup.depth[0] == pytest.approx(0.2e-3, abs=1e-9)
    side = np.maximum(np.abs(line[None, :]), np.abs(line[:, None]))
    rim = np.where((side > 5e-3) & (side < 6e-3), 0.2e-3, ABSENT)
    assert forces(cup)[0] == pytest.approx(layer_force(rim), rel=0.12)


def layer_force(overlap: np.ndarray) -> float:
    """Force [N] of the bonded layer under an overlap on the nodes of ``LAYER``."""
    pressure, _ = LAYER.press(overlap, 2e-4)
    return float(pressure.sum()) * LAYER.pitch**2 * reduced_modulus(FLAT)


def translated(at: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = at
    return pose


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule", "ball_mesh"])
def test_clearance_tells_what_went_through_the_gel(kind: str) -> None:
    """At 150 poses about the layer behind the bonded face, as ``BondedFace`` does."""
    rng = np.random.default_rng(5)
    size = {"sphere": (3e-3,), "box": (4e-3, 2e-3, 1e-3), "cylinder": (2e-3, 3e-3), "capsule": (1e-3, 3e-3)}
    body = [part_of(kind, rng) if kind == "ball_mesh" else primitive(kind, size[kind])]
    poses = np.tile(np.eye(4), (150, 1, 1))
    poses[:, :3, :3] = rotations(rng.normal(size=(150, 3)))
    poses[:, :3, 3] = rng.uniform([-0.015, -0.013, -0.03], [0.015, 0.013, 0.01], (150, 3))
    expected = BondedFace(DOME).pierced(body, poses, object_radius(body))
    found = search_one(DOME, body, poses, reach=0.1e-3)
    through = np.zeros(150, bool)
    through[found.env[found.clearance <= 0.0]] = True
    np.testing.assert_array_equal(through, expected)
    assert 10 < expected.sum() < 140


def test_bad_arrays_are_refused() -> None:
    search = PadSearch([DOME], [[primitive("sphere", (4e-3,))]], num_envs=2)
    poses = np.tile(np.eye(4), (2, 1, 1, 1, 1))
    with pytest.raises(InputError, match="pad_from_body"):
        search.contacts(poses[:, :, 0], np.arange(2), 0.0)
    with pytest.raises(InputError, match="envs"):
        search.contacts(poses, np.arange(3), 0.0)
    for reach in (-1e-3, np.nan, np.zeros((3, 1))):
        with pytest.raises(InputError, match="reach"):
            search.contacts(poses, np.arange(2), reach)
    with pytest.raises(InputError, match=r"bodies\[0\]"):
        PadSearch([DOME], [[]], num_envs=1)


@pytest.mark.gpu
def test_cuda_finds_what_the_cpu_finds(crowd: tuple[list[list[Part]], np.ndarray]) -> None:
    bodies, poses = crowd
    cpu, cuda = (
        PadSearch([DOME], bodies, num_envs=8, device=device).contacts(poses[:, None], np.arange(8), 1e-3)
        for device in ("cpu", "cuda")
    )
    for name in ("env", "pad", "body"):
        np.testing.assert_array_equal(getattr(cuda, name), getattr(cpu, name))
    for name, tolerance in (("depth", 1e-9), ("centre", 1e-8), ("normal", 1e-6), ("clearance", 1e-9), ("deepest", 1e-8)):
        np.testing.assert_allclose(getattr(cuda, name), getattr(cpu, name), atol=tolerance, rtol=0.0, err_msg=name)
    np.testing.assert_allclose(cuda.force, cpu.force, rtol=1e-4, atol=1e-9)
    again = PadSearch([DOME], bodies, num_envs=8, device="cuda")
    same(again.contacts(poses[:, None], np.arange(8), 1e-3), cuda)
    alone = again.contacts(poses[3:4, None], np.array([3]), 1e-3)
    same(alone, PadContacts(**{f.name: getattr(cuda, f.name)[cuda.env == 3] for f in fields(PadContacts)}))


def test_the_spread_is_that_of_a_punch_and_of_a_ball() -> None:
    """∫ x² dA / ∫ u dA: a² / 3δ of a flat punch of half width a, and R of a ball, where u = δ − r² / 2R; by nodes of 0.8 mm."""
    half, radius, depth = np.array([3e-3, 4e-3]), 5e-3, 0.2e-3
    pose = np.eye(4)[None]
    pose[0, 2, 3] = 5e-3 - depth
    punch = search_one(FLAT, [primitive("box", (*half, 5e-3))], pose)
    np.testing.assert_allclose(
        punch.spread[0], [*(half**2 / (3.0 * depth))[[0]], 0.0, half[1] ** 2 / (3.0 * depth)], rtol=0.15, atol=1e-9
    )
    ball = search_one(FLAT, [primitive("sphere", (radius,))], pose)
    np.testing.assert_allclose(ball.spread[0], [radius, 0.0, radius], rtol=0.15, atol=1e-9)
    pose[0, 2, 3] = 5e-3 + 20e-6
    np.testing.assert_array_equal(search_one(FLAT, [primitive("sphere", (radius,))], pose).spread, np.zeros((1, 3)))


@pytest.mark.parametrize("gelpad", [DOME, FLAT], ids=["dome", "flat"])
@pytest.mark.parametrize("kind", ["box", "cylinder", "plane"])
def test_a_convex_body_is_measured_as_any_other(kind: str, gelpad: GelpadSpec) -> None:
    """Where convexity bounds the search: as the same part given twice, which is searched without."""
    rng = np.random.default_rng(3)
    size = {"box": (15e-3, 6e-3, 5e-3), "cylinder": (6e-3, 5e-3), "plane": ()}[kind]
    part, grid = primitive(kind, size), make_grid(gelpad, 0.1e-3)
    poses = np.tile(np.eye(4), (80, 1, 1))
    turned = rotations(np.array([[math.pi, 0.0, 0.0]]))[0] if kind == "plane" else np.eye(3)
    tilt = 10.0 ** rng.uniform(-4.0, -0.7, (80, 1)) * rng.normal(size=(80, 3))
    tilt[:, 2] = rng.uniform(-3.0, 3.0, 80)
    poses[:, :3, :3] = rotations(tilt) @ turned
    poses[:, :2, 3] = rng.uniform(-14e-3, 14e-3, (80, 2))
    under = object_height([part], poses, grid.x, grid.y)
    least = (under - grid.rest).min(axis=(1, 2))
    poses, under, least = (v[np.isfinite(least)] for v in (poses, under, least))
    shift = np.where(rng.random(len(poses)) < 0.3, -1.0, 1.0) * 10.0 ** rng.uniform(-5.0, -3.5, len(poses))
    poses[:, 2, 3] -= least + shift
    one, two = (search_one(gelpad, parts, poses, reach=0.2e-3) for parts in ([part], [part, part]))
    np.testing.assert_array_equal(one.env, two.env)
    assert (one.depth < 0.0).sum() > 5 and (one.depth > 0.0).sum() > 30
    touches = one.depth > 0.0
    for name in ("depth", "centre", "normal", "spread", "deepest"):
        np.testing.assert_array_equal(getattr(one, name)[touches], getattr(two, name)[touches], err_msg=name)
    np.testing.assert_allclose(one.depth, two.depth, atol=1e-6)  # of a gap by parabolas on a coarser grid
    np.testing.assert_allclose(one.centre, two.centre, atol=5e-6)
    for name in ("force", "radius"):  # also at the last entries, which the nodes at the box's edges decide
        these, those = getattr(one, name)[touches], getattr(two, name)[touches]
        np.testing.assert_allclose(these, those, rtol=1e-4, atol=1e-9, err_msg=name)
    lowest = (under - (least + shift)[:, None, None]).min(axis=(1, 2))[one.env]
    np.testing.assert_allclose(one.clearance, gelpad.thickness + lowest, atol=60e-6)


def prism(corners: int, radius: float, half: float) -> Part:
    mesh = trimesh.creation.cylinder(radius, 2.0 * half, sections=corners)
    return mesh_part(mesh.vertices, mesh.faces)


FLAT_FACES = {
    "box": (primitive("box", (4e-3, 5e-3, 3e-3)), np.eye(3)),
    "coin": (primitive("cylinder", (5e-3, 1e-3)), np.eye(3)),
    "cylinder": (primitive("cylinder", (4e-3, 5e-3)), rotations(np.array([[0.0, math.pi / 2, 0.0]]))[0]),
    "capsule": (primitive("capsule", (4e-3, 5e-3)), rotations(np.array([[0.0, math.pi / 2, 0.0]]))[0]),
    "cone": (primitive("cone", (5e-3, 6e-3, 0.5e-3)), np.diag([1.0, -1.0, -1.0])),
    "square mesh": (prism(4, 6e-3, 3e-3), rotations(np.array([[0.0, 0.0, math.pi / 4]]))[0]),
    "hexagonal mesh": (prism(6, 5e-3, 3e-3), np.eye(3)),
}
SWEEPS = {"x": 2e-6, "y": 2e-6, "depth": 0.5e-6, "roll": 1e-4, "pitch": 1e-4, "yaw": 5e-4}
"""Steps [m] or [rad]."""


def swept(part: Part, turn: np.ndarray, gelpad: GelpadSpec, along: str, count: int = 401) -> np.ndarray:
    """Poses (count, 4, 4) about one that is 0.3 mm deep, less than a node's spacing on either side."""
    poses, grid = np.tile(np.eye(4), (count, 1, 1)), make_grid(gelpad, 0.1e-3)
    poses[:, :3, :3], poses[:, :3, 3] = turn, (1.3e-3, 0.7e-3, 0.0)
    poses[:, 2, 3] -= (object_height([part], poses[:1], grid.x, grid.y)[0] - grid.rest).min() + 0.3e-3
    steps = SWEEPS[along] * (np.arange(count) - count // 2)
    if along in "xy":
        poses[:, "xy".index(along), 3] += steps
    elif along == "depth":
        poses[:, 2, 3] -= steps
    else:
        axis = np.eye(3)[["roll", "pitch", "yaw"].index(along)]
        poses[:, :3, :3] = rotations(steps[:, None] * axis) @ turn
    return poses


def forces(contacts: PadContacts) -> np.ndarray:
    at = contacts.deepest[:, None] * np.linspace(0.0, 1.0, LAW_POINTS) ** 2
    return np.array([np.interp(d, line, row) for d, line, row in zip(contacts.depth, at, contacts.force, strict=True)])


@pytest.mark.parametrize("gelpad", [DOME, FLAT], ids=["dome", "flat"])
@pytest.mark.parametrize("along", SWEEPS)
@pytest.mark.parametrize("kind", FLAT_FACES)
def test_a_force_does_not_jump_where_edges_pass_nodes(kind: str, along: str, gelpad: GelpadSpec) -> None:
    """Less than 1 % from pose to pose, beyond what the poses beside them change."""
    part, turn = FLAT_FACES[kind]
    contacts = search_one(gelpad, [part], swept(part, turn, gelpad, along), reach=20e-6)
    assert len(contacts.env) == 401
    force = forces(contacts)
    change = np.abs(np.diff(force)) / force[1:]
    beside = np.lib.stride_tricks.sliding_window_view(np.pad(change, 10, mode="edge"), 21)
    assert (change - 2.0 * np.median(beside, axis=1)).max() < 0.01


@pytest.mark.parametrize("kind", ["box", "square mesh"])
def test_a_face_has_its_area_wherever_it_lies(kind: str) -> None:
    part, turn = FLAT_FACES[kind]
    contacts = search_one(FLAT, [part], swept(part, turn, FLAT, "x")[::20], reach=20e-6)
    half = np.array([4e-3, 5e-3]) if kind == "box" else np.full(2, 6e-3) / math.sqrt(2.0)
    line = np.arange(-7e-3, 7e-3, 0.05e-3)
    face = np.where((np.abs(line)[None, :] < half[0]) & (np.abs(line)[:, None] < half[1]), 0.0, np.inf)
    law = LoadLaw(face, line, line, FLAT)
    np.testing.assert_allclose(contacts.radius[:, -1], law.contact_radius(0.1e-3), rtol=0.01)
    force = forces(contacts)
    np.testing.assert_allclose(force, [law.force(depth) for depth in contacts.depth], rtol=0.03)
    np.testing.assert_allclose(force, force.mean(), rtol=0.007)
