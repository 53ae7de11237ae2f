"""Kernels of a step of rigid pads against NumPy, on random states; a batch is its environments alone; CPU and CUDA agree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid.contacts import LoadTables, PadContacts
from raytac.physics.rigid.gel_contact import Bodies, GelContact, HostViews
from raytac.physics.rigid.shear import LEAST_RINGS, MOST_RINGS
from raytac.se3 import rotations
from raytac.shapes.part import primitive
from raytac.specs import load_sensor
from raytac.warp_runtime import Recorded
from raytac.world.gel_pairs import GelPairs
from tests.physics.rigid.oracle_motion import PadMotion, cross, motion_of, turned
from tests.physics.rigid.oracle_pierced import BondedFaces
from tests.physics.rigid.oracle_rows import gel_rows, rolled_on, row_axes, slip_levers
from tests.physics.rigid.oracle_shear import ShearOracle
from tests.physics.rigid.oracle_spring import contact_rate, normal_spring
from tests.physics.rigid.oracle_steps import TRAVEL, StepChoice
from tests.physics.rigid.sheared import Sheared

MINI = load_sensor("gelsight_mini").gelpad
GELS = MINI, replace(MINI, youngs_modulus=2.0 * MINI.youngs_modulus, hysteresis=0.1, relaxation_time=3e-3)
SHAPES = [
    (primitive("sphere", (4e-3,)),),
    (primitive("box", (4e-3, 3e-3, 2e-3)), primitive("sphere", (3e-3,))),
    (primitive("plane", ()),),
    (primitive("cylinder", (2e-3, 5e-3)),),
]
PADS, COUNT, ENVS = len(GELS), len(SHAPES), 60
TIMESTEP, CASE_TRAVEL = 0.004, 2.4e-3
CASE_CENTRE, CASE_HALF = np.tile([0.0, 0.0, -0.02], (PADS, 1)), np.tile([0.016, 0.016, 0.0155], (PADS, 1))
MASS_CENTRE = np.vstack([np.linspace(-1e-3, 1e-3, 3 * COUNT).reshape(COUNT, 3), np.zeros((PADS, 3))])
CARRIER = np.array([1, 2])
INDEX = np.array([3, 4, 5, 6])


@dataclass
class State:
    """What the kernels are given: frames of pads and bodies, numbers of environments, and the shear of their contacts."""

    frames: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    shear: dict[str, np.ndarray]
    rolling: np.ndarray
    acceleration: np.ndarray
    done: np.ndarray


def random_state(seed: int, num_envs: int = ENVS) -> State:
    """Bodies about the gels of two pads that face each other, in motion; half of the contacts have been there before."""
    rng = np.random.default_rng(seed)
    place, turn = np.zeros((num_envs, PADS + COUNT, 3)), np.zeros((num_envs, PADS + COUNT, 3, 3))
    turn[:] = rotations(rng.normal(0.0, 0.1, (num_envs, PADS + COUNT, 3)).reshape(-1, 3)).reshape(turn.shape)
    turn[:, 1] = turn[:, 0] @ np.diag([1.0, -1.0, -1.0]) @ turn[:, 1]
    place[:, 1] = place[:, 0] + turn[:, 0] @ np.array([0.0, 0.0, 1.0]) * rng.choice([-0.5e-3, 1e-3, 0.03], (num_envs, 1))
    place[:, PADS:] = rng.uniform(-6e-3, 6e-3, (num_envs, COUNT, 3))
    place[:, PADS:, 2] = np.array([4e-3, 2e-3, 0.0, 5e-3]) + rng.uniform(-1e-3, 0.4e-3, (num_envs, COUNT))
    # In half of the environments only a ball is near, which may be about to touch.
    place[::2, PADS + 1 :, 2] += 0.1
    place[::2, PADS, :2] *= 0.2
    place[::2, PADS, 2] = 4e-3 + rng.uniform(-30e-6, 30e-6, len(place[::2]))
    turn[:, PADS + 2] = np.diag([1.0, -1.0, -1.0]) @ turn[:, PADS + 2]  # the half-space looks down
    frames = {
        "place": place,
        "turn": turn,
        "velocity": rng.normal(0.0, 0.1, place.shape),
        "spin": rng.normal(0.0, 2.0, place.shape),
        "push": rng.normal(0.0, 20.0, place.shape),
        "swing": rng.normal(0.0, 500.0, place.shape),
    }
    friction = rng.uniform(0.1, 1.5, (num_envs, COUNT))
    numbers = {
        "inverse_weight": rng.uniform(0.0, 30.0, (num_envs, 7)),
        "gel_stiffness": rng.uniform(0.5, 2.0, (num_envs, PADS)),
        "gel_friction": rng.uniform(0.2, 1.5, (num_envs, PADS)),
        "body_friction": np.where(rng.random(friction.shape) < 0.5, np.nan, friction),
    }
    numbers["inverse_weight"][:, [2, 6]] = 0.0  # the second pad and the last body do not move
    slots, there = (num_envs, PADS, COUNT + PADS), rng.random((num_envs, PADS, COUNT + PADS, 1)) < 0.5
    stiffness = np.where(there, rng.uniform(0.5, 1.5, (*slots, 2)) * [2e3, 0.05], 0.0)
    size = rng.uniform(LEAST_RINGS, MOST_RINGS, slots)
    covered = np.clip(size[..., None] - np.arange(MOST_RINGS), 0.0, 1.0)
    inner = covered * rng.choice([0.0, 0.3, 1.0], covered.shape)
    parts = there & (np.stack([inner, covered - inner], axis=-1).reshape(*slots, -1) > 0.0)
    shear = {
        "stretch": np.where(parts[..., None], rng.normal(0.0, [1e-4, 1e-4, 0.02], (*parts.shape, 3)), 0.0),
        "inner": np.where(there, inner, 0.0),
        "width": stiffness[..., 0] / size,
        "mean": np.where(there, rng.normal(0.0, [1e-4, 1e-4, 0.02], (*slots, 3)), 0.0),
        "stiffness": stiffness,
        "load": np.where(there, rng.uniform(0.5, 1.5, (*slots, 2)), 0.0),
        "centre": np.where(there, rng.normal(0.0, 2e-3, (*slots, 3)), 0.0),
        "play": np.where(there[..., None], rng.normal(0.0, 2e-4, (*slots, 2, 2)), 0.0),
        "moved": np.where(there, rng.normal(0.0, 1e-4, (*slots, 2)), 0.0),
    }
    done = rng.choice([0, 1024, 3072, 3328], num_envs)
    rolling = np.where(there, rng.uniform(-0.7, 0.7, (*slots, 2)), 0.0)
    return State(frames, numbers, shear, rolling, np.where(there[..., 0], rng.normal(0.0, 50.0, slots), 0.0), done)


def gel_contact(state: State, device: str = "cpu") -> GelContact:
    num_envs = len(state.done)
    bodies = Bodies(SHAPES, INDEX, CARRIER, MASS_CENTRE, CASE_CENTRE, CASE_HALF)
    contact = GelContact(
        GELS,
        bodies,
        GelPairs(GELS, CARRIER, num_envs, device=device).pairs,
        state.numbers,
        num_envs=num_envs,
        timestep=TIMESTEP,
        case_travel=CASE_TRAVEL,
        device=device,
    )
    for name, values in state.frames.items():
        getattr(contact.frames, name).assign(values)
    for name, values in state.shear.items():
        getattr(contact.shear.struct, name).assign(values)
    contact.acceleration.assign(state.acceleration)
    contact.rolling.assign(state.rolling)
    contact.steps.envs.assign(np.arange(num_envs, dtype=np.int32))
    contact.steps.done.assign(state.done.astype(np.int32))
    return contact


def of_slots(contact: GelContact, name: str) -> np.ndarray:
    return getattr(contact.slots, name).numpy()


def chosen(contacts: PadContacts, rows: np.ndarray) -> PadContacts:
    return PadContacts(**{name: values[rows] for name, values in vars(contacts).items()})


class Step:
    """A step in NumPy, with the contacts that the search of the kernels has measured."""

    def __init__(self, state: State, contact: GelContact) -> None:
        self.state, num_envs = state, len(state.done)
        envs = np.arange(num_envs)
        self.motion = motion_of(pads=PADS, **{name: state.frames[name] for name in ("place", "turn", "velocity", "spin")})
        self.choice = choice = StepChoice(TIMESTEP)
        self.left = left = TIMESTEP * (1.0 - state.done / choice.ticks)
        radius = np.array([4e-3, np.sqrt(29.0) * 1e-3, np.inf, np.hypot(2e-3, 5e-3)])
        speed = self.motion.greatest_speed(radius)
        self.reach = speed.max(axis=2) * left[:, None] + self.greatest_push(radius).max(axis=2) * left[:, None] ** 2
        apart = np.abs(self.motion.pad_from_body[:, :, :COUNT, :3, 3] - CASE_CENTRE[:, None]) - CASE_HALF[:, None]
        beside = choice.beside_case(np.linalg.norm(np.maximum(apart, 0.0), axis=-1) - radius, speed)
        beside[..., 2] = np.inf
        self.case_step = beside.min(axis=2)
        poses = contact.motion.pose.numpy()
        some = [contact.search.contacts(poses[:, :, :COUNT], envs, contact.search.reach.numpy().copy())]
        (search, i, body), j = contact._pairs[0], contact._pairs[0][2] - COUNT
        near = search.contacts(poses[:, i : i + 1, body : body + 1], envs, np.maximum(search.reach.numpy(), 0.0))
        some.append(replace(near, pad=near.pad + i, body=near.body + COUNT + j, clearance=near.clearance + GELS[j].thickness))
        rows = {name: np.concatenate([getattr(one, name) for one in some]) for name in PadContacts.__dataclass_fields__}
        contacts = chosen(PadContacts(**rows), np.lexsort((rows["body"], rows["pad"], rows["env"])))
        self.lost = np.zeros(num_envs, bool)
        self.lost[contacts.env[np.isnan(contacts.deepest)]] = True
        carrier = np.concatenate([INDEX, CARRIER])
        weight = state.numbers["inverse_weight"][contacts.env]
        at = np.arange(len(contacts))
        compliance = weight[at, CARRIER[contacts.pad]] + weight[at, carrier[contacts.body]]
        movable = (compliance > 0.0) & ~np.isnan(contacts.deepest)
        self.contacts, self.compliance = chosen(contacts, movable), compliance[movable]
        self.speed = self.motion.closing(self.contacts, self.contacts.env)
        self.longest, self.length = self._lengths()
        self._spring()

    def greatest_push(self, radius: np.ndarray) -> np.ndarray:
        """Greatest free accelerations (n, pads, bodies) of any point of bodies in balls of a radius against any of the pad."""
        push, swing = (np.linalg.norm(self.state.frames[name], axis=-1) for name in ("push", "swing"))
        place, size = self.state.frames["place"], np.minimum(radius, 1.0)
        apart = np.linalg.norm(place[:, None, PADS:] - place[:, :PADS, None], axis=-1)
        pad, body = swing[:, :PADS, None], swing[:, None, PADS:]
        return push[:, :PADS, None] + push[:, None, PADS:] + pad * apart + (pad + body) * size

    def free(self, contacts: PadContacts) -> tuple[np.ndarray, np.ndarray]:
        """Free accelerations (n, 3) of pad and body where they touch, pad frame."""
        frames, env, at = self.state.frames, contacts.env, self.motion.world_from_pad[contacts.env, contacts.pad]
        point = (at[:, :3, :3] @ contacts.centre[..., None])[..., 0] + at[:, :3, 3]
        of = [contacts.pad, np.where(contacts.body < COUNT, PADS + contacts.body, contacts.body - COUNT)]
        each = [frames["push"][env, k] + cross(frames["swing"][env, k], point - frames["place"][env, k]) for k in of]
        return turned(each[0], at[:, :3, :3]), turned(each[1], at[:, :3, :3])

    def gain(self, contacts: PadContacts) -> np.ndarray:
        """Free accelerations (n, 6), linear and angular, of the body over the pad, pad frame."""
        swing, env, (pad, body) = self.state.frames["swing"], contacts.env, self.free(contacts)
        other = np.where(contacts.body < COUNT, PADS + contacts.body, contacts.body - COUNT)
        rotation = self.motion.world_from_pad[env, contacts.pad, :3, :3]
        return np.concatenate([body - pad, turned(swing[env, other] - swing[env, contacts.pad], rotation)], axis=1)

    def push(self, contacts: PadContacts) -> np.ndarray:
        pad, body = self.free(contacts)
        return np.maximum(np.vecdot(pad, contacts.normal), 0.0) + np.maximum(-np.vecdot(body, contacts.normal), 0.0)

    def law(self, contacts: PadContacts) -> LoadTables:
        return LoadTables(contacts, self.thickness(contacts), self.softer(contacts))

    def thickness(self, contacts: PadContacts) -> np.ndarray:
        size, other = np.array([gel.thickness for gel in GELS]), contacts.body - COUNT
        return size[contacts.pad] + np.where(other >= 0, size[np.maximum(other, 0)], 0.0)

    def softer(self, contacts: PadContacts) -> np.ndarray:
        stiffness, modulus = self.state.numbers["gel_stiffness"], np.array([gel.youngs_modulus for gel in GELS])
        own, other = stiffness[contacts.env, contacts.pad], contacts.body - COUNT
        at = np.maximum(other, 0)
        both = own * modulus[contacts.pad] / (stiffness[contacts.env, at] * modulus[at])
        return own / np.where(other >= 0, 1.0 + both, 1.0)

    def friction(self, contacts: PadContacts) -> np.ndarray:
        own, gel = self.state.numbers["body_friction"], self.state.numbers["gel_friction"]
        given = np.append(own, np.full_like(gel, np.nan), axis=1)[contacts.env, contacts.body]
        return np.where(np.isnan(given), gel[contacts.env, contacts.pad], given)

    def _lengths(self) -> tuple[np.ndarray, np.ndarray]:
        contacts, thickness = self.contacts, self.thickness(self.contacts)
        env = contacts.env
        deeper = contacts.depth + np.minimum(np.maximum(self.speed, 0.0) * self.left[env], TRAVEL * thickness)
        law, at = self.law(contacts), (env, contacts.pad, contacts.body)
        rate = contact_rate(law.force(deeper)[1], self.compliance)
        tilting = np.linalg.norm(cross(self.motion.spin[at], contacts.normal), axis=-1) * law.radius(deeper)
        each = self.choice.longest(contacts.depth, self.speed, tilting, rate, self.state.acceleration[at], thickness)
        longest = np.minimum(self.case_step.min(axis=1), TIMESTEP)
        np.minimum.at(longest, env, each)
        self.ticks = self.choice.rounded(longest, self.state.done)
        return each, TIMESTEP * self.ticks / self.choice.ticks

    def _spring(self) -> None:
        contacts, step = self.contacts, self.length[self.contacts.env]
        tau = np.array([gel.relaxation_time for gel in GELS])[contacts.pad]
        spring = normal_spring(self.law(contacts), contacts.depth, self.speed, self.compliance, step, tau, self.push(contacts))
        held = (spring.damping > 0.0) & ~self.lost[contacts.env]
        self.held, self.closing = chosen(contacts, held), self.speed[held]
        spring = type(spring)(spring.force[held], spring.damping[held], spring.deepest[held])
        self.slot = self.held.env, self.held.pad, self.held.body
        shape = self.state.acceleration.shape
        self.shear = ShearOracle(*shape)
        for name, values in self.state.shear.items():
            getattr(self.shear, name)[:] = values
        apart = np.ones(shape, bool)
        apart[self.slot] = False
        apart[self.lost] = False  # they stand still
        self.shear.clear(*np.nonzero(apart))
        law = self.law(self.held)
        self.radius = law.radius(np.maximum(spring.deepest, 0.0))
        self.rows, self.turn = gel_rows(
            self.held,
            law,
            spring,
            self.motion,
            self.held.env,
            self.length[self.held.env],
            shear=self.shear,
            gels=GELS,
            softer=self.softer(self.held),
            friction=self.friction(self.held),
            mass_centre=MASS_CENTRE,
            gain=self.gain(self.held),
            compliance=self.compliance[held],
            rolling=self.state.rolling[self.slot],
        )

    def end(self, force: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Wrenches (B, pads, 6) by forces and velocities of the rows held, (n, 6); the shear is moved."""
        rows, turn, held, env = self.rows, self.turn, self.held, self.held.env
        moved = np.empty((len(held), 3))
        moved[:, :2] = (turn @ velocity[:, 1:3, None])[..., 0] * rows.step[:, None]
        moved[:, 2] = velocity[:, 3] * rows.step
        limit = force[:, 0] * rows.friction[:, 0]
        self.shear.move(self.slot, moved, np.stack([limit, limit * slip_levers(self.radius)], axis=1), held.centre, self.radius)
        self.rolling = np.zeros(self.state.rolling.shape)
        angle = (turn @ (rows.step[:, None] * rows.bend * velocity[:, 4:])[..., None])[..., 0]
        self.rolling[self.slot] = rolled_on(self.state.rolling[self.slot], angle)
        axes = row_axes(held.normal, turn)
        push = -(force[:, None, :3] @ axes)[:, 0]
        torque = -(force[:, None, 3:] @ axes)[:, 0] + cross(held.centre, push)
        wrench = np.zeros((len(self.lost), PADS, 6))
        np.add.at(wrench, (env, held.pad), np.concatenate([push, torque], axis=1))
        gel = np.flatnonzero(held.body >= COUNT)
        pose = self.motion.pad_from_body[self.slot][gel]
        opposite = cross(pose[:, :3, 3], push[gel]) - torque[gel]
        parts = [turned(-push[gel], pose[:, :3, :3]), turned(opposite, pose[:, :3, :3])]
        np.add.at(wrench, (env[gel], held.body[gel] - COUNT), np.concatenate(parts, axis=1))
        return wrench


