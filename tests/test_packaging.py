"""What is shipped is found: from a checkout, from a wheel, and never another package's folder."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import raytac

ROOT = Path(__file__).parents[1]


def python(*args: str, cwd: Path, executable: str = sys.executable, **env: str) -> str:
    """Output of an isolated Python (no PYTHONPATH, no working directory on the path) that must succeed."""
    env = {"PATH": "/usr/bin:/bin", **env}
    done = subprocess.run([executable, *args], cwd=cwd, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    python("-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_holds_both_packages_and_the_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    top = {name.split("/")[0] for name in names}
    assert {"raytac", "ipc"} <= top and not {"tests", "experiments", "scenes", "lights", "runs"} & top
    for kind in ("scenes", "lights"):
        files = {path.relative_to(ROOT).as_posix() for path in (ROOT / kind).rglob("*") if path.is_file()}
        assert files and {f"raytac/_assets/{name}" for name in files} <= names
    policies = {f"raytac/learn/policies/{path.name}" for path in (ROOT / "raytac" / "learn" / "policies").glob("*.pt")}
    assert len(policies) >= 4 and policies <= names
    assert "ipc/__init__.py" in names and any(name.endswith("entry_points.txt") for name in names)


_OUTSIDE = """
import pathlib, sys
import raytac
from raytac.assets import asset_root
home = pathlib.Path(sys.argv[1]).resolve()
assert home in pathlib.Path(raytac.__file__).resolve().parents, raytac.__file__
assert home in asset_root("scenes").parents and home in asset_root("lights").parents
assert raytac.load_sensor("gelsight_mini").lights.leds and raytac.load_press("coin").trajectory
assert raytac.foreign_ipc() is None
"""


def test_unpacked_wheel_finds_its_data_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    python("-P", "-c", _OUTSIDE, str(site), cwd=elsewhere, PYTHONPATH=str(site))
    python("-P", "-m", "raytac", "press", "sphere", "--outputs", "height", cwd=elsewhere, PYTHONPATH=str(site))
    assert (elsewhere / "runs" / "press" / "sphere" / "height.npy").is_file()


@pytest.mark.slow
def test_installed_wheel_brings_its_command(wheel: Path, tmp_path: Path) -> None:
    home = tmp_path / "venv"
    venv.create(home, with_pip=True)
    inside = str(home / "bin" / "python")
    python("-m", "pip", "install", "--no-deps", "--no-index", str(wheel), cwd=tmp_path, executable=inside)
    (site,) = (home / "lib").glob("python*/site-packages")
    dependencies = next(p for p in sys.path if p.endswith("site-packages"))  # what --no-deps left out, last on the path
    (site / "dependencies.pth").write_text(dependencies + "\n")
    python("-P", "-c", _OUTSIDE, str(home), cwd=tmp_path, executable=inside)
    done = python("press", "sphere", "--outputs", "height", cwd=tmp_path, executable=str(home / "bin" / "raytac"))
    assert "height.npy" in done and (tmp_path / "runs" / "press" / "sphere" / "preview.png").is_file()


def test_a_foreign_ipc_is_told_and_not_run(tmp_path: Path) -> None:
    (tmp_path / "ipc.py").write_text("raise RuntimeError('another package was run')")
    code = "import sys; sys.path[:0] = sys.argv[1:]; import raytac; print(raytac.foreign_ipc())"
    command = [sys.executable, "-P", "-c", code, str(tmp_path), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "ipc.py") in done.stdout and "RuntimeWarning" in done.stderr and "soft pad" in done.stderr


def test_a_folder_of_that_name_without_init_is_told_too(tmp_path: Path) -> None:
    (tmp_path / "site" / "ipc").mkdir(parents=True)
    (tmp_path / "site" / "raytac").mkdir()
    module = (ROOT / "raytac" / "installation.py").read_text()
    (tmp_path / "site" / "raytac" / "__init__.py").write_text(module)
    code = "import raytac; print(raytac.foreign_ipc())"
    out = python("-P", "-S", "-W", "ignore", "-c", code, cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert str(tmp_path / "site" / "ipc") in out


def test_our_own_ipc_says_so() -> None:
    import ipc

    assert raytac.foreign_ipc() is None and ipc.RAYTAC_IPC_MARKER == "raytac-ipc"


def test_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert project["version"] == raytac.__version__
    assert f"version: {raytac.__version__}" in citation and f"## [{raytac.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
