"""The tetrahedral pad and the surfaces of objects: volumes, closedness, symmetry, and what is refused."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import ipctk
import numpy as np
import pytest
import trimesh

from raytac.errors import InputError
from raytac.physics.objects import object_parts
from raytac.physics.soft.bodies import object_body, scene_body
from raytac.physics.soft.mesh import PAD_LEVELS, PadMesh, pad_mesh
from raytac.shapes.part import mesh_part, primitive
from raytac.shapes.triangulate import object_surface, part_surface
from raytac.shapes.underside import lowest_of_triangles, object_height
from raytac.specs import load_press, load_sensor
from raytac.specs.files import available
from raytac.specs.press import PADS

GELPAD = load_sensor("gelsight_mini").gelpad
VOLUMES = {
    ("sphere", (4e-3,)): 4 / 3 * math.pi * 64e-9,
    ("ellipsoid", (4e-3, 2e-3, 1e-3)): 4 / 3 * math.pi * 8e-9,
    ("box", (1e-3, 2e-3, 3e-3)): 48e-9,
    ("cylinder", (2e-3, 3e-3)): math.pi * 24e-9,
    ("capsule", (2e-3, 3e-3)): math.pi * 24e-9 + 4 / 3 * math.pi * 8e-9,
    ("cone", (4e-3, 5e-3, 0.0)): math.pi * 80e-9 / 3,
    ("torus", (4e-3, 1e-3)): 2 * math.pi**2 * 4e-9,
}


def volume_of(mesh):
    corners = mesh.vertices[mesh.tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


@pytest.mark.parametrize("level", PADS)
def test_a_pad_fills_its_dome(level):
    mesh = pad_mesh(GELPAD, level)
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, 801) * size for size in GELPAD.size))
    truth = GELPAD.size[0] * GELPAD.size[1] * (GELPAD.thickness - GELPAD.sag(x, y).mean())
    assert volume_of(mesh.tets).sum() == pytest.approx(truth, rel=2e-3)
    assert set(PAD_LEVELS) == set(PADS)
    top = mesh.tets.vertices[mesh.coat_vertices]
    assert np.array_equal(top, mesh.coat.rest) and np.allclose(top[:, 2], -GELPAD.sag(top[:, 0], top[:, 1]), atol=1e-15)
    assert (mesh.tets.vertices[mesh.bonded, 2] == -GELPAD.thickness).all()


def test_levels_are_graded_towards_the_face_and_the_middle():
    mesh = pad_mesh(GELPAD, "medium")
    along, heights = (
        np.diff(mesh.coat.lines_x),
        np.diff(np.unique(np.round(mesh.tets.vertices[:, 2][mesh.tets.vertices[:, 0] == 0], 9))),
    )
    assert along.argmin() in (len(along) // 2 - 1, len(along) // 2) and along.max() / along.min() > 2
    assert heights[0] > 1.5 * heights[-1]


def test_a_pad_is_symmetric():
    mesh = pad_mesh(GELPAD, "coarse")
    for axis in (0, 1):
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        keys = {tuple(np.round(v, 9) + 0.0) for v in mesh.tets.vertices}
        assert all(tuple(np.round(v * flip, 9) + 0.0) in keys for v in mesh.tets.vertices)
        cells = {tuple(np.round(c, 9) + 0.0) for c in mesh.tets.vertices[mesh.tets.tets].mean(axis=1)}
        assert all(tuple(np.round(c * flip, 9) + 0.0) in cells for c in mesh.tets.vertices[mesh.tets.tets].mean(axis=1))


@pytest.mark.parametrize(("level", "own"), [("coarse", 0.25), ("medium", 1.0)])
def test_volume_blocks_are_symmetric(level, own):
    """24 tetrahedra of one layer each; the fine level has none."""
    mesh = pad_mesh(GELPAD, level)
    blocks = mesh.volume_blocks
    assert blocks is not None and (np.bincount(blocks) == 24).all() and len(blocks) == len(mesh.tets.tets)
    corners = mesh.tets.vertices[mesh.tets.tets]
    middle = np.stack([np.bincount(blocks, corners.mean(axis=1)[:, axis]) / 24 for axis in range(3)], axis=1)
    keys = {tuple(np.round(m, 9) + 0.0) for m in middle}
    assert len(keys) == blocks.max() + 1
    for flip in ((-1, 1, 1), (1, -1, 1)):
        assert all(tuple(np.round(m * flip, 9) + 0.0) in keys for m in middle)
    assert mesh.own_volume == own and pad_mesh(GELPAD, "fine").volume_blocks is None


def test_the_coat_covers_the_face_facing_out():
    coat = pad_mesh(GELPAD, "coarse").coat
    a, b, c = (coat.rest[coat.faces[:, k], :2] for k in range(3))
    area = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    assert (area > 0).all() and area.sum() == pytest.approx(GELPAD.size[0] * GELPAD.size[1], rel=1e-12)


def test_sides_are_held_if_the_sensor_says_so():
    back, both = (pad_mesh(replace(GELPAD, bonded=what), "coarse") for what in ("back", "back_and_sides"))
    side = np.isclose(np.abs(both.tets.vertices[both.bonded, 0]), GELPAD.size[0] / 2)
    assert len(both.bonded) > len(back.bonded) and side.any() and set(back.bonded) < set(both.bonded)


def test_a_pad_that_cannot_be_is_refused():
    mesh = pad_mesh(GELPAD, "coarse")
    with pytest.raises(InputError, match=r"pad.*'finest'.*known level.*coarse, medium, fine"):
        pad_mesh(GELPAD, "finest")
    with pytest.raises(InputError, match=r"bonded.*at least one vertex"):
        PadMesh(mesh.tets, mesh.coat, mesh.coat_vertices, np.array([], int), mesh.d_hat)
    with pytest.raises(InputError, match=r"bonded.*can move"):
        PadMesh(mesh.tets, mesh.coat, mesh.coat_vertices, np.arange(len(mesh.tets.vertices)), mesh.d_hat)
    with pytest.raises(InputError, match="two cells"):
        pad_mesh(GELPAD, replace(PAD_LEVELS["coarse"], cell=1.0))


@pytest.mark.parametrize(("kind", "size"), VOLUMES)
def test_part_surfaces_are_closed_and_fill_their_volume(kind, size):
    surface = part_surface(primitive(kind, size))
    solid = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert 0.99 < solid.volume / VOLUMES[kind, size] < 1 + 1e-9  # inscribed
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    if kind != "cone":
        assert np.allclose(low, -high, atol=2e-6)


@pytest.mark.parametrize("scene", ["sphere", "cylinder", "edge", "cone", "torus", "pins", "coin", "mesh"])
def test_object_surfaces_lie_on_the_rigid_pads_undersides(scene):
    """The same source: where both are, triangles and exact shapes differ by less than facets sag (a relief by its spacing)."""
    parts = object_parts(load_press(scene).object)
    surface = object_surface(parts)
    x = np.linspace(-7.9e-3, 7.9e-3, 158)
    exact = object_height(parts, np.eye(4)[None], x, x)[0]
    facets = lowest_of_triangles(surface.vertices[surface.faces], x, x)
    both = np.isfinite(exact) & np.isfinite(facets)
    assert both.sum() > 300
    off = np.abs(exact - facets)[both]
    assert np.percentile(off, 95) < (6e-5 if scene == "coin" else 1e-5)


SHIPPED = ["sphere", "soft_ball", "cylinder", "edge", "cone", "torus", "pins", "coin", "mesh"]


@pytest.mark.parametrize("scene", SHIPPED)
def test_no_shipped_object_crosses_itself(scene):
    """By ipctk, which is none of ours: as a whole, each is one closed surface that a pad can be checked against."""
    assert set(SHIPPED) == set(available("press scene")) - {"none"}
    surface = object_surface(object_parts(load_press(scene).object))
    assert_sound(surface)


def assert_sound(surface):
    mesh = ipctk.CollisionMesh(surface.vertices, ipctk.edges(surface.faces), surface.faces)
    assert not ipctk.has_intersections(mesh, surface.vertices)
    solid = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0


@pytest.mark.parametrize("scene", ["coin", "pins"])
def test_joined_parts_keep_the_underside_of_their_parts(scene):
    """What touches a gel is what the parts' own surfaces are, put one over the other: only the walls between them are gone."""
    parts = object_parts(load_press(scene).object)
    x, y = np.linspace(-7.9e-3, 7.9e-3, 301), np.linspace(-7.4e-3, 7.3e-3, 290)
    joined = lowest_of_triangles((one := object_surface(parts)).vertices[one.faces], x, y)
    apart = np.full_like(joined, np.inf)
    for part in parts:
        surface = part_surface(part)
        placed = surface.vertices @ part.object_from_part[:3, :3].T + part.object_from_part[:3, 3]
        apart = np.minimum(apart, lowest_of_triangles(placed[surface.faces], x, y))
    assert np.array_equal(np.isfinite(joined), np.isfinite(apart)) and np.isfinite(joined).mean() > 0.5
    np.testing.assert_allclose(joined[np.isfinite(joined)], apart[np.isfinite(joined)], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("rows", "columns", "pitch", "radius"), [(1, 1, 1e-3, 0.5e-3), (2, 3, 1e-3, 0.5e-3), (5, 1, 2e-3, 0.4e-3)]
)
def test_pins_of_any_number_are_sound_also_where_they_touch(rows, columns, pitch, radius):
    params = {"rows": rows, "columns": columns, "pitch": pitch, "pin_radius": radius, "pin_height": 2e-3}
    surface = object_surface(object_parts(replace(load_press("pins").object, params=params)))
    assert_sound(surface)
    plate, pin = rows * columns * pitch**2 * 2e-3, math.pi * radius**2 * 2e-3
    volume = trimesh.Trimesh(surface.vertices, surface.faces, process=False).volume
    assert 0.99 < volume / (plate + rows * columns * pin) < 1 + 1e-9


