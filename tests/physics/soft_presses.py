"""Presses into the soft pad that several test files make."""

from __future__ import annotations

from dataclasses import replace

from raytac.physics.soft.pad import SoftPad
from raytac.specs import load_sensor
from raytac.specs.press import ObjectSpec, PressScene, StageSpec

SENSOR = load_sensor("gelsight_mini")
IDENTITY = (1.0, 0.0, 0.0, 0.0)
RADIUS = 4e-3
PITCH = 0.2e-3
FRICTIONLESS = replace(SENSOR, gelpad=replace(SENSOR.gelpad, friction=0.0))


def press(*stages, kind="sphere", position=(0.0, 0.0), moves="object", radius=RADIUS, **settings):
    params = {"sphere": {"radius": radius}, "cylinder": {"radius": 3e-3, "length": 4e-3}, "none": {}}[kind]
    return PressScene("test", ObjectSpec(kind, params, (*position, 0.0), IDENTITY, 0.05, **settings), stages, moves)


def indent(depth=None, force=None):
    return StageSpec("indent", depth=depth, force=force)


def soft(scene, sensor=SENSOR, **settings):
    return SoftPad(sensor, scene, pitch=PITCH, **settings)


def uncorrected(scene, sensor=SENSOR, **settings):
    """For what is said of forces and depths: the correction of the shown surface, which changes neither, is left out."""
    return soft(scene, sensor, correction=None, **settings)
