"""Visual meshes of the Panda: they fit its links, and pictures show them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from raytac.physics.geoms import geom_part
from raytac.robots import looks
from raytac.robots.panda import READY, one_sensor_panda, two_finger_panda
from raytac.shapes.triangulate import part_surface
from raytac.view.world_session import WorldSession
from raytac.world.world import TactileWorld
from tests.opengl import run_drawing
from tests.robots.conftest import HIGH, LOW

NAMES = (*(f"link{i}" for i in range(8)), "hand/hand")


@pytest.fixture(params=sorted(looks.SOURCES))
def meshes(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    """Vertices of each link in its own frame [m], of a package that is installed."""
    if importlib.util.find_spec(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    found: dict[str, list[np.ndarray]] = {}
    for mesh in looks.SOURCES[request.param]():
        found.setdefault(mesh.body, []).append(mesh.surface()[0])
    assert tuple(found) == NAMES
    return {name: np.concatenate(vertices) for name, vertices in found.items()}


def shapes(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Points of the surfaces of a body's own shapes that collide, in its frame [m]."""
    points = []
    for geom in np.flatnonzero((model.geom_bodyid == model.body(body).id) & (model.geom_contype > 0)):
        part = geom_part(model, int(geom))
        pose = part.object_from_part
        points.append(part_surface(part, 1e-3).vertices @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate(points)


def test_meshes_cover_the_shapes_of_their_link(meshes: dict[str, np.ndarray]):
    """A capsule of the source reaches into the neighbouring links, whose meshes count too."""
    model = two_finger_panda().spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = READY
    mujoco.mj_kinematics(model, data)
    for k, name in enumerate(NAMES):
        own, body = shapes(model, name), data.body(name)
        placed = own @ body.xmat.reshape(3, 3).T + body.xpos
        covered = np.zeros(len(own), bool)
        for other in NAMES[max(0, k - 1) : k + 2]:
            frame, vertices = data.body(other), meshes[other]
            local = (placed - frame.xpos) @ frame.xmat.reshape(3, 3)
            inside = ((local > vertices.min(axis=0) - 0.012) & (local < vertices.max(axis=0) + 0.012)).all(axis=1)
            assert other != name or inside.mean() >= 0.5, f"{name}: its mesh covers {inside.mean():.2f}"
            covered |= inside
        assert covered.mean() > 0.92, f"{name}: it and its neighbours cover {covered.mean():.2f}"


def test_shells_of_neighbouring_links_meet_at_the_joints_and_never_touch(meshes: dict[str, np.ndarray]):
    """Shells end 1 mm from each other: a frame that is off would open the gap or close it."""
    model = two_finger_panda().spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for joints in (np.zeros(7), np.array(READY), *rng.uniform(LOW, HIGH, (4, 7))):
        data.qpos[:7] = joints
        mujoco.mj_kinematics(model, data)
        placed = [meshes[name] @ data.body(name).xmat.reshape(3, 3).T + data.body(name).xpos for name in NAMES[:8]]
        for i in range(1, 8):
            gap = KDTree(placed[i - 1]).query(placed[i])[0].min()
            assert 0.5e-3 < gap < 1.5e-3, f"joint {i}: {1e3 * gap:.2f} mm"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Package in the place of gymnasium-robotics, with a box for every link."""
    folder = tmp_path / "gymnasium_robotics" / "envs/assets/kitchen_franka/franka_assets/meshes/visual"
    folder.mkdir(parents=True)
    (tmp_path / "gymnasium_robotics" / "__init__.py").touch()  # before one that is installed
    for name in NAMES:
        half = 0.2 if name == "link7" else 0.005
        trimesh.creation.box(extents=(2 * half, 0.05, 0.05)).export(folder / f"{name.removeprefix('hand/')}.stl")
    monkeypatch.setattr(looks, "SOURCES", {"gymnasium_robotics": looks.SOURCES["gymnasium_robotics"]})
    monkeypatch.syspath_prepend(str(tmp_path))
    looks.panda_meshes.cache_clear()
    yield tmp_path
    looks.panda_meshes.cache_clear()


def test_every_shape_of_the_panda_is_replaced_and_nothing_else(package: Path):
    spec = two_finger_panda().spec
    for number, name in enumerate(("tool", "")):  # a user's geom need not have a name
        spec.body("link7").add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.01 + 0.001 * number, 0, 0), mass=0.0)
    arms = mujoco.MjSpec()
    arms.option.integrator = spec.option.integrator
    arms.attach(spec, prefix="near/", frame=arms.worldbody.add_frame())
    arms.attach(one_sensor_panda().spec, prefix="far/", frame=arms.worldbody.add_frame(pos=(0, 1, 0)))
    model = arms.compile()
    seen = looks.robot_looks(model)
    bodies = {f"near/{name}" for name in NAMES} | {f"far/{name}" for name in NAMES[:8]}
    assert {model.body(body).name for body, _ in seen.meshes} == bodies
    assert len(seen.meshes) == len(bodies)
    own = {geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name in bodies}
    users = {geom for geom in own if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE}
    assert len(users) == 2 and set(seen.hidden) == own - users


def test_another_robot_keeps_its_shapes(package: Path):
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body name="link7"><geom size="0.1"/></body></worldbody></mujoco>')
    assert looks.robot_looks(model) == looks.Looks()


def test_without_a_package_one_line_says_how_to_get_the_meshes(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    model = one_sensor_panda().spec.compile()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    looks.panda_meshes.cache_clear()
    with caplog.at_level("INFO", logger="raytac"):
        assert looks.robot_looks(model) == looks.robot_looks(model) == looks.Looks()
    looks.panda_meshes.cache_clear()
    (line,) = (record.message for record in caplog.records)
    assert "raytac[films]" in line and "robosuite==1.5.2" in line


def robosuite(folder: Path, *, links: Sequence[str] = NAMES[:8], meshdir: str = "", contype: int = 0) -> Path:
    """Package in the place of robosuite, version 9.8.7, with a box for every link; its robot.xml."""
    root = folder / "robosuite"
    robot, hand = root / "models/assets/robots/panda", root / "models/assets/grippers/meshes/panda_gripper"
    (robot / meshdir).mkdir(parents=True)
    hand.mkdir(parents=True)
    (root / "__init__.py").touch()
    (folder / "robosuite-9.8.7.dist-info").mkdir()
    (folder / "robosuite-9.8.7.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: robosuite\nVersion: 9.8.7\n")
    box = trimesh.creation.box(extents=(0.05, 0.05, 0.05))
    box.export(hand / "hand_vis.stl")
    for name in links:
        box.export(robot / meshdir / f"{name}.stl")
    assets = "".join(f'<mesh name="{name}_vis" file="{name}.stl"/>' for name in links)
    shape = f'type="mesh" contype="{contype}" conaffinity="0" rgba="0.1 0.2 0.3 1"'
    bodies = "".join(f'<body name="{name}"><geom {shape} mesh="{name}_vis"/></body>' for name in links)
    (robot / "robot.xml").write_text(
        f'<mujoco><compiler meshdir="{meshdir}"/><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>'
    )
    importlib.invalidate_caches()
    return robot / "robot.xml"


@pytest.fixture
def preferred(package: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of packages, where robosuite is asked before the stand-in of gymnasium-robotics."""
    monkeypatch.setattr(looks, "SOURCES", {"robosuite": looks._of_robosuite, **looks.SOURCES})
    return package


def test_meshes_lie_in_the_folder_that_the_compiler_names(preferred: Path, caplog: pytest.LogCaptureFixture):
    robot = robosuite(preferred, meshdir="shells")
    meshes = looks.panda_meshes()
    assert not caplog.records and [mesh.body for mesh in meshes] == list(NAMES)
    assert {mesh.file.parent for mesh in meshes[:8]} == {robot.parent / "shells"}
    np.testing.assert_allclose([mesh.rgba for mesh in meshes[:8]], np.tile((0.1, 0.2, 0.3, 1.0), (8, 1)), atol=1e-6)
    np.testing.assert_allclose(meshes[3].surface()[0].max(axis=0), 0.025, atol=1e-6)


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        ("no body", "no body link7"),
        ("no visual mesh", "no mesh of link0, link1"),
        ("no robot.xml", "robot.xml"),
        ("bad robot.xml", "XML"),
        ("no mesh file", "link3.stl"),
        ("bad mesh file", "link3"),
    ],
)
def test_a_package_that_cannot_be_read_is_named_and_passed_over(
    preferred: Path, caplog: pytest.LogCaptureFixture, harm: str, reason: str
):
    robot = robosuite(preferred, links=NAMES[: 7 if harm == "no body" else 8], contype=int(harm == "no visual mesh"))
    target = robot if "robot.xml" in harm else robot.parent / "link3.stl"
    if harm.endswith((".xml", "file")):
        target.write_text("<mujoco><nothing") if harm.startswith("bad") else target.unlink()
    assert {mesh.file.parents[6].name for mesh in looks.panda_meshes()} == {"gymnasium_robotics"}
    (line,) = (record.message for record in caplog.records)
    assert "robosuite 9.8.7" in line and reason in line, line


