"""The coupling law's kernels against NumPy and MuJoCo's own Jacobians, and a batch against single environments."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.world import coupling_kernels
from raytac.world.c_coupling import CCoupling
from tests.world.coupled import Contact, set_interval
from tests.world.coupling_oracle import first_step

ARM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="upper" pos="0 0 .5"><joint axis="0 1 0"
 damping=".3"/><joint axis="0 0 1" pos="0 .02 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/><body name="lower" pos=".2 0 0">
<joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 .1" size=".015"/><body name="finger" pos=".1 0 .1" euler="20 30 0">
<joint type="slide" axis="1 0 0"/><geom type="box" size=".01 .02 .01" pos="0 .01 0"/></body></body></body>
<body name="ball" pos=".3 .1 .6"><freejoint/><geom type="ellipsoid" size=".02 .03 .01"/></body></worldbody></mujoco>"""
NAMES = ("finger", "ball", "lower")
FIELDS = {"contacts": coupling_kernels.Contacts.vars, "solver_bodies": coupling_kernels.SolverBodies.vars}
MIDDLE = np.array([0.3, 0.0, 0.6])
"""About where the contacts are [m]."""


def moving(seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """An arm and a free body somewhere, moving."""
    model, rng = mujoco.MjModel.from_xml_string(ARM), np.random.default_rng(seed)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(0.0, 0.3, model.nv), 1.0)
    data.qvel[:] = rng.normal(0.0, 0.5, model.nv)
    mujoco.mj_forward(model, data)
    return model, data


def drawn(seed: int) -> tuple[np.ndarray, list[Contact], list[dict[str, np.ndarray]]]:
    """Wrenches, five contacts of all kinds, some of which open, and two bodies of the solver."""
    rng, contacts = np.random.default_rng(seed), []
    for side, other in ((0, -1), (0, 1), (1, -2), (2, -3), (-2, -1)):
        root = rng.normal(0.0, 1.0, (6, 6)) * np.array([40.0] * 3 + [0.5] * 3)
        wrench = rng.normal(0.0, 1.0, 6) * np.array([1.0] * 3 + [0.01] * 3)
        opens = (side, other) != (2, -3)
        normal = wrench[:3] + rng.normal(0.0, 0.1, 3) if opens else None
        place = rng.normal(0.0, 0.05, 3) + MIDDLE
        contacts.append(Contact(side, root.T @ root, place, other, normal, wrench if opens else None))
    partners = []
    for _ in range(2):
        root = rng.normal(0.0, 1e-3, (3, 3))
        values = {"mass": np.array(rng.uniform(0.02, 0.3)), "inertia": root.T @ root + 1e-6 * np.eye(3)}
        for name, size in (("velocity", 0.2), ("spin", 2.0), ("force", 1.0), ("torque", 0.01)):
            values[name] = rng.normal(0.0, size, 3)
        partners.append(values | {"centre": rng.normal(0.0, 0.02, 3) + MIDDLE})
    return rng.normal(0.0, 1.0, (3, 6)) * np.array([1.0] * 3 + [0.01] * 3), contacts, partners


@pytest.mark.parametrize("seed", range(6))
def test_the_law_is_that_of_mujocos_jacobians(seed: int) -> None:
    model, data = moving(seed)
    bodies, (wrench, contacts, partners) = [int(model.body(name).id) for name in NAMES], drawn(seed)
    coupling = CCoupling([model], [data], bodies, contacts=len(contacts), solver_bodies=len(partners))
    set_interval(coupling, wrench, contacts, partners)
    other = mujoco.MjData(model)
    mujoco.mj_copyData(other, model, data)
    for one in (data, other):
        mujoco.mj_step1(model, one)
    coupling.apply([0])
    wanted = first_step(model, other, bodies, wrench, contacts, partners)
    np.testing.assert_allclose(data.xfrc_applied[bodies], wanted, rtol=1e-7, atol=1e-9)
    held = data.xfrc_applied[bodies] - wrench
    assert np.abs(held).max() > 0.1  # contacts count


def test_a_batch_is_its_environments_and_others_are_left_alone() -> None:
    """Three environments at once against one after the other, over ten steps; the one that is not stepped keeps its forces."""
    seeds, steps = (3, 4, 5), 10
    states = [moving(seed) for seed in seeds]
    models, datas = [model for model, _ in states], [data for _, data in states]
    bodies = [int(models[0].body(name).id) for name in NAMES]
    batch = CCoupling(models, datas, bodies, contacts=5, solver_bodies=2)
    singles = []
    for b, seed in enumerate(seeds):
        model, data = moving(seed)
        single = CCoupling([model], [data], bodies, contacts=5, solver_bodies=2)
        set_interval(single, *drawn(seed))
        singles.append((model, data, single))
        for group in ("contacts", "solver_bodies"):
            ours, theirs = getattr(batch.law, group), getattr(single.law, group)
            for name in FIELDS[group]:
                getattr(ours, name).numpy()[b] = getattr(theirs, name).numpy()[0]
        batch.law.wrench.numpy()[b] = single.law.wrench.numpy()[0]
    batch.update([0, 1, 2])
    stepped = [0, 2]
    for _ in range(steps):
        for b in stepped:
            mujoco.mj_step1(models[b], datas[b])
            mujoco.mj_step1(*singles[b][:2])
        batch.apply(stepped)
        for b in stepped:
            singles[b][2].apply([0])
            np.testing.assert_array_equal(datas[b].xfrc_applied, singles[b][1].xfrc_applied)
            mujoco.mj_step2(models[b], datas[b])
            mujoco.mj_step2(*singles[b][:2])
    assert not datas[1].xfrc_applied.any() and np.abs(datas[0].xfrc_applied).max() > 0.1
    batch.reset([0])
    assert not datas[0].xfrc_applied.any() and datas[2].xfrc_applied.any()
