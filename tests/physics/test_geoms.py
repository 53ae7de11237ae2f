"""Geoms of a MuJoCo model as parts: every type against a closed form or against the mesh of the same shape."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from raytac.errors import InputError, SpecError
from raytac.physics.geoms import GEOM_TYPES, body_parts, geom_part, load_mjcf
from raytac.physics.rigid.pad import RigidPad
from raytac.shapes.part import Part, hfield_part, mesh_part, primitive
from raytac.shapes.underside import object_height
from raytac.specs import load_press
from tests.conftest import make_sensor_spec

X = np.linspace(-6e-3, 6e-3, 61)
Y = np.linspace(-5e-3, 5e-3, 49)
QUATERNION = (0.9, 0.3, -0.2, 0.1)
POSITION = (0.7e-3, -0.4e-3, 1.1e-3)
BODY = "thing"
PRIMITIVES = {
    "sphere": (3e-3,),
    "capsule": (1.5e-3, 2.5e-3),
    "ellipsoid": (4e-3, 2e-3, 1e-3),
    "cylinder": (2.5e-3, 1.5e-3),
    "box": (3e-3, 2e-3, 1e-3),
}


def pose_of(position: tuple[float, ...], quaternion: tuple[float, ...]) -> np.ndarray:
    """The pose of a geom by trimesh's formulas, not MuJoCo's."""
    pose = trimesh.transformations.quaternion_matrix(np.array(quaternion) / np.linalg.norm(quaternion))
    pose[:3, 3] = position
    return pose


def body_with(**geom: object) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """A model whose body BODY, itself moved and turned in the world, has one geom at POSITION, turned by QUATERNION."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name=BODY, pos=(0.3, -0.2, 0.5), quat=(0.5, 0.5, -0.5, 0.5))
    body.add_geom(name="geom", pos=POSITION, quat=QUATERNION, **geom)
    return spec, spec.compile()


def mesh_model(kind: str, vertices: np.ndarray, faces: np.ndarray) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.add_mesh(name="shape", uservert=np.asarray(vertices).ravel(), userface=np.asarray(faces).ravel())
    body = spec.worldbody.add_body(name=BODY)
    type_ = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    body.add_geom(type=type_, meshname="shape", pos=POSITION, quat=QUATERNION)
    return spec.compile()


def heights(*parts: Part, lift: float = 2e-3) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = lift
    return object_height(parts, pose[None], X, Y)[0]


def assert_same(found: np.ndarray, expected: np.ndarray, atol: float) -> None:
    both = np.isfinite(found) & np.isfinite(expected)
    assert both.sum() > 50
    assert np.mean(np.isfinite(found) != np.isfinite(expected)) < 0.005  # only at a silhouette
    np.testing.assert_allclose(found[both], expected[both], rtol=0.0, atol=atol)


@pytest.mark.parametrize("kind", sorted(PRIMITIVES))
def test_primitives_are_exact_and_in_the_frame_of_the_body(kind: str) -> None:
    size = (*PRIMITIVES[kind], 0.0, 0.0)[:3]
    _, model = body_with(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size)
    (part,) = body_parts(model, BODY)
    assert part.kind == kind and part.size == PRIMITIVES[kind]
    expected = primitive(kind, PRIMITIVES[kind], pose_of(POSITION, QUATERNION))
    np.testing.assert_allclose(part.object_from_part, expected.object_from_part, atol=1e-12)
    assert_same(heights(part), heights(expected), 1e-12)


@pytest.mark.parametrize("kind", sorted(PRIMITIVES))
def test_primitives_agree_with_the_mesh_of_the_same_shape(kind: str) -> None:
    size = PRIMITIVES[kind]
    shape = {
        "sphere": lambda: trimesh.creation.icosphere(5, size[0]),
        "capsule": lambda: trimesh.creation.capsule(2e3 * size[1], 1e3 * size[0], count=[96, 96]).apply_scale(1e-3),
        "ellipsoid": lambda: trimesh.creation.icosphere(5, 1.0).apply_scale(size),
        "cylinder": lambda: trimesh.creation.cylinder(size[0], 2 * size[1], sections=256),
        "box": lambda: trimesh.creation.box(2 * np.array(size)),
    }[kind]()
    _, model = body_with(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=(*size, 0.0, 0.0)[:3])
    exact = heights(geom_part(model, "geom"))
    facets = heights(*body_parts(mesh_model("mesh", shape.vertices, shape.faces), BODY))
    both = np.isfinite(exact) & np.isfinite(facets)
    assert both.sum() > 200
    difference = np.abs(facets[both] - exact[both])
    assert np.mean(difference) < 5e-6 and np.median(difference) < 3e-6
    assert np.mean(np.isfinite(exact) != np.isfinite(facets)) < 0.02


