"""Marks by place: which tests need a renderer or a solver, and which run scripts. ``make check`` runs the others.

The solver is Warp, which sensors, markers and worlds with rigid pads import too.

A name is a folder of ``tests`` or a file in it; single tests carry the mark themselves. With ``-m "not renderer"`` the packages of the
renderer cannot be imported, with ``-m "not solver"`` those of the solver: a test that needs them and does not say so fails, and names them.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

PLACES: dict[str, tuple[str, ...]] = {
    "renderer": (
        "calibrate",
        "dataset/test_command.py",
        "dataset/test_renderer.py",
        "envs/test_rsl_warp.py",
        "envs/test_warp_variation.py",
        "io/test_code_digest.py",
        "markers/test_calibration.py",
        "markers/test_dots.py",
        "markers/test_fots.py",
        "markers/test_fots_punch.py",
        "markers/test_own_model.py",
        "markers/test_sensor.py",
        "observe/test_depth_images.py",
        "observe/test_device_images.py",
        "observe/test_ros.py",
        "observe/test_wrapper.py",
        "optics",
        "regression",
        "report/test_compare.py",
        "report/test_marker_error.py",
        "report/test_pads.py",
        "report/test_press_sheet.py",
        "report/test_real.py",
        "report/test_tracers.py",
        "robots/test_looks.py",  # MuJoCo's own pictures
        "robots/test_picture.py",
        "specs/test_press_of.py",
        "test_bake_end_to_end.py",
        "test_pad_surface.py",
        "test_cli.py",
        "test_doctor.py",
        "test_press_end_to_end.py",
        "test_render.py",
        "test_shipped_sensors.py",
        "test_show.py",
        "view/test_view_command.py",
        "world/test_scene_camera.py",
    ),
    "solver": (
        "calibrate/test_gel_forces.py",
        "dataset",
        "envs",
        "ipc",
        "markers",
        "observe/test_depth_images.py",
        "observe/test_device_images.py",
        "observe/test_observer.py",
        "observe/test_ros.py",
        "gel/test_elastic_surround.py",
        "gel/test_pyramid.py",
        "learn",
        "physics/rigid/test_load_law.py",
        "physics/rigid/test_pad_search.py",
        "physics/rigid/test_pierced.py",
        "physics/rigid/test_step_kernels.py",
        "physics/rigid/test_pressed_gel.py",
        "physics/soft/correction",
        "physics/soft/test_coat_surface.py",
        "physics/soft/test_reading.py",
        "physics/test_geoms.py",
        "physics/test_rigid.py",
        "physics/test_rigid_deep.py",
        "physics/test_soft.py",
        "physics/test_soft_batch.py",
        "physics/test_soft_forces.py",
        "physics/test_soft_locking.py",
        "physics/test_soft_objects.py",
        "physics/test_soft_scene.py",
        "physics/test_soft_sleep.py",
        "regression",
        "report/test_compare_metrics.py",
        "report/test_equal_error.py",
        "report/test_pads.py",
        "report/test_press.py",
        "report/test_press_store.py",
        "report/test_preview.py",
        "robots",
        "test_shipped_sensors.py",
        "test_arguments.py",
        "test_device.py",
        "test_fuzz_inputs.py",
        "test_pad_surface.py",
        "test_render.py",
        "test_show.py",
        "test_sensor.py",
        "test_sensor_soft.py",
        "test_threads.py",
        "test_warp_runtime.py",
        "test_warp_messages.py",
        "view/test_drawing.py",
        "view/test_played.py",
        "view/test_press_session.py",
        "view/test_world_session.py",
        "world",
    ),
    "script": (
        "dataset/test_command.py",
        "dataset/test_ray_cluster.py",
        "envs/test_rsl.py",
        "envs/test_sb3.py",
        "documents/test_imports.py",
        "documents/test_python_blocks.py",
        "examples",
        "experiments",
        "learn",
        "test_forked.py",
        "test_packaging.py",
        "view/test_browser.py",
        "view/test_guard.py",
        "view/test_page.py",
    ),
}
PACKAGES = {"renderer": ("mitsuba", "drjit"), "solver": ("warp",)}


@cache
def marks_of(path: Path) -> list[str]:
    """Marks of all tests of a file."""
    try:
        place = path.relative_to(Path(__file__).parent).as_posix()
    except ValueError:
        return []
    return [mark for mark, places in PLACES.items() if any(place == name or place.startswith(f"{name}/") for name in places)]


def is_deselected(mark: str, expression: str) -> bool:
    """Whether ``-m expression`` leaves out what has this mark alone."""
    if mark not in expression:
        return False
    return not eval(expression, {"__builtins__": {}}, defaultdict(bool, {mark: True}))


class Blocked(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Import hook in whose presence some packages cannot be imported; they can still be found, as if installed."""

    def __init__(self, packages: dict[str, str]) -> None:
        """``packages``: mark that a test which imports a package must have."""
        self.packages = packages

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.machinery.ModuleSpec(fullname, self) if fullname in self.packages else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        mark = self.packages[spec.name]
        pytest.fail(
            f"imports {spec.name} without the mark '{mark}': give it to the test, or to its file or folder in tests/marks.py"
        )

    def exec_module(self, module: ModuleType) -> None:
        raise NotImplementedError


def block(expression: str) -> Blocked | None:
    """Block what the tests selected by ``-m expression`` must not import."""
    packages = {package: mark for mark, names in PACKAGES.items() if is_deselected(mark, expression) for package in names}
    if not packages:
        return None
    blocked = Blocked(packages)
    sys.meta_path.insert(0, blocked)
    return blocked
