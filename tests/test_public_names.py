"""Public names: each package lists them, they are imported when first used, and documents and scripts use no others."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import raytac
from raytac.errors import BackendError

ROOT = Path(__file__).parents[1]
PACKAGES = ["raytac", *(f"raytac.{module.name}" for module in pkgutil.iter_modules(raytac.__path__) if module.ispkg)]
ABSENT = ("rsl_rl", "stable_baselines3", "torch")
"""Packages that the extra of the tests does not install: names that need them say so when they are used."""
USERS = [
    ROOT / "README.md",
    *(path for folder in ("docs", "scenes", "lights") for path in sorted((ROOT / folder).rglob("*.md"))),
    *(path for folder in ("experiments", "examples") for path in sorted((ROOT / folder).rglob("*.py"))),
]
DEEP = re.compile(r"^\s*(?:from|import) (raytac\.\w+\.[\w.]+)", re.MULTILINE)


@pytest.mark.parametrize("name", [*PACKAGES, "ipc"])
def test_no_public_name_is_also_that_of_a_module_beside_it(name: str) -> None:
    """The first import of such a module would put it in the place of the name."""
    package = importlib.import_module(name)
    modules = {module.name for module in pkgutil.iter_modules(package.__path__) if not module.ispkg}
    assert not modules & set(package.__all__)


@pytest.mark.parametrize("name", PACKAGES)
@pytest.mark.renderer
@pytest.mark.solver
def test_every_public_name_can_be_imported(name: str) -> None:
    package = importlib.import_module(name)
    assert package.__all__
    for public in package.__all__:
        try:
            getattr(package, public)
        except BackendError as error:
            lacking = error.__cause__
            assert isinstance(lacking, ModuleNotFoundError) and lacking.name in ABSENT, f"{name}.{public}: {error}"
            assert public in str(error) and "pip install" in str(error)
    with pytest.raises(AttributeError, match="no_such_name"):
        getattr(package, "no_such_name")  # noqa: B009 (a type checker would refuse the attribute itself)


def test_importing_the_package_loads_no_part_of_it() -> None:
    code = "import sys, raytac; print(*sorted(m for m in sys.modules if m.startswith(('raytac.', 'numpy', 'mujoco', 'drjit', 'warp'))))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["raytac.installation"]


def keywords(function: Callable[..., object], *others: str) -> set[str]:
    """Names of the arguments that are given by keyword, but ``others``."""
    parameters = inspect.signature(function).parameters.values()
    return {one.name for one in parameters if one.kind is one.KEYWORD_ONLY} - set(others)


@pytest.mark.solver
def test_typed_keyword_arguments_are_those_that_are_passed_on() -> None:
    """Names that type checkers know for ``**own``, ``**settings`` and ``**options`` of public functions."""
    from raytac.envs.batch import TaskBatch, TaskOptions
    from raytac.physics.base import TargetArrays
    from raytac.physics.press import PressPad, PressSettings, PressTargets
    from raytac.sensor.options import EnvironmentTargets

    assert set(TargetArrays.__annotations__) == keywords(PressTargets)
    assert set(PressSettings.__annotations__) == keywords(PressPad) | keywords(PressTargets)
    assert set(EnvironmentTargets.__annotations__) == keywords(raytac.TactileSensor.load)
    assert set(TaskOptions.__annotations__) == keywords(TaskBatch, "num_envs")
    assert set(raytac.sensor.SensorSettings.__annotations__) == keywords(raytac.TactileSensor, "physics", "num_envs", "seed")
    for taker in (raytac.TactileSensor.press, raytac.PadStepper, raytac.TactileReader, raytac.envs.PushCubeEnv):
        (rest,) = (one for one in inspect.signature(taker).parameters.values() if one.kind is one.VAR_KEYWORD)
        assert str(rest.annotation).startswith("Unpack["), f"{taker}: {rest}"


@pytest.mark.parametrize("path", USERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documents_and_scripts_import_public_names_only(path: Path) -> None:
    assert DEEP.findall(path.read_text(encoding="utf-8")) == []


def test_a_deep_import_would_be_seen() -> None:
    assert DEEP.findall("    from raytac.gel.surface import GelSurface") == ["raytac.gel.surface"]
    assert not DEEP.findall("from raytac.gel import GelSurface\nimport raytac.gel")