@pytest.mark.parametrize("kind", ["mesh", "sdf"])
def test_a_concave_mesh_keeps_its_triangles(kind: str) -> None:
    """MuJoCo centres and turns a mesh when it compiles it, which the geom's pose undoes; its hull would have no hole."""
    torus = trimesh.creation.torus(3e-3, 1e-3, major_sections=48, minor_sections=24)
    torus.apply_transform(pose_of((1e-3, 0.5e-3, -2e-3), (1.0, 0.4, 0.2, -0.3)))
    (part,) = body_parts(mesh_model(kind, torus.vertices, torus.faces), BODY)
    expected = mesh_part(torus.vertices, torus.faces, pose_of(POSITION, QUATERNION))
    assert part.kind == "mesh" and part.closed
    assert_same(heights(part), heights(expected), 2e-8)  # MuJoCo keeps vertices in float32


def test_an_sdf_plugin_is_sensed_by_its_mesh() -> None:
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><extension><plugin plugin="mujoco.sdf.torus"><instance name="ring">
      <config key="radius1" value="0.35"/><config key="radius2" value="0.15"/></instance></plugin></extension>
    <asset><mesh name="ring"><plugin instance="ring"/></mesh></asset>
    <worldbody><body name="thing"><geom type="sdf" mesh="ring"><plugin instance="ring"/></geom></body></worldbody></mujoco>""")
    (part,) = body_parts(model, BODY)
    x = np.linspace(-0.5, 0.5, 101)
    found = object_height([part], np.eye(4)[None], x, x)[0]
    rho = np.hypot(x[None, :], x[:, None])
    inner = np.abs(rho - 0.35) < 0.12
    exact = -np.sqrt(0.15**2 - (rho[inner] - 0.35) ** 2)
    np.testing.assert_allclose(found[inner], exact, atol=3e-4)
    assert np.isinf(found[rho < 0.19]).all()  # the hole is open


def test_a_plane_is_the_whole_half_space() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(
        name="ceiling", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1e-4, 1e-4, 1e-4), pos=(0, 0, 1e-3), quat=(0, 1, 0, 0)
    )
    np.testing.assert_allclose(heights(*body_parts(spec.compile(), "world")), 3e-3, atol=1e-12)


def test_a_height_field_has_its_rows_along_y() -> None:
    rows, columns, size = 5, 9, (4e-3, 3e-3, 1e-3, 0.5e-3)
    y, x = np.mgrid[0:1:5j, 0:1:9j]
    data = (x + 2.0 * y**2) / 3.0  # from 0 to 1, so that MuJoCo's normalising leaves it
    spec = mujoco.MjSpec()
    spec.add_hfield(name="ground", nrow=rows, ncol=columns, size=size, userdata=data.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", quat=(0, 1, 0, 0))
    found = heights(*body_parts(spec.compile(), 0))
    assert_same(found, heights(hfield_part(size, data, np.diag([1.0, -1.0, -1.0, 1.0]))), 1e-9)
    # The closed form at its own nodes, turned over: y and z change sign.
    pose = np.eye(4)[None]
    nodes = object_height(
        body_parts(spec.compile(), 0), pose, np.linspace(-size[0], size[0], columns), np.linspace(-size[1], size[1], rows)
    )[0]
    np.testing.assert_allclose(nodes[1:-1, 1:-1], -size[2] * data[::-1][1:-1, 1:-1], atol=1e-9)


def test_every_type_of_geom_is_covered() -> None:
    named = {g.name.removeprefix("mjGEOM_").lower() for g in map(mujoco.mjtGeom, range(int(mujoco.mjtGeom.mjGEOM_SDF) + 1))}
    assert named == set(GEOM_TYPES)


def test_groups_choose_among_the_geoms_of_a_body() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name=BODY)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(1e-3,) * 3, group=3)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(1e-3, 0, 0), group=0)
    model = spec.compile()
    assert [p.kind for p in body_parts(model, BODY)] == ["box", "sphere"]
    assert [p.kind for p in body_parts(model, BODY, groups=(3,))] == ["box"]
    with pytest.raises(InputError, match=r"body = 'thing': has no geom in the groups \(1,\).*choose from: 0, 3"):
        body_parts(model, BODY, groups=(1,))
    with pytest.raises(InputError, match=r"body = 'world': has no geom"):
        body_parts(model, "world")
    with pytest.raises(InputError, match=r"body = 'thin': is not in the model; did you mean 'thing'.*world, thing"):
        body_parts(model, "thin")
    with pytest.raises(InputError, match=r"geom = 2: must be a name, or a number in \[0, 1\]"):
        geom_part(model, 2)


def test_a_type_without_surface_names_the_choices() -> None:
    _, model = body_with(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(1e-3, 0, 0))
    model.geom_type[0] = mujoco.mjtGeom.mjGEOM_ARROW
    with pytest.raises(InputError, match=r"type of geom 'geom' = 'arrow': cannot be sensed.*plane, hfield, sphere.*sdf"):
        geom_part(model, "geom")


MJCF = """
<mujoco><worldbody><body name="peg" pos="1 2 3">
  <geom type="cylinder" size="0.003 0.005" euler="0 90 0"/>
  <geom type="sphere" size="0.002" pos="0.006 0 0"/>