def test_the_viewer_shows_the_meshes_on_their_bodies(package: Path):
    world = TactileWorld("ball_rolling", outputs=("wrench",))
    view = WorldSession(world)
    seen, shot = looks.robot_looks(world.model), view.snapshot()
    drawn = {solid.name: solid for solid in view.solids}
    assert len(seen.meshes) == 8 and not {name.partition("/")[2] for name in drawn} & set(map(str, seen.hidden))
    for number, (body, _) in enumerate(seen.meshes):
        name = f"link{number}/looks{number}"
        half = (0.2 if number == 7 else 0.005, 0.025, 0.025)
        np.testing.assert_allclose(drawn[name].vertices.max(axis=0), half, atol=1e-6)
        assert len(drawn[name].vertices) == 8
        np.testing.assert_allclose(shot.poses[name][:3, 3], world.data[0].xpos[body])
        np.testing.assert_allclose(shot.poses[name][:3, :3], world.data[0].xmat[body].reshape(3, 3))


_SCRIPT = """
import sys
sys.path.insert(0, {package!r})
from raytac.robots import looks
looks.SOURCES.pop("robosuite")
from raytac.world import SceneCamera, TactileWorld

def drawn(world):
    body = world.data[0].body("link7")
    turn = np.degrees(np.arctan2(body.xmat[3], body.xmat[0]))  # of the box's long axis, which lies flat
    camera = SceneCamera(world, resolution=(200, 150), distance=1.0, azimuth=turn + 90.0, elevation=0.0, lookat=body.xpos)
    picture = camera.draw().astype(int)
    camera.close()
    return picture, np.isclose(abs(body.xmat[6]), 0.0, atol=1e-3)

world = TactileWorld("ball_rolling", outputs=("wrench",))
colours = world.model.geom_rgba.copy()
meshes, is_flat = drawn(world)
assert is_flat and (world.model.geom_rgba == colours).all() and world.model.nmesh == 0
looks.panda_meshes.cache_clear()
looks.SOURCES.clear()
shapes, _ = drawn(world)
focal = 75.0 / np.tan(np.radians(0.5 * world.model.vis.global_.fovy))
def white(picture, x, z):  # at a place in the plane through the frame of link7 [m]
    r, g, b = picture[round(75 - focal * z), round(100 + focal * x)]
    return abs(r - b) < 14 and r > 120 and (r, g, b) != (238, 241, 245)
for x in (-0.17, -0.1, 0.1, 0.17):  # the box, 0.4 m long and 0.05 m high
    assert white(meshes, x, 0.0), ("box", x, meshes[75, round(100 + focal * x)])
for x in (-0.17, 0.17):
    assert not white(shapes, x, 0.0), ("no box", x, shapes[75, round(100 + focal * x)])
assert white(shapes, 0.0, 0.075) and not white(meshes, 0.0, 0.075), "the capsules are there, or not"
"""


