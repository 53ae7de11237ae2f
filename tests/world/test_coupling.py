"""Two-way coupling: stable for light links on stiff contacts, passive, without a part in what is settled in."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError
from raytac.physics.soft.bodies import scene_body
from raytac.shapes.part import primitive
from raytac.world.c_coupling import CCoupling
from tests.world.coupled import Contact, Coupled, pose, set_interval

G = 9.81
SLIDER = """<mujoco><option timestep="{h}" gravity="0 0 {g}" integrator="implicitfast"/><worldbody><body name="finger" pos="0 0 {z}"
euler="180 0 0"><joint name="z" type="slide" axis="0 0 1"/><geom type="box" size=".01 .01 .01" pos="0 0 -.012" mass="{m}" contype="0"
conaffinity="0"/></body></worldbody><actuator>{drive}</actuator></mujoco>"""
BLOCK = [scene_body("block", (primitive("box", (15e-3,) * 3),), "kinematic")]
TOP = {"block": pose(position=(0.0, 0.0, -15e-3))}


def on_a_spring(mass, k, factor, *, h=1e-3, interval=1e-2, height=-1e-5, seconds=1.0):
    """A mass on a one-sided spring that answers once an interval: energies and places at every exchange."""
    xml = SLIDER.format(h=h, g=-G, z=0.0, m=mass, drive="")
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[0] = -height
    mujoco.mj_forward(model, data)
    coupling, energy, places = CCoupling([model], [data], [1], contacts=1), [], []
    for _ in range(round(seconds / interval)):
        x = -float(data.qpos[0])
        w = np.zeros((1, 6))
        w[0, 2] = k * max(-x, 0.0)
        bound = np.zeros((6, 6))
        bound[2, 2] = factor * k
        push = np.array([0.0, 0.0, w[0, 2]])
        contacts = [Contact(0, bound, data.xpos[1].copy(), normal=push)] if x < 0.0 and factor else []
        set_interval(coupling, w, contacts)
        energy.append(0.5 * mass * data.qvel[0] ** 2 + mass * G * x + 0.5 * k * max(-x, 0.0) ** 2)
        places.append(x)
        for _ in range(round(interval / h)):
            mujoco.mj_step1(model, data)
            coupling.apply([0])
            mujoco.mj_step2(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
    return np.array(energy), np.array(places)


@pytest.mark.parametrize(("mass", "k"), [(0.04, 5e4), (0.04, 1e3), (0.5, 1e4)])
def test_no_energy_comes_from_a_bound_that_holds(mass, k):
    """k T² / m from 2.5 to 125: the held force throws the mass away, half the stiffness is too little, all of it is passive."""
    scale = mass * G * mass * G / k
    for factor in (1.0, 3.0, 20.0):
        energy, places = on_a_spring(mass, k, factor)
        assert np.diff(energy).max() < 1e-9 * scale
        assert places[-1] == pytest.approx(-mass * G / k, rel=0.05)
    for factor in (0.0, 0.3):
        energy, places = on_a_spring(mass, k, factor)
        assert np.diff(energy).max() > scale or np.abs(places).max() > 10.0 * mass * G / k


def test_a_dropped_mass_gains_no_more_than_the_first_touch_allows():
    mass, k, h, height = 0.04, 5e4, 1e-3, 2e-3
    energy, places = on_a_spring(mass, k, 2.0, height=height, interval=h, h=h, seconds=0.5)
    speed = np.sqrt(2.0 * G * height)
    touched = int(np.argmax(places < 0.0))
    assert energy.max() <= energy[0] + 0.5 * k * (speed * h) ** 2
    assert np.diff(energy[touched:]).max() < 1e-9 and places[-1] == pytest.approx(-mass * G / k, rel=0.01)


def test_a_stand_in_comes_along_as_the_true_body_would():
    """A slider pulls a body of the solver's through a stiff contact: both accelerate as one, and the slider feels its inertia."""
    model = mujoco.MjModel.from_xml_string(SLIDER.format(h=1e-3, g=0.0, z=0.0, m=0.1, drive='<motor joint="z"/>'))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    coupling = CCoupling([model], [data], [1], contacts=1, solver_bodies=1)
    partner = {"mass": 0.3, "inertia": 1e-5 * np.eye(3)}
    set_interval(coupling, np.zeros((1, 6)), [Contact(0, np.diag([1e5] * 3 + [10.0] * 3), np.zeros(3), -2)], [partner])
    for _ in range(100):
        mujoco.mj_step1(model, data)
        data.ctrl[0] = 0.4
        coupling.apply([0])
        mujoco.mj_step2(model, data)
    assert data.qvel[0] == pytest.approx(0.4 / 0.4 * 0.1, rel=1e-3)


