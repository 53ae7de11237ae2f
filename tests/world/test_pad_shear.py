"""Shear of rigid pads: Cattaneo and Mindlin's contact, its memory, stick without creep, slip at the cone, and rolling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from raytac import mount
from raytac.gel.surface import make_grid
from raytac.physics.rigid.load_law import shear_stiffness, twist_stiffness
from raytac.specs import BodySpec, RobotSpec, TaskScene, load_sensor
from raytac.world.rigid_pads import RigidPads
from raytac.world.world import TactileWorld
from tests.physics.rigid.sheared import Sheared

G = 9.81
ROW = np.zeros(1, int), np.zeros(1, int), np.zeros(1, int)
STIFFNESS, LIMIT, RADIUS = 2e3, 0.5, 2e-3
"""Shear stiffness [N/m] and greatest tangential force [N] of the contact that is sheared by itself; its radius [m]."""
FULL = 1.5 * LIMIT / STIFFNESS
"""Displacement at which all of it slips [m]."""


def forces(displacements: np.ndarray) -> np.ndarray:
    """Tangential force along a path of displacements that starts at 0."""
    state, result = Sheared(1, 1, 1), []
    stiffness = np.array([[STIFFNESS, STIFFNESS * RADIUS**2]])
    limit, centre = np.array([[LIMIT, 0.4 * LIMIT * RADIUS]]), np.zeros((1, 3))
    for step in np.diff(displacements, prepend=0.0):
        state.begin(ROW, stiffness, centre)
        state.move(ROW, np.array([[step, 0.0, 0.0]]), limit, centre, np.array([RADIUS]))
        result.append(state.begin(ROW, stiffness, centre)[0, 0])
    return np.array(result)


def mindlin(displacement: np.ndarray) -> np.ndarray:
    return LIMIT * (1.0 - np.clip(1.0 - displacement / FULL, 0.0, 1.0) ** 1.5)


@pytest.mark.parametrize("share", [0.07, 0.1, 0.15, 0.3, 0.6])
def test_small_oscillations_take_energy_as_masing_says(share: float) -> None:
    top = share * FULL
    up, down = np.linspace(0.0, top, 30), np.linspace(top, -top, 120)[1:]
    path = np.concatenate([up, down, -down])
    area = abs(np.trapezoid(forces(path)[len(up) - 1 :], path[len(up) - 1 :]))
    down = np.append(top, down)
    back = mindlin(np.array([top])) - 2.0 * mindlin(0.5 * (top - down))
    assert area == pytest.approx(abs(2.0 * np.trapezoid(back, down)), rel=0.12)


@pytest.mark.parametrize("steps", [7, 40, 300])
def test_force_against_displacement_and_the_annulus_that_slips_are_cattaneo_and_mindlin_s(steps: int) -> None:
    path = np.linspace(0.0, 1.3 * FULL, steps)
    np.testing.assert_allclose(forces(path), mindlin(path), atol=0.01 * LIMIT)
    for share in (0.2, 0.5, 0.8, 0.95):
        state = Sheared(1, 1, 1)
        limit, centre = np.array([[LIMIT, 1.0]]), np.zeros((1, 3))
        for _ in range(steps):
            state.begin(ROW, np.array([[STIFFNESS, 1.0]]), centre)
            move = FULL * (1.0 - (1.0 - share) ** (2.0 / 3.0)) / steps
            state.move(ROW, np.array([[0.0, move, 0.0]]), limit, centre, np.array([RADIUS]))
        shear = state.of(np.zeros(1, int), 0, np.zeros(1, int))
        assert shear.stuck[0] == pytest.approx((1.0 - share) ** (1.0 / 3.0), rel=0.05)


def test_unloading_follows_masing_s_rule_and_a_loop_closes() -> None:
    """Mindlin and Deresiewicz: from T₁ back, T = T₁ − 2 T(Δu / 2); a cycle ends where it began."""
    top = 0.6 * FULL
    up, down = np.linspace(0.0, top, 60), np.linspace(top, -top, 120)[1:]
    force = forces(np.concatenate([up, down, -down]))
    back = force[len(up) : len(up) + len(down)]
    np.testing.assert_allclose(back, mindlin(np.array([top]))[0] - 2.0 * mindlin(0.5 * (top - down)), atol=0.02 * LIMIT)
    assert force[-1] == pytest.approx(force[len(up) - 1], rel=0.01)
    # The loop takes energy: a tangential force without history would take none.
    assert np.trapezoid(np.r_[force[len(up) - 1], back], np.r_[top, down]) > 0.05 * LIMIT * top


def sheared(displacement: np.ndarray, over_gel: np.ndarray, radius: float, slack: float = 1e3) -> np.ndarray:
    """Mean stretch (n, 2) after every step of a contact that never slips, by displacements of the body and places of the centre (n, 2)."""
    state, result = Sheared(1, 1, 1), []
    limit = np.array([[slack, slack]])
    for step, place in zip(displacement, over_gel, strict=True):
        centre = np.array([[*place, 0.0]])
        state.begin(ROW, np.array([[STIFFNESS, STIFFNESS * radius**2]]), centre)
        state.move(ROW, np.array([[*step, 0.0]]), limit, centre, np.array([radius]))
        result.append(state.mean[ROW][0, :2].copy())
    return np.array(result)


def test_a_stiffness_that_jitters_by_its_last_digits_leaves_the_stretch_as_it_is() -> None:
    """A body at rest: what has shrunk by one digit grows again by one, or by less than its rings can tell."""
    rng, count = np.random.default_rng(3), 400
    rows = np.arange(count), np.zeros(count, int), np.zeros(count, int)
    state, first = Sheared(count, 1, 1), STIFFNESS * rng.uniform(0.6, 1.0, count)
    limit, centre, radius = np.full((count, 2), 1e9), np.zeros((count, 3)), np.full(count, RADIUS)  # no slip, even at the rim

    def step(stiffness: np.ndarray, displacement: float) -> np.ndarray:
        pull = state.begin(rows, np.stack([stiffness, stiffness * RADIUS**2], axis=1), centre)
        state.move(rows, np.tile([displacement, 0.0, 0.0], (count, 1)), limit, centre, radius)
        return pull

    step(STIFFNESS * np.ones(count), 1e-4)
    pulls = [step(first + k * np.spacing(first), 0.0) for k in (1, 0, 1, 0, 2, 1, 2)]
    np.testing.assert_allclose(pulls, np.tile(pulls[0], (7, 1, 1)), rtol=1e-12)
    np.testing.assert_allclose(pulls[0][:, 0], 1e-4 * first, rtol=1e-9)


@pytest.mark.parametrize("held", [2000, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_what_sticks_keeps_its_stretch_however_far_it_shears(share: float, held: int) -> None:
    """A pin sheared by more than twice its contact's radius, then held for steps of 1 ms while its centre jitters by a node's share.

    The centre stays on the gel (a wide plate), goes half as far (another gel), or with the body (a pin).
    """
    rng, radius, shear = np.random.default_rng(1), 0.5e-3, 1.2e-3
    step = np.zeros((300 + held, 2))
    step[:300, 0] = shear / 300
    place = share * np.cumsum(np.vstack([np.zeros(2), step[:-1]]), axis=0) + rng.uniform(-20e-6, 20e-6, step.shape)
    stretch = sheared(step, place, radius)
    np.testing.assert_allclose(stretch[299:], [[shear, 0.0]] * (held + 1), atol=1e-12)


def test_what_rolls_leaves_its_stretch_behind_over_the_diameter_of_the_contact() -> None:
    """A ball that is sheared and then rolled: the centre travels over gel and body alike; to and fro within a sixteenth nothing is lost."""
    radius, shear, steps = 2e-3, 0.1e-3, 400
    start = np.vstack([np.full((10, 2), [shear / 10, 0.0]), np.zeros((steps, 2))])
    travel = np.concatenate([shear * np.arange(10) / 10, shear + 4.0 * radius * np.arange(1, steps + 1) / steps])
    place = np.stack([travel, np.zeros(steps + 10)], axis=1)
    stretch = sheared(start, place, radius)[:, 0]
    assert stretch[9] == pytest.approx(shear, rel=1e-9)
    # Two diameters, of which the play of an eighth of the radius does not count.
    assert stretch[-1] == pytest.approx(shear * np.exp(-(4.0 - 0.125) / 2.0), rel=1e-6)
    # As much across its stretch, or back.
    for way in (np.array([0.0, 1.0]), np.array([-1.0, 0.0])):
        place[10:] = [shear, 0.0] + way * (4.0 * radius * np.arange(1, steps + 1) / steps)[:, None]
        assert sheared(start, place, radius)[-1, 0] == pytest.approx(shear * np.exp(-(4.0 - 0.125) / 2.0), rel=0.05)
    place[10:] = [shear, 0.0] + 0.06 * radius * np.stack([np.sin(np.arange(steps)), np.cos(np.arange(steps))], axis=1)
    assert sheared(start, place, radius)[-1, 0] == pytest.approx(shear, rel=1e-9)


def test_a_pin_thinner_than_its_shear_is_held_at_half_of_the_slip_limit() -> None:
    """A pin of 1 mm that stands between two pads shears them by more than its diameter and stays where it is."""
    pin = BodySpec(
        "pin", "cylinder", {"radius": 0.5e-3, "length": 25e-3}, quaternion=(np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0), mass=1e-3
    )
    dt, press, friction = 2e-3, 1.0, load_sensor("gelsight_mini").gelpad.friction
    gripper = RobotSpec("floating_gripper", "gelsight_mini", opening=25e-3 + 1.5e-3)
    scene = TaskScene("pin", gripper, (pin,), None, None, dt, dt, dt, gravity=(0.0, 0.0, 0.0))
    world = TactileWorld(scene, outputs=(), device="cpu")
    opening, fingers = world.composed.opening, world.composed.fingers
    assert opening is not None
    servo = -float(world.model.actuator_biasprm[opening, 1])
    places = []
    for k in range(750):
        data = world.data[0]
        load = min(max(k - 250, 0) / 150, 1.0) * 0.5 * friction * 2.0 * press
        data.xfrc_applied[world.composed.bodies["pin"].index, 2] = -load
        world.step(lambda d, t: d.ctrl.__setitem__(opening, d.qpos[fingers].sum() - min(t / 0.2, 1.0) * press / servo))
        places.append(float(data.qpos[world.composed.bodies["pin"].qpos + 2]))
    assert places[400] < -0.8e-3  # more than its radius of elastic shear
    assert abs(places[-1] - places[-150]) < 20e-6


def held(kind: str, timestep: float = 4e-3) -> TactileWorld:
    """A body on slides over a flat gel, pressed and pulled along x by motors."""
    size, height = ("0.005", 5e-3) if kind == "sphere" else ("0.004 0.004 0.002", 2e-3)
    spec = mujoco.MjSpec.from_string(f"""<mujoco><option timestep="{timestep}" cone="elliptic" integrator="implicitfast" gravity="0 0 0"/>
        <worldbody><body name="base"><site name="tip"/></body><body name="held" pos="0 0 {height}">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
        <geom type="{kind}" size="{size}" mass="0.02"/></body></worldbody>
        <actuator><motor joint="x"/><motor joint="z"/></actuator></mujoco>""")
    sensor = load_sensor("gelsight_mini")
    if kind == "sphere":
        sensor = replace(sensor, gelpad=replace(sensor.gelpad, dome_radius=(np.inf, np.inf)))
    mount(spec, sensor, site="tip", name="pad", pose=np.eye(4))
    return TactileWorld(spec, sensors={"pad": sensor}, touches={"held": 1.0}, outputs=("wrench",), device="cpu")


def vibrated(world: TactileWorld, pull: float, swing: Callable[[float], float], seconds: float) -> np.ndarray:
    """Places along x after each step of a body under 1 N that ``pull`` [N] has sheared, from where its load begins to swing."""

    def control(data: mujoco.MjData, time: float) -> None:
        data.ctrl[:] = pull * min(time / 0.2, 1.0), -1.0 - (swing(time - 0.4) if time > 0.4 else 0.0)

    places, timestep = [], world.model.opt.timestep
    for _ in range(round((0.4 + seconds) / timestep)):
        world.step(control)
        places.append(world.data[0].qpos[0])
    return np.array(places[round(0.4 / timestep) - 1 :])


@pytest.mark.parametrize(
    ("kind", "share", "pull"),
    [("sphere", 0.1, 0.3), ("sphere", 0.3, 0.3), ("sphere", 0.3, 0.6), ("sphere", 0.01, 0.3), ("box", 0.2, 0.3)],
)
def test_a_body_does_not_creep_while_its_normal_load_vibrates(kind: str, share: float, pull: float) -> None:
    """Mindlin and Deresiewicz: new area comes without stress and leaves again first, so what is held settles once."""
    world = held(kind)
    places = vibrated(world, pull, lambda t: share * np.sin(20.0 * np.pi * t), 3.0)
    assert abs(places[-1] - places[250]) < 0.1e-6  # after 30 cycles and after 10
    if kind == "sphere":
        # The first minimum lets it settle as far as that load would have let it go from the start: Cattaneo and Mindlin, k as N^(1/3).
        pads = world._pads
        assert isinstance(pads, RigidPads)
        stiffness = pads.contact.shear.stiffness[0, 0, 0, 0]
        load = np.array([1.0 - share, 1.0])
        least, mean = 1.5 / stiffness * load ** (2.0 / 3.0) * (1.0 - (1.0 - pull / load) ** (2.0 / 3.0))
        # The elements follow that curve within 1 % of the stretch, 0.2 mm.
        assert places[-1] - places[0] == pytest.approx(least - mean, rel=0.15, abs=1.8e-6)


def test_no_load_that_vibrates_lets_a_body_creep_without_end() -> None:
    """Many minima of the load that differ; all that there are come within a second."""
    world = held("sphere")
    swings = np.array([0.15, 0.08, 0.05]), 2.0 * np.pi * np.array([10.0, 7.0, 24.0])
    places = vibrated(world, 0.3, lambda t: float(swings[0] @ np.sin(swings[1] * t)), 6.0)
    assert places[500] - places[0] > 5e-6 and abs(places[-1] - places[500]) < 0.1e-6


def test_shear_and_twist_together_settle_under_a_load_that_vibrates() -> None:
    state, gel, moved, seen = Sheared(1, 1, 1), load_sensor("gelsight_mini").gelpad, np.zeros(3), []
    for k in range(17 * 20):
        load = 1.0 + (0.3 * np.sin(2.0 * np.pi * k / 20) if k >= 40 else 0.0)
        radius = np.array([2e-3 * np.cbrt(load)])
        stiffness = np.stack([shear_stiffness(radius, gel), twist_stiffness(radius, gel)], axis=1)
        limit = np.array([[load, 3.0 / 16.0 * np.pi * load * radius[0]]])
        for _ in range(10):
            pull = state.begin(ROW, stiffness, np.zeros((1, 3)))
            step = (np.array([0.2, 0.0, 2e-4]) * min(k / 20, 1.0) - pull) / stiffness[:, [0, 0, 1]]
            state.move(ROW, step, limit, np.zeros((1, 3)), radius)
            moved = moved + step[0]
        seen.append(moved)
    settled = seen[39:][::20]
    assert settled[1][0] > 1.1 * settled[0][0] and settled[1][2] > 1.1 * settled[0][2]
    np.testing.assert_allclose(settled[-1], settled[4], rtol=1e-3, atol=1e-12)


def cube_on(share: float, mu: float = 0.6, timestep: float = 0.01, num_envs: int = 1) -> TactileWorld:
    """A plate on a pad that gravity pulls along x with this share of what friction holds."""
    cube = BodySpec("cube", "box", {"length": 0.012, "width": 0.012, "height": 0.003}, position=(0.0, 0.0, 0.00151), mass=0.05)
    pull = G * np.array([share * mu, 0.0, -1.0]) / np.hypot(1.0, share * mu)
    scene = TaskScene("tilt", RobotSpec("fixed_sensor"), (replace(cube, friction=mu),), gravity=tuple(pull.tolist()))
    return TactileWorld(replace(scene, timestep=timestep, control_timestep=0.01), outputs=(), num_envs=num_envs)


@pytest.mark.parametrize(
    ("share", "mu", "edge", "height", "mass", "gap"),
    [(0.86, 0.66, 0.01358, 0.00349, 0.045, 0.79e-3), (0.9, 0.98, 0.01086, 0.00311, 0.19, 0.1e-3)],
)
def test_a_plate_that_rocks_as_it_lands_comes_to_rest(
    share: float, mu: float, edge: float, height: float, mass: float, gap: float
) -> None:
    """Its middle closes slowly and its rim fast, which a step of 10 ms does not resolve."""
    plate = BodySpec("plate", "box", {"length": edge, "width": edge, "height": height}, position=(0.0, 0.0, 0.5 * height + gap))
    pull = G * np.array([share * mu, 0.0, -1.0]) / np.hypot(1.0, share * mu)
    scene = TaskScene("tilt", RobotSpec("fixed_sensor"), (replace(plate, friction=mu, mass=mass),), gravity=tuple(pull.tolist()))
    world = TactileWorld(replace(scene, timestep=0.01, control_timestep=0.01), outputs=())
    for _ in range(80):
        world.step()
    assert np.abs(world.data[0].qvel).max() < 1e-3
    assert np.abs(world.data[0].qpos[0]) < 4e-3


@pytest.mark.parametrize("mu", [0.2, 1.0])
def test_at_nine_tenths_of_the_slip_limit_a_body_does_not_creep(mu: float) -> None:
    world = cube_on(0.9, mu)
    pull = world.model.opt.gravity[0]
    world.model.opt.gravity[0] = 0.0
    for k in range(60):
        world.model.opt.gravity[0] = min(k / 20.0, 1.0) * pull
        world.step()
    before = world.data[0].qpos.copy()
    for _ in range(60):
        state = world.step()
    # 20 µm in 10 s allow 1.2 µm in 0.6 s.
    assert np.abs(world.data[0].qpos[:3] - before[:3]).max() < 1.2e-6
    wrench = state.wrench["sensor"][0]
    assert np.hypot(*wrench[:2]) / -wrench[2] == pytest.approx(0.9 * mu, rel=0.05)


def test_beyond_the_limit_it_slips_and_carries_no_more_than_the_cone() -> None:
    world, stuck = cube_on(1.1, 0.4), []
    pads = world._pads
    assert isinstance(pads, RigidPads)
    for _ in range(20):
        world.step()
        stuck.append(pads.contact.shear.of(np.zeros(1, int), 0, np.zeros(1, int)).stuck[0])
        # About the normal of the dome at the contact's centre.
        force = np.linalg.norm(world.state().wrench["sensor"][0, :3])
        slope = np.abs(world.data[0].qpos[0]) / 0.210
        normal = -world.state().wrench["sensor"][0, 2]
        if normal < 1e-3:
            continue  # on the way down it may be off for a step
        tilt = np.arccos(min(normal / force, 1.0))
        assert tilt <= np.arctan(0.4 * 1.01) + slope + 0.003
    assert world.data[0].qpos[0] > 1e-4 and world.data[0].qvel[0] > 1e-2
    # The load swings as the plate slides down the dome at up to 0.2 m/s, 2 mm a step, and the shear follows it a little later.
    assert min(stuck) < 0.01


def driven(timestep: float, friction: float, inertia: float = 1.0) -> tuple[TactileWorld, RigidPads]:
    """A ball under 1 N on a flat gel, on a slide and a hinge that nothing slows down; it is at rest."""
    spec = mujoco.MjSpec.from_string(f"""<mujoco><option timestep="{timestep}" cone="elliptic" integrator="implicitfast" gravity="0 0 0"/>
        <worldbody><body name="base"><site name="tip"/></body><body name="ball" pos="0 0 0.005">
        <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0" armature="100"/>
        <joint name="spin" type="hinge" axis="0 0 1" armature="{inertia}"/><geom type="sphere" size="0.005" mass="0.02"/></body></worldbody>
        <actuator><motor joint="z"/></actuator></mujoco>""")
    sensor = load_sensor("gelsight_mini")
    sensor = replace(sensor, gelpad=replace(sensor.gelpad, dome_radius=(np.inf, np.inf)))
    mount(spec, sensor, site="tip", name="pad", pose=np.eye(4))
    world = TactileWorld(spec, sensors={"pad": sensor}, touches={"ball": friction}, outputs=("wrench",), device="cpu")
    for _ in range(round(0.3 / timestep)):
        world.step(press)
    pads = world._pads
    assert isinstance(pads, RigidPads)
    return world, pads


def press(data: mujoco.MjData, time: float) -> None:
    data.ctrl[0] = -1.0


@pytest.mark.parametrize("timestep", [1e-3, 2e-3, 5e-3, 10e-3])
@pytest.mark.parametrize(("joint", "speed", "power"), [(1, 1e-3, 1.5), (1, 5e-3, 1.5), (2, 0.2, 2.5), (2, 0.6, 2.5)])
def test_in_steady_slow_motion_force_and_stretch_are_those_of_theory(
    timestep: float, joint: int, speed: float, power: float
) -> None:
    """Cattaneo and Mindlin's force at the place where the step ends, and the torque of the same springs, whatever the step."""
    world, pads = driven(timestep, 0.3)
    start, (stiffness, limit) = (
        world.data[0].qpos[joint],
        zip(pads.contact.shear.stiffness[0, 0, 0], pads.contact.shear.load[0, 0, 0], strict=True),
    )
    k, most = (stiffness, limit)[joint - 1]
    full = power * most / k
    world.data[0].qvel[joint] = speed
    for _ in range(max(round(0.95 * full / speed / timestep), 1)):
        state = world.step(press)
        carried = state.wrench["pad"][0, 0 if joint == 1 else 5]
        moved = world.data[0].qpos[joint] - start
        theory = most * (1.0 - max(1.0 - moved / full, 0.0) ** power)
        assert carried == pytest.approx(theory, abs=0.05 * most)
        shear = pads.contact.shear.mean[0, 0, 0, 0 if joint == 1 else 2] * k
        assert shear == pytest.approx(carried, abs=0.05 * most)


