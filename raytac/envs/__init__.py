"""Gymnasium environments; importing this registers them: ``import raytac.envs; gymnasium.make("raytac/PushCube-v0")``."""

from __future__ import annotations

from raytac.envs.balance_pole import BalancePoleEnv, BalancePoleVectorEnv
from raytac.envs.environments import TactileEnv, TactileVectorEnv
from raytac.envs.lift_cube import LiftCubeEnv, LiftCubeVectorEnv
from raytac.envs.push_cube import PushCubeEnv, PushCubeVectorEnv
from raytac.envs.registration import IDS, register_envs
from raytac.envs.roll_ball import RollBallEnv, RollBallVectorEnv

__all__ = [
    "IDS",
    "BalancePoleEnv",
    "BalancePoleVectorEnv",
    "LiftCubeEnv",
    "LiftCubeVectorEnv",
    "PushCubeEnv",
    "PushCubeVectorEnv",
    "RollBallEnv",
    "RollBallVectorEnv",
    "TactileEnv",
    "TactileVectorEnv",
    "register_envs",
]

register_envs()