def test_a_picture_shows_the_meshes_where_the_links_are(package: Path):
    run_drawing(_SCRIPT.format(package=str(package)))


_DISCARDING = """
import logging, sys
sys.path.insert(0, {package!r})
from raytac.robots import looks, one_sensor_panda
looks.SOURCES.pop("robosuite")
from raytac.world import SceneCamera, TactileWorld

robot, lines = one_sensor_panda(), []
spec, handler = robot.spec, logging.Handler()
handler.emit = lambda record: lines.append(record.getMessage())
logging.getLogger("raytac").addHandler(handler)
corners = [x for k in range(8) for x in (0.02 * (k & 1), 0.02 * (k >> 1 & 1), 0.02 * (k >> 2))]
for name in ("wedge", "unused"):
    spec.add_mesh(name=name, uservert=corners)
post = spec.worldbody.add_body(name="post", pos=(0.6, 0.3, 0.1))
post.add_freejoint()
post.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wedge", mass=0.1)
geom = mujoco.mjtObj.mjOBJ_GEOM
gel, case, kind = robot.sensors[0].gel, robot.sensors[0].case, mujoco.mjtSensor.mjSENS_GEOMDIST
spec.add_sensor(type=kind, objtype=geom, objname=gel, reftype=geom, refname=case, cutoff=1.0)  # a gel that is named is kept
spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
discarding = spec.copy()
discarding.compiler.discardvisual = True

def drawn(spec):
    camera = SceneCamera(TactileWorld(spec, sensors=robot.sensors, touches=["post"], outputs=("wrench",)), resolution=(200, 150))
    picture = camera.draw()
    camera.close()
    return picture

meshes = drawn(spec)
assert not lines, lines
with_package = drawn(discarding)
assert len(lines) == 1 and "discardvisual" in lines[0], lines
looks.panda_meshes.cache_clear()
looks.SOURCES.clear()
shapes = drawn(discarding)
def differ(a, b):  # share of pixels; a renderer's threads change single ones at the edge of a shadow
    return (np.abs(a.astype(int) - b).max(axis=2) > 8).mean()
assert differ(with_package, shapes) < 0.01 and differ(meshes, shapes) > 0.05, (differ(with_package, shapes), differ(meshes, shapes))
"""


def test_a_model_that_discards_visual_meshes_is_drawn_by_its_shapes(package: Path):
    run_drawing(_DISCARDING.format(package=str(package)))
