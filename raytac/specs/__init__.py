"""Sensors, lights and press scenes as data: dataclasses in SI units, and the only readers of TOML in the package."""

from __future__ import annotations

from raytac.specs.files import available
from raytac.specs.marker_motion import MarkerMotionSpec, PunchSpec, load_marker_motion
from raytac.specs.mesh import load_mesh
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.press_file import load_press, validate_press
from raytac.specs.scene_file import load_scene
from raytac.specs.sensor import (
    CameraSpec,
    CaseSpec,
    CoatSpec,
    GelpadSpec,
    LedSpec,
    LightsSpec,
    MarkerSpec,
    RefractionSpec,
    ResponseSpec,
    SensorSpec,
)
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.sensor_file import load_lights, load_sensor, with_lights
from raytac.specs.sweep import PressRanges, SweepSpec
from raytac.specs.sweep_file import load_sweep
from raytac.specs.task import BodySpec, MountSpec, RobotSpec, TaskScene
from raytac.specs.task_file import load_task

__all__ = [
    "BodySpec",
    "CameraSpec",
    "CaseSpec",
    "CoatSpec",
    "GelpadSpec",
    "LedSpec",
    "LightsSpec",
    "MarkerMotionSpec",
    "MarkerSpec",
    "MountSpec",
    "ObjectSpec",
    "PressRanges",
    "PressScene",
    "PunchSpec",
    "RefractionSpec",
    "ResponseSpec",
    "RobotSpec",
    "SensorSpec",
    "StageSpec",
    "SweepSpec",
    "TaskScene",
    "available",
    "load_lights",
    "load_marker_motion",
    "load_mesh",
    "load_press",
    "load_scene",
    "load_sensor",
    "load_sweep",
    "load_task",
    "validate_press",
    "validate_sensor",
    "with_lights",
]