</body></worldbody></mujoco>"""
SCENE = """
[object]
kind = "mjcf"
path = "peg.xml"
body = "{body}"
[[trajectory]]
kind = "indent"
depth_mm = 0.5
"""


def test_a_scene_presses_a_body_of_a_model(tmp_path: Path) -> None:
    (tmp_path / "peg.xml").write_text(MJCF)
    (tmp_path / "peg.toml").write_text(SCENE.format(body="peg"))
    pad = RigidPad(make_sensor_spec(), load_press(tmp_path / "peg.toml"), pitch=0.15e-3)
    assert [p.kind for p in pad.parts] == ["cylinder", "sphere"]
    state = pad.peak(pad.run())
    surface = state.surface
    assert surface.contact.any() and surface.indentation.max() == pytest.approx(0.5e-3, rel=0.02)
    assert state.normal_force[0] > 0.0
    cylinder = primitive("cylinder", (3e-3, 5e-3), pose_of((0, 0, 0), (math.sqrt(0.5), 0, math.sqrt(0.5), 0)))
    ball = primitive("sphere", (2e-3,), pose_of((6e-3, 0, 0), (1, 0, 0, 0)))
    assert_same(heights(*pad.parts), heights(cylinder, ball), 1e-12)


def test_a_scene_whose_model_cannot_be_had_names_file_and_key(tmp_path: Path) -> None:
    scene = tmp_path / "peg.toml"
    scene.write_text(SCENE.format(body="pig"))
    with pytest.raises(SpecError, match=r"peg\.toml: object\.path = 'peg\.xml': the model file does not exist"):
        load_press(scene)
    (tmp_path / "peg.xml").write_text(MJCF)
    with pytest.raises(SpecError, match=r"peg\.toml: object\.body = 'pig': is not in the model; did you mean 'peg'"):
        RigidPad(make_sensor_spec(), load_press(scene), pitch=0.5e-3)
    (tmp_path / "peg.xml").write_text("<mujoco><nonsense/></mujoco>")
    with pytest.raises(SpecError, match=r"peg\.toml: object\.path = .*MuJoCo refuses it: .*nonsense"):
        RigidPad(make_sensor_spec(), load_press(scene), pitch=0.5e-3)
    with pytest.raises(InputError, match="must exist"):
        load_mjcf(tmp_path / "none.xml")