def test_a_contact_opens_instead_of_pulling():
    model = mujoco.MjModel.from_xml_string(SLIDER.format(h=1e-3, g=0.0, z=0.0, m=0.1, drive=""))
    data = mujoco.MjData(model)
    data.qvel[0] = -1.0  # upwards: the joint's axis is the pad's, which looks down
    mujoco.mj_forward(model, data)
    before = data.qvel[0]
    coupling = CCoupling([model], [data], [1], contacts=1)
    w = np.array([[0.0, 0.0, 2.0, 0.0, 0.0, 0.0]])
    set_interval(coupling, w, [Contact(0, np.diag([1e5] * 3 + [0.0] * 3), np.zeros(3), normal=w[0, :3])])
    for _ in range(10):
        mujoco.mj_step1(model, data)
        coupling.apply([0])
        mujoco.mj_step2(model, data)
    assert abs(data.qvel[0] - before) < 1e-9 and np.abs(data.xfrc_applied[1]).max() < 1e-12


def test_an_open_contact_takes_its_friction_and_torque_with_it():
    """Of two contacts one opens: what is left of w₀ is what the other one bears."""
    model = mujoco.MjModel.from_xml_string(SLIDER.format(h=1e-3, g=0.0, z=0.0, m=0.1, drive=""))
    data = mujoco.MjData(model)
    data.qvel[0] = -1.0  # upwards
    mujoco.mj_forward(model, data)
    coupling = CCoupling([model], [data], [1], contacts=2)
    at, origin = np.array([2e-3, 0.0, 0.0]), data.xpos[1]
    opening, staying = np.array([0.4, -0.3, 2.0, 1e-3, 0.0, 2e-3]), np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    about_origin = np.append(opening[:3], opening[3:] + np.cross(at - origin, opening[:3]))
    weak = np.diag([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0])  # so soft that it does not open
    contacts = [
        Contact(0, np.diag([1e5] * 3 + [0.0] * 3), at, normal=opening[:3], wrench=opening),
        Contact(0, weak, origin.copy(), normal=staying[:3], wrench=staying),
    ]
    set_interval(coupling, (about_origin + staying)[None], contacts)
    mujoco.mj_step1(model, data)
    coupling.apply([0])
    left = data.xfrc_applied[1].copy()  # about the centre of mass
    left[3:] += np.cross(data.xipos[1] - data.xpos[1], left[:3])
    np.testing.assert_allclose(left, staying, atol=1e-4)


@pytest.mark.solver
def test_a_light_finger_presses_a_flat_face_with_its_force():
    """40 g on 5e4 N/m and more, exchanged every 10 ms: with the law it settles at its force, without it is thrown about."""
    forces = {}
    for law in (True, False):
        rig = Coupled(
            SLIDER.format(h=1e-3, g=0.0, z=0.15e-3, m=0.04, drive='<motor joint="z"/>'), ["finger"], BLOCK, TOP, law=law
        )
        forces[law] = []
        for _ in range(20 if law else 8):
            rig.run(0.01, lambda d: d.ctrl.fill(2.0))
            forces[law].append(rig.wrench[0, 2])
        if law:
            bond = rig.scene.bond_wrench("finger")[0]
            assert bond[2] == pytest.approx(rig.wrench[0, 2], rel=0.01)  # what the link feels is what the pad does to it
    assert forces[True][-1] == pytest.approx(2.0, rel=0.02)
    assert np.abs(np.array(forces[False][2:]) - 2.0).max() > 1.5