@pytest.mark.parametrize("timestep", [1e-3, 10e-3])
@pytest.mark.parametrize("share", [0.5, 0.9, 1.2])
def test_a_torque_that_comes_at_once_is_held_or_turns_a_light_ball(timestep: float, share: float) -> None:
    """Its inertia is nothing to a step of 10 ms; beyond the limit the rest of the torque accelerates it."""
    world, pads = driven(timestep, 0.6, inertia=0.0)
    limit, inertia = pads.contact.shear.load[0, 0, 0, 1], 0.4 * 0.02 * 5e-3**2
    world.data[0].qfrc_applied[2] = share * limit
    seen = []
    for _ in range(round(0.3 / timestep)):
        state = world.step(press)
        seen.append((world.data[0].qvel[2], state.wrench["pad"][0, 5] / limit))
    half, (speed, torque) = seen[len(seen) // 2][0], seen[-1]
    if share < 1.0:
        assert torque == pytest.approx(share, abs=0.05) and abs(speed) < 0.1 * np.abs(seen).max(axis=0)[0]
    else:
        gained = (share - 1.0) * limit / inertia * timestep * (len(seen) - 1 - len(seen) // 2)
        assert torque == pytest.approx(1.0, abs=1e-3) and speed - half == pytest.approx(gained, rel=1e-2)


def test_a_cube_that_is_pulled_shears_the_gel_as_mindlin_says() -> None:
    """Both ends of the loaded steps are at rest, and the load grows slowly, so the displacement is the elastic one."""
    share, mu = 0.7, 0.5
    world = cube_on(share, mu, 2e-3)
    pads = world._pads
    assert isinstance(pads, RigidPads)
    # Lowered without friction's load first: the same cube under its weight alone.
    gravity = world.model.opt.gravity.copy()
    world.model.opt.gravity[0] = 0.0
    for _ in range(30):
        world.step()
    start = world.data[0].qpos[0]
    for k in range(90):
        world.model.opt.gravity[0] = min(k / 30.0, 1.0) * gravity[0]
        world.step()
    stiffness, load = pads.contact.shear.stiffness[0, 0, 0, 0], pads.contact.shear.load[0, 0, 0, 0]
    force = float(np.hypot(*world.state().wrench["sensor"][0, :2]))
    expected = 1.5 * load / stiffness * (1.0 - (1.0 - force / load) ** (2.0 / 3.0))
    moved = world.data[0].qpos[0] - start
    assert pads.contact.shear.stretch[0, 0, 0, :, 0].max() == pytest.approx(expected, rel=0.05)
    # With what it rocks by on the dome the plate moves somewhat more.
    assert moved == pytest.approx(expected, rel=0.25)


def test_a_twist_holds_below_its_limit_and_turns_above() -> None:
    for share, turns in ((0.9, False), (1.2, True)):
        world = cube_on(0.0, 0.6)
        pads = world._pads
        assert isinstance(pads, RigidPads)
        for _ in range(30):
            world.step()
        limit = pads.contact.shear.load[0, 0, 0, 1]
        world.data[0].xfrc_applied[world.composed.bodies["cube"].index, 5] = share * limit
        for _ in range(60):
            world.step()
        spin = abs(world.data[0].qvel[5])
        assert spin > 0.1 if turns else spin < 1e-6


def test_reset_forgets_the_shear_and_a_batch_shears_as_its_environments_alone() -> None:
    both = cube_on(0.8, num_envs=2)
    for _ in range(15):
        both.step()
    pads = both._pads
    assert isinstance(pads, RigidPads) and pads.contact.shear.mean[:, 0, 0, 0].min() > 1e-6
    grid = make_grid(both.composed.sensor_specs[0].gelpad, 0.4e-3)
    shear = pads.reading("sensor", grid, np.array([False, True])).shear
    assert shear is not None and shear.stretch[0, 0] == pytest.approx(pads.contact.shear.mean[0, 0, 0, 0])
    assert 0.0 < shear.stuck[0] < 1.0 and np.isnan(shear.stretch[1]).all() and np.isnan(shear.spin[1])
    both.reset([0])
    alone = cube_on(0.8)
    assert not pads.contact.shear.stretch[0].any() and pads.contact.shear.stretch[1].any()
    both.data[1].qpos[0] += 1e-3
    for _ in range(15):
        both.step()
        alone.step()
    np.testing.assert_array_equal(both.data[0].qpos, alone.data[0].qpos)
    np.testing.assert_array_equal(both.state().wrench["sensor"][0], alone.state().wrench["sensor"][0])


def test_a_drag_that_reverses_slips_back_after_twice_the_stretch() -> None:
    """The pull changes its sign above the limit: the cube returns by the gel's stretch before it slips the other way."""
    world = cube_on(1.3, 0.3, 2e-3)
    pads = world._pads
    assert isinstance(pads, RigidPads)
    for _ in range(12):
        world.step()

    def slip() -> float:
        """Tangential force of the stretch over that at which the contact slips."""
        shear = pads.contact.shear
        return shear.mean[0, 0, 0, 0] * shear.stiffness[0, 0, 0, 0] / shear.load[0, 0, 0, 0]

    assert slip() == pytest.approx(1.0, abs=0.02)
    world.model.opt.gravity[0] *= -1.0
    world.data[0].qvel[:] = 0.0
    seen = []
    for _ in range(12):
        world.step()
        seen.append(slip())
    assert seen[-1] == pytest.approx(-1.0, abs=0.02) and world.data[0].qvel[0] < -1e-2