def same(actual: np.ndarray, expected: np.ndarray, tolerance: float = 1e-12) -> None:
    """Equal within a share of the expected values or, of what cancels, of their median."""
    finite = np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(actual), finite)
    usual = np.abs(expected[finite & (expected != 0.0)])
    usual = float(np.median(usual)) if len(usual) else 0.0
    np.testing.assert_allclose(actual[finite], expected[finite], rtol=tolerance, atol=tolerance * usual)


@pytest.mark.parametrize("seed", range(4))
def test_a_step_of_the_kernels_is_that_of_numpy(seed: int) -> None:
    state = random_state(seed)
    contact = gel_contact(state)
    contact.begin()
    slots = {name: of_slots(contact, name).copy() for name in ("row", "held", "speed", "longest", "centre", "radius")}
    slots |= {name: of_slots(contact, name).copy() for name in ("place", "frame", "friction", "force", "regularisation")}
    closing = np.pad(contact.search.closing.numpy(), ((0, 0), (0, 0), (0, PADS)), constant_values=np.inf)
    step = Step(state, contact)  # with all gaps, also those that cannot close
    motion: PadMotion = step.motion
    views = HostViews(contact)
    for name, expected in (("pose", motion.pad_from_body), ("velocity", motion.velocity), ("spin", motion.spin)):
        same(getattr(contact.motion, name).numpy(), expected)
    same(contact.motion.case_step.numpy(), step.case_step)
    same(contact.search.reach.numpy(), step.reach)
    pierced = BondedFaces(GELS, SHAPES).pierced_on_path(views.poses, views.poses_before, views.suspect != 0)
    np.testing.assert_array_equal(views.lost != 0, step.lost | pierced.any(axis=(1, 2)))
    views.lost[:] = step.lost  # what is pierced goes on as well, so that all is compared
    moving = step.contacts.env, step.contacts.pad, step.contacts.body
    closes = -step.contacts.depth < closing[moving]
    assert 0.02 < np.mean(~closes) < 0.5
    moving = tuple(at[closes] for at in moving)
    expected = np.zeros(slots["row"].shape, bool)
    expected[moving] = True
    np.testing.assert_array_equal(slots["row"] >= 0, expected)
    same(slots["speed"][moving], step.speed[closes])
    same(slots["longest"][moving], step.longest[closes])
    np.testing.assert_array_equal(views.ticks, step.ticks)
    np.testing.assert_array_equal(views.length, step.length)
    expected = np.zeros(slots["row"].shape, bool)
    expected[step.slot] = True
    np.testing.assert_array_equal(slots["held"] != 0, expected)
    np.testing.assert_array_equal(views.contacts, np.bincount(step.held.env, minlength=ENVS) * ~step.lost)
    assert len(step.held) > ENVS and (step.held.body >= COUNT).any() and (step.held.depth < 0.0).any()
    rows = step.rows
    expected = np.zeros(ENVS, bool)
    expected[step.held.env[rows.slides]] = True
    np.testing.assert_array_equal(views.slides != 0, expected)
    assert expected.any() and not expected.all()
    same(slots["centre"][step.slot], step.held.centre)
    same(slots["radius"][step.slot], step.radius)
    same(slots["place"][step.slot], rows.position)
    same(slots["frame"][step.slot].reshape(-1, 9), rows.frame, 1e-10)  # principal axes of a spread that is nearly round
    same(slots["friction"][step.slot], rows.friction, 1e-10)
    for k in range(6):
        # The viscosity of rolling is a small difference from that of tilt.
        same(slots["force"][step.slot][:, k], rows.force[:, k], 1e-10 if k < 4 else 1e-5)
        same(slots["regularisation"][step.slot][:, k], rows.regularisation()[:, k], 1e-10)

    rng = np.random.default_rng(seed)
    force, velocity = np.zeros((2, *slots["held"].shape, 6))
    force[step.slot] = np.abs(rng.normal(0.0, 1.0, (len(step.held), 6)))
    velocity[step.slot] = rng.normal(0.0, 0.1, (len(step.held), 6))
    contact.force.assign(force)
    contact.velocity.assign(velocity)
    contact.end()
    wrench = step.end(force[step.slot], velocity[step.slot])
    same(views.wrench[~step.lost], wrench[~step.lost], 1e-10)
    for name, values in vars(step.shear).items():
        same(getattr(contact.shear, name)[~step.lost], values[~step.lost], 1e-9)
    same(views.rolling[~step.lost], step.rolling[~step.lost], 1e-9)
    acceleration = np.zeros(slots["held"].shape)
    acceleration[step.slot] = (-velocity[step.slot][:, 0] - step.closing) / rows.step
    same(views.acceleration[~step.lost], acceleration[~step.lost])