@pytest.mark.solver
def test_a_pad_dropped_on_a_face_loses_energy():
    rig = Coupled(SLIDER.format(h=1e-3, g=-G, z=0.6e-3, m=0.1, drive=""), ["finger"], BLOCK, TOP)
    rig.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    energy = np.array(rig.run(0.12))
    touched = int(np.argmax(np.diff(energy) > 1e-9)) + 1
    assert np.diff(energy[touched:]).max() < 1e-8  # 0.1 % of what it fell with
    assert rig.wrench[0, 2] == pytest.approx(0.1 * G, rel=0.1)


FINGERS = """<mujoco><option timestep=".001" gravity="0 0 0" integrator="implicitfast"/><worldbody>
<body name="left" pos="0 -{off} 0" quat=".70710678 -.70710678 0 0"><joint name="l" type="slide" axis="0 0 1"/><geom type="box"
 size=".01 .01 .01" pos="0 0 -.012" mass=".04" contype="0" conaffinity="0"/></body>
<body name="right" pos="0 {off} 0" quat="0 0 .70710678 -.70710678"><joint name="r" type="slide" axis="0 0 1"/><geom type="box"
 size=".01 .01 .01" pos="0 0 -.012" mass=".04" contype="0" conaffinity="0"/></body>
{cube}</worldbody><actuator><motor joint="l"/><motor joint="r"/></actuator></mujoco>"""
CUBE = '<body name="cube"><freejoint/><geom type="box" size=".005 .005 .005" mass=".01" contype="0" conaffinity="0"/></body>'


def squeezed(owner):
    """Two fingers of 40 g press a cube of 10 g, their forces unequal for a moment, then equal."""
    kind = "affine" if owner == "ipc" else "kinematic"
    cube = scene_body("cube", (primitive("box", (5e-3,) * 3),), kind, density=1e4)
    led = [] if owner == "ipc" else ["cube"]
    rig = Coupled(
        FINGERS.format(off=5.1e-3, cube="" if owner == "ipc" else CUBE), ["left", "right"], [cube], {"cube": np.eye(4)}, led=led
    )
    rig.run(0.25, lambda d: d.ctrl.fill(1.5))
    return rig


@pytest.mark.solver
def test_the_same_press_whoever_owns_the_object():
    by_ipc, by_mujoco = squeezed("ipc"), squeezed("mujoco")
    for rig in (by_ipc, by_mujoco):
        left, right = rig.wrench[0], rig.wrench[1]
        assert left[1] == pytest.approx(-1.5, rel=0.01) and right[1] == pytest.approx(1.5, rel=0.01)
    assert by_mujoco.wrench[:3, :3].sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)  # action is reaction
    widths = [rig.data.qpos[0] + rig.data.qpos[1] for rig in (by_ipc, by_mujoco)]
    assert widths[0] == pytest.approx(widths[1], abs=2e-6)
    assert np.linalg.norm(by_ipc.scene.pose("cube")[0, :3, 3]) < 1e-4


@pytest.mark.solver
def test_a_stiff_arm_hardly_feels_its_pad():
    """Two-way and one-way agree as the drive's stiffness grows: both press as deep, and as hard."""
    found = {}
    for stiffness in (5e5, 5e6):
        for two_way in (True, False):
            drive = f'<position joint="z" kp="{stiffness}" kv="{2.0 * (stiffness * 0.5) ** 0.5}"/>'
            xml = SLIDER.format(h=1e-3, g=0.0, z=0.1e-3, m=0.5, drive=drive)
            rig = Coupled(xml, ["finger"], BLOCK, TOP, two_way=two_way)
            for k in range(20):
                rig.run(0.01, lambda d, k=k: d.ctrl.fill(0.2e-3 * min((k + 1) / 10, 1.0)))
            found[stiffness, two_way] = rig.wrench[0, 2]
    off = [abs(found[s, True] / found[s, False] - 1.0) for s in (5e5, 5e6)]
    assert off[1] < 0.03 and off[1] < 0.3 * off[0]


def test_what_cannot_be_coupled_is_named():
    model = mujoco.MjModel.from_xml_string(SLIDER.format(h=1e-3, g=0.0, z=0.0, m=0.1, drive=""))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for bodies in ([0], [1, 1], [7]):
        with pytest.raises(InputError, match=r"bodies = .*different bodies of the model"):
            CCoupling([model], [data], bodies, contacts=1)
