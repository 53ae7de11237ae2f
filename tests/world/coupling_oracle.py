"""The coupling law of one environment in NumPy, with MuJoCo's own Jacobians and factors of the inertia."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from tests.world.coupled import Contact


def shifted_wrench(wrench: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Wrenches (…, 6) about another point; ``arm`` (…, 3) [m] goes from it to the old one."""
    return np.concatenate([wrench[..., :3], wrench[..., 3:] + np.cross(arm, wrench[..., :3])], axis=-1)


def first_step(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: Sequence[int],
    wrench: np.ndarray,
    contacts: Sequence[Contact],
    partners: Sequence[Mapping[str, np.ndarray]],
) -> np.ndarray:
    """``xfrc_applied`` (n, 6) of the coupled bodies in the first step of an interval, where Δ = 0.

    ``data``: after ``mj_step1`` and the controls; it is changed.
    """
    h, arm = model.opt.timestep, data.xpos[list(bodies)] - data.xipos[list(bodies)]
    data.xfrc_applied[list(bodies)] = shifted_wrench(wrench, arm)
    mujoco.mj_fwdActuation(model, data)
    mujoco.mj_fwdAcceleration(model, data)
    free = data.qvel + h * data.qacc_smooth
    masses = []
    for one in partners:
        matrix = np.zeros((6, 6))
        matrix[:3, :3], matrix[3:, 3:] = one["mass"] * np.eye(3), one["inertia"]
        masses.append(matrix)
    velocities = [
        np.concatenate([one["velocity"], one["spin"]]) + h * np.linalg.solve(mass, np.concatenate([one["force"], one["torque"]]))
        for one, mass in zip(partners, masses, strict=True)
    ]
    rows, stiffness = [], np.zeros((6 * len(contacts),) * 2)
    for k, contact in enumerate(contacts):
        robot, others = np.zeros((6, model.nv)), np.zeros((6, 6 * len(partners)))
        for side, sign in ((contact.side, 1.0), (contact.other, -1.0)):
            if side >= 0:
                of_point = np.zeros((6, model.nv))
                mujoco.mj_jac(model, data, of_point[:3], of_point[3:], contact.place, bodies[side])
                robot += sign * of_point
            elif side < -1:
                x, y, z = contact.place - partners[-2 - side]["centre"]
                of_point = np.eye(6)
                of_point[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
                others[:, 6 * (-2 - side) : 6 * (-2 - side) + 6] += sign * of_point
        rows.append((robot, others))
        stiffness[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = contact.stiffness
    robot, others = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    mobility, relative = robot @ np.linalg.solve(full, robot.T), robot @ free
    for i, mass in enumerate(masses):
        block = others[:, 6 * i : 6 * i + 6]
        mobility += block @ np.linalg.solve(mass, block.T)
        relative += block @ velocities[i]
    closed, fixed = np.ones(len(contacts), bool), np.zeros(6 * len(contacts))
    while True:
        stiff = stiffness * np.repeat(closed, 6)[:, None]
        c = np.linalg.solve(np.eye(len(fixed)) + h * h * stiff @ mobility, fixed - h * stiff @ relative)
        pulls = [
            k
            for k, one in enumerate(contacts)
            if closed[k] and one.normal is not None and (c[6 * k : 6 * k + 3] + one.normal) @ one.normal < 0.0
        ]
        if not pulls:
            break
        for k in pulls:
            closed[k] = False
            fixed[6 * k : 6 * k + 6] = -np.asarray(contacts[k].wrench)
    total = np.array(wrench, float)
    for k, contact in enumerate(contacts):
        for side, sign in ((contact.side, 1.0), (contact.other, -1.0)):
            if side >= 0:
                total[side] += sign * shifted_wrench(c[6 * k : 6 * k + 6], contact.place - data.xpos[bodies[side]])
    return shifted_wrench(total, arm)