def test_shear_of_loads_that_swing_is_that_of_numpy() -> None:
    """Rings come and go, join and part, over many steps."""
    rng, count = np.random.default_rng(2), 40
    kernels, oracle = Sheared(count, 1, 1), ShearOracle(count, 1, 1)
    rows = np.arange(count), np.zeros(count, int), np.zeros(count, int)
    seen = set()
    for k in range(60):
        stiffness = 1e3 * np.exp(rng.normal(0.0, (0.05, 0.4, 3.0)[k % 3], count))
        both = np.stack([stiffness, 1e-11 * stiffness**3], axis=1)
        before, centre = oracle.width[rows].copy(), rng.normal(0.0, 1e-4, (count, 3))
        expected = oracle.begin(rows, both, centre)
        np.testing.assert_allclose(kernels.begin(rows, both, centre), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
        seen |= set(np.sign(oracle.width[rows] - before).tolist())
        moved = rng.normal(0.0, [3e-5, 3e-5, 0.01], (count, 3))
        limit = np.stack([rng.uniform(0.1, 1.0, count), rng.uniform(1e-4, 1e-3, count)], axis=1)
        for state in (oracle, kernels):
            state.move(rows, moved, limit, centre, np.full(count, 2e-3))
        for name in ("stretch", "inner", "width", "mean"):
            expected = getattr(oracle, name)
            np.testing.assert_allclose(
                getattr(kernels, name), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max(), err_msg=name
            )
    assert seen == {-1.0, 0.0, 1.0}


def taken(state: State, envs: np.ndarray) -> State:
    def of(values: Any) -> Any:
        return {name: one[envs] for name, one in values.items()} if isinstance(values, dict) else values[envs]

    return State(**{name: of(values) for name, values in vars(state).items()})


def results(contact: GelContact) -> dict[str, np.ndarray]:
    """Everything that a step leaves, with forces that depend on the slot alone."""
    contact.begin()
    shape = contact.force.shape
    values = np.cos(np.arange(np.prod(shape[1:]))).reshape(shape[1:])
    contact.force.assign(np.broadcast_to(1.0 + values, shape))
    contact.velocity.assign(np.broadcast_to(0.1 * values, shape))
    contact.end()
    held = of_slots(contact, "held").astype(bool)
    result = {name: of_slots(contact, name) * held[..., None] for name in ("place", "friction", "force", "regularisation")}
    names = "stretch", "inner", "width", "mean", "stiffness", "load", "play"
    result |= {name: getattr(contact.shear.struct, name).numpy() for name in names}
    return result | {
        "wrench": contact.wrenches.numpy(),
        "rolling": contact.rolling.numpy(),
        "length": contact.steps.length.numpy(),
        "held": held,
    }


def test_a_batch_is_its_environments_alone_to_the_bit() -> None:
    state = random_state(7, 12)
    whole = results(gel_contact(state))
    for b in (0, 5, 11):
        alone = results(gel_contact(taken(state, np.array([b]))))
        for name, values in alone.items():
            np.testing.assert_array_equal(values[0], whole[name][b], err_msg=name)


def test_rows_without_an_environment_are_left_out() -> None:
    """Whatever they held before: neither they nor the environments that had them change."""
    state = random_state(8)
    whole, contact, count = results(gel_contact(state)), gel_contact(state), ENVS - 3
    contact.slots.row.fill_(0)
    contact.slots.held.fill_(1)
    contact.motion.near_gel.fill_(1)
    contact.search.poses.fill_(wp.mat44d(*[np.nan] * 16))
    contact.steps.envs.assign(np.where(np.arange(ENVS) < count, np.arange(ENVS), -1).astype(np.int32))
    some = results(contact)
    for name, values in whole.items():
        np.testing.assert_array_equal(some[name][:count], values[:count], err_msg=name)
    for name in ("stretch", "stiffness", "load", "play"):
        np.testing.assert_array_equal(some[name][count:], state.shear[name][count:], err_msg=name)
    np.testing.assert_array_equal(some["rolling"][count:], state.rolling[count:])
    assert not some["wrench"][count:].any() and whole["wrench"][count:].any()
    assert np.isnan(contact.before.numpy()[count:]).all()


def test_kernels_that_are_recorded_do_the_same_on_every_repeat() -> None:
    state = random_state(9)
    plain, contact = gel_contact(state), gel_contact(state)
    begin, end = Recorded(contact.begin), Recorded(contact.end)
    assert not of_slots(contact, "held").any()  # recording runs nothing
    for _ in range(2):
        plain.begin()
        begin()
        for one in (plain, contact):
            one.force.fill_(0.5)
            one.velocity.fill_(0.01)
        plain.end()
        end()
        assert of_slots(plain, "held").any()
        for name in ("held", "place", "force", "wrench"):
            np.testing.assert_array_equal(of_slots(contact, name), of_slots(plain, name), err_msg=name)
        np.testing.assert_array_equal(contact.wrenches.numpy(), plain.wrenches.numpy())


def left_by(contact: GelContact) -> dict[str, np.ndarray]:
    """All that outlasts a step."""
    result = {name: getattr(contact, name).numpy().copy() for name in ("before", "acceleration", "rolling", "wrenches")}
    names = "stretch", "inner", "width", "mean", "stiffness", "load", "centre", "play", "moved"
    return result | {name: getattr(contact.shear, name).copy() for name in names}


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_environments_that_are_cleared_forget_everything_and_the_others_nothing(device: str) -> None:
    wp.init()
    contact = gel_contact(random_state(7, 12), device)
    results(contact)
    was = left_by(contact)
    contact.clear([2, 5])
    assert all(values[[2, 5]].any() for values in was.values())
    for name, values in left_by(contact).items():
        fresh = np.full_like(values[[2, 5]], np.nan if name == "before" else 0.0)
        np.testing.assert_array_equal(values[[2, 5]], fresh, err_msg=name)
        others = np.delete(np.arange(12), [2, 5])
        np.testing.assert_array_equal(values[others], was[name][others], err_msg=name)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_environments_are_chosen_in_any_order_or_in_place(device: str) -> None:
    wp.init()
    contact = gel_contact(random_state(7, 4), device)
    contact.choose(np.array([3, 1]), np.array([8, 4]))
    assert contact.steps.envs.numpy().tolist() == [3, 1, -1, -1] and contact.chosen == [3, 1]
    assert contact.steps.done.numpy()[:2].tolist() == [8, 4]
    contact.choose_active(wp.array([True, False, False, True], dtype=wp.bool, device=device))
    assert contact.steps.envs.numpy().tolist() == [0, -1, -1, 3] and not contact.steps.done.numpy().any()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_numbers_of_environments_may_change(device: str) -> None:
    """Softer gels carry less, in their environments alone, once ``vary`` has taken them over."""
    wp.init()
    state = random_state(7, 4)
    contact, plain = gel_contact(state, device), results(gel_contact(state, device))
    state.numbers["gel_stiffness"][2] *= 0.5
    contact.vary()
    changed = results(contact)["force"]
    assert (changed[2] != plain["force"][2]).any()
    np.testing.assert_array_equal(np.delete(changed, 2, axis=0), np.delete(plain["force"], 2, axis=0))


def test_views_of_the_host_are_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    contact = gel_contact(random_state(7, 1))
    monkeypatch.setattr(contact, "device", SimpleNamespace(is_cpu=False))
    with pytest.raises(InputError, match="must be the CPU"):
        HostViews(contact)


@pytest.mark.gpu
def test_cuda_gives_what_the_cpu_gives() -> None:
    wp.init()
    state = random_state(8)
    one, other = results(gel_contact(state)), results(gel_contact(state, "cuda"))
    np.testing.assert_array_equal(one["held"], other["held"])
    # A node on an edge between two triangles may see either, so that a mesh is now and then measured on another grid.
    off = np.zeros(one["held"].shape, bool)
    for name in ("place", "friction", "force", "regularisation"):
        off |= (np.abs(other[name] - one[name]) > 1e-6 * np.abs(one[name]) + 1e-12).any(axis=-1)
    assert off.mean() < 0.005
    sound = ~off.any(axis=(1, 2))
    for name, values in one.items():
        if name != "held":
            same(other[name][sound], values[sound], 1e-6)


def test_what_a_bonded_face_refuses_is_suspected() -> None:
    """No body beyond a face, or that went through one since the last step, escapes; what lies off the pads is not looked at."""
    state = random_state(3, 60)
    rng = np.random.default_rng(3)
    state.frames["place"][:, 1] = [0.0, 0.0, 0.5]
    state.frames["place"][:, PADS:] = rng.uniform([-0.02, -0.02, -0.02], [0.02, 0.02, 0.01], (60, COUNT, 3))
    contact, faces = gel_contact(state), BondedFaces(GELS, SHAPES)
    views = HostViews(contact)
    contact.move()
    poses = views.poses.copy()
    pierced = faces.pierced(poses)
    assert pierced.sum() > 20 and not (pierced & (views.suspect == 0)).any()
    assert (views.suspect[:, 0] == 0).mean() > 0.1 and (views.suspect[:, 1, [0, 1, 3]] == 0).all()
    # From above the gel to below the case: neither end is beyond the face.
    state = taken(state, np.arange(3))
    state.frames["place"][:, PADS:] = [0.0, 0.0, -0.1]
    contact = gel_contact(state)
    views = HostViews(contact)
    above = np.tile(np.eye(4), (3, PADS, COUNT, 1, 1))
    above[..., 2, 3] = 0.05
    views.before[:] = above
    contact.move()
    some = views.suspect != 0
    np.testing.assert_array_equal(views.poses_before, above)
    np.testing.assert_array_equal(views.before, views.poses)
    assert some[:, 0].all() and faces.pierced_on_path(views.poses, above, some)[:, 0].all()
    assert (views.lost != 0).all()