@pytest.mark.parametrize("radius", [0.1e-3, 3e-3, 10e-3, 12.345e-3])
def test_coins_of_any_size_are_sound(radius):
    params = {"radius": radius, "thickness": 0.2 * radius, "relief_height": 0.1 * radius}
    surface = object_surface(object_parts(replace(load_press("coin").object, params=params)))
    assert_sound(surface)
    volume = trimesh.Trimesh(surface.vertices, surface.faces, process=False).volume
    assert 1.0 < volume / (math.pi * radius**2 * 0.2 * radius) < 1.5


def test_parts_that_cannot_be_joined_are_refused():
    ball = replace(primitive("sphere", (1e-3,)), joined=True)
    with pytest.raises(InputError, match=r"parts = .*box.*sphere.*: must be a disc and its relief, or a plate and its pins"):
        object_surface((primitive("box", (1e-3,) * 3), ball))


def test_the_contact_solver_refuses_a_mesh_that_crosses_itself_and_tells_of_parts_that_overlap():
    cube = trimesh.creation.box(extents=(4e-3,) * 3)
    moved = cube.copy().apply_translation([1e-3, 1.5e-3, 0.5e-3])
    vertices = np.concatenate([cube.vertices, moved.vertices])
    crossing = (mesh_part(vertices, np.concatenate([cube.faces, moved.faces + len(cube.vertices)])),)
    driven = load_press("edge").object
    for make in (
        lambda: object_body(crossing, driven, np.eye(3)[None]),
        lambda: scene_body("thing", crossing, "affine"),
        lambda: scene_body("thing", crossing, "soft"),
    ):
        with pytest.raises(
            InputError, match=r"24 triangles.*must not cross itself with physics='ipc': \d+ pairs .* near \(.*\) mm"
        ):
            make()
    boxes = (primitive("box", (2e-3,) * 3), primitive("box", (1e-3, 1e-3, 3e-3)))
    with pytest.warns(UserWarning, match=r"the parts of 'thing' overlap: \d+ pairs of triangles"):
        scene_body("thing", boxes, "kinematic")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scene in ("coin", "pins", "mesh"):
            scene_body(scene, object_parts(load_press(scene).object), "kinematic")


def test_a_relief_is_closed():
    coin = object_parts(load_press("coin").object)
    surface = part_surface(coin[1])
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    assert trimesh.Trimesh(surface.vertices, surface.faces, process=False).volume > 0


def test_surfaces_that_cannot_be_are_refused():
    with pytest.raises(InputError, match=r"plane.*no closed surface"):
        part_surface(primitive("plane"))
    with pytest.raises(InputError, match="without parts"):
        object_surface(())
    tetra = mesh_part(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 1e-3, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    )
    assert len(part_surface(tetra).faces) == 4
