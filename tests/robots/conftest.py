"""The Franka Panda by its published tables, computed without MuJoCo."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from raytac.robots.arm import Arm
from raytac.robots.mount import RobotModel
from raytac.robots.panda import READY, one_sensor_panda, two_finger_panda

DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)
"""a_{i−1} [m], d_i [m], α_{i−1} [rad]: Franka Control Interface documentation, Denavit-Hartenberg parameters (Craig's convention)."""
FLANGE = 0.107
LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
LINKS = (
    (4.970684, (0.003875, 0.002081, -0.04762)),
    (0.646926, (-0.003141, -0.02872, 0.003495)),
    (3.228604, (0.027518, 0.039252, -0.066502)),
    (3.587895, (-0.05317, 0.104419, 0.027454)),
    (1.225946, (-0.011953, 0.041065, -0.038437)),
    (1.666555, (0.060149, -0.014117, -0.010517)),
    (0.735522, (0.010517, -0.004252, 0.061597)),
)
"""Mass [kg] and centre of mass [m] of links 1 to 7: Gaz et al. 2019, as franka_ros publishes them."""
BASE_MASS = 0.629769

# What a real Panda with its hand reported at rest ("Getting started" of the Franka Control Interface documentation, echo_robot_state).
REAL_Q = np.array([0.0167305, -0.762614, -0.0207622, -2.34352, -0.0305686, 1.53975, 0.753872])
REAL_TCP = np.array(
    [
        [0.998578, 0.0335224, -0.04122, 0.305468],
        [0.0328747, -0.999317, -0.016294, -0.00814133],
        [-0.0417381, 0.0149157, -0.999017, 0.483198],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
REAL_TORQUE = np.array([-0.00359774, -5.08582, 0.105732, 21.8135, 0.63253, 2.18121, -0.0481953])


def link_poses(q: np.ndarray) -> list[np.ndarray]:
    """world_from_link (4, 4) of links 1 to 7: Rot_x(α) Trans_x(a) Rot_z(θ) Trans_z(d), Craig's equation 3.6."""
    poses, pose = [], np.eye(4)
    for (a, d, alpha), theta in zip(DH, q, strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])
        poses.append(pose)
    return poses


def flange_pose(q: np.ndarray) -> np.ndarray:
    shift = np.eye(4)
    shift[2, 3] = FLANGE
    return link_poses(q)[-1] @ shift


def potential_energy(q: np.ndarray, gravity: float) -> float:
    """Of links 1 to 7 [J]."""
    return sum(mass * gravity * (pose @ np.array([*com, 1.0]))[2] for pose, (mass, com) in zip(link_poses(q), LINKS, strict=True))


class Rig:
    """A robot, compiled, at rest in the ready position."""

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot
        self.model = robot.spec.compile()
        self.data = mujoco.MjData(self.model)
        self.arm = Arm(self.model, robot.site, robot.joints)
        self.place(np.array(READY))

    def place(self, joints: np.ndarray) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self.arm.qpos] = joints
        mujoco.mj_forward(self.model, self.data)

    def run(self, steps: int, law) -> None:
        """``law()`` gives the torques (n,) of each step."""
        for _ in range(steps):
            mujoco.mj_step1(self.model, self.data)
            self.arm.drive(self.data, law())
            mujoco.mj_step2(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)


@pytest.fixture
def one() -> Rig:
    return Rig(one_sensor_panda())


@pytest.fixture
def two() -> Rig:
    return Rig(two_finger_panda())
