"""``raytac doctor``: try what the jobs need, and say what will be used and how to fix it.

Each trial is a process of its own. A library that aborts (LLVM 15 does, inside Dr.Jit, on some machines) takes its process down
before Python can say a word; here it takes down only its probe.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

from raytac.device import LLVM_NAMED_BY_USER, cuda_missing, library_missing, llvm_library
from raytac.installation import foreign_ipc
from raytac.io.metrics import versions

__all__ = ["PROBES", "Check", "Probe", "Report", "diagnose", "run_probe"]

_TRACE = """
import numpy as np
from raytac.optics.runtime import load_mitsuba
mi, device = load_mitsuba({device!r})
scene = mi.load_dict({{
    "type": "scene", "integrator": {{"type": "path", "max_depth": 3}},
    "light": {{"type": "constant"}}, "shape": {{"type": "sphere", "bsdf": {{"type": "roughconductor"}}}},
    "sensor": {{"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
               "film": {{"type": "hdrfilm", "width": 16, "height": 16}}}},
}})
image = np.array(mi.render(scene, spp=2))
assert np.isfinite(image).all() and image.max() > 0, "the picture is empty"
print("Mitsuba", mi.__version__, mi.variant(), "traced a picture")
"""

_MUJOCO = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><geom type='plane' size='1 1 1'/>"
    "<body pos='0 0 .2'><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
data = mujoco.MjData(model)
for _ in range(500):
    mujoco.mj_step(model, data)
assert 0.09 < data.qpos[2] < 0.11, f"a ball of radius 0.1 rests at height {data.qpos[2]}"
print("MuJoCo", mujoco.__version__, "dropped a ball and it came to rest")
"""

_EXR = """
import pathlib, tempfile
import numpy as np
from raytac.io.images import read_exr, write_exr
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "probe.exr"
    image = np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4)
    write_exr(path, {"Z": image})
    assert (read_exr(path)[0]["Z"] == image).all(), "what was read is not what was written"
import OpenEXR
print("OpenEXR", OpenEXR.__version__, "wrote and read an image")
"""

_ASSETS = """
from raytac.specs import load_press, load_sensor
from raytac.specs.files import available
for name in available("sensor"):
    load_sensor(name)
for name in available("press scene"):
    load_press(name)
print("sensors:", ", ".join(available("sensor")) + "; press scenes:", ", ".join(available("press scene")))
"""

_FIGURES = """
import io
import matplotlib, trimesh
from matplotlib.figure import Figure
Figure().savefig(io.BytesIO())
assert trimesh.creation.box().is_watertight
print("matplotlib", matplotlib.__version__, "drew a figure; trimesh", trimesh.__version__, "checked a mesh")
"""

_WARP = """
import warp as wp
from ipc import start_warp
start_warp()
print("Warp", wp.config.version, "on", ", ".join(str(device) for device in wp.get_devices()))
"""

_TETWILD = """
import importlib.metadata, pathlib, tempfile
import ipc
with tempfile.TemporaryDirectory() as cache:
    mesh = ipc.tetrahedralize(ipc.icosphere(1e-3, 1), 1e-3, pathlib.Path(cache))
print("pytetwild", importlib.metadata.version("pytetwild"), "filled a ball with", len(mesh.tets), "tetrahedra")
"""

_REPORT = """
import jinja2, pyarrow, skimage
from skimage.metrics import structural_similarity
from raytac.report.image_error import has_flip
print("jinja2", jinja2.__version__, "pyarrow", pyarrow.__version__, "scikit-image", skimage.__version__, "imported;",
      "FLIP is there" if has_flip() else "without flip-evaluator, so no FLIP column")
"""

_DENOISER = """
import numpy as np
from raytac.optics.trace.sampled_tracer import make_denoiser
from raytac.optics.runtime import load_mitsuba
mi, device = load_mitsuba()
grey = np.full((32, 32, 3), 0.5, np.float32)
assert abs(make_denoiser(mi, device, (32, 32))(grey) - grey).max() < 0.05, "a grey image does not stay grey"
print("OptiX" if device == "cuda" else "Open Image Denoise", "kept a grey image grey")
"""


@dataclass(frozen=True)
class Probe:
    """A small program that proves that one thing works: its last line of output says so."""

    name: str
    code: str
    required: bool
    """True if the default job cannot run without it."""
    fix: str
    """Advice that fixes it."""
    skip: Callable[[], str] = field(default=lambda: "")
    """Why there is nothing to try, or an empty text."""


@dataclass(frozen=True)
class Check:
    """Result of one probe."""

    name: str
    ok: bool
    required: bool
    detail: str
    fix: str
    """Empty if ``ok``."""


@dataclass(frozen=True)
class Report:
    device: str
    """Device of the default job: ``cuda``, ``cpu`` or ``none``."""
    checks: tuple[Check, ...]
    versions: dict[str, str]

    @property
    def ok(self) -> bool:
        """True if the default job can run."""
        return self.device != "none" and all(check.ok for check in self.checks if check.required)

    @property
    def exit_code(self) -> int:
        return 0 if self.ok else 1

    def to_json(self) -> str:
        return json.dumps({"ok": self.ok, **asdict(self)}, indent=1)

    def to_text(self) -> str:
        lines = []
        for check in self.checks:
            mark = "ok     " if check.ok else "MISSING" if check.required else "absent "
            lines.append(f"{mark}  {check.name:<16} {check.detail}")
            if check.fix:
                lines.append(f"{'':9}{'':<16} fix: {check.fix}")
        verdict = f"The default job will run on: {self.device}" if self.ok else "The default job cannot run; see MISSING above."
        if self.device == "none":
            verdict = "The default job cannot run: neither mitsuba-cuda nor mitsuba-llvm works; fixing one is enough."
        return "\n".join([*lines, "", verdict])


def _absent(needed_by: str, *packages: str) -> Callable[[], str]:
    def reason() -> str:
        missing = [name for name in packages if not importlib.util.find_spec(name)]
        lack = f" (without {', '.join(missing)})" if len(packages) > 1 else ""
        return f"not installed{lack}: only {needed_by}" if missing else ""

    return reason


def _no_denoiser() -> str:
    absent = bool(cuda_missing()) and not importlib.util.find_spec("mitsuba_oidn")
    return "not installed: only denoise=True needs it" if absent else ""


_VIEW = "import viser, websockets, msgspec; print('viser', viser.__version__)"
_GPU = "import mujoco_warp; print('mujoco-warp imported')"
_ENVS = "import gymnasium, mink; print('gymnasium', gymnasium.__version__)"

PROBES = (
    Probe("system", "print('libraries that Dr.Jit needs of the system are here')", True, "", library_missing),
    Probe(
        "mitsuba-cuda", _TRACE.format(device="cuda"), False,
        "needs an NVIDIA GPU and driver with OptiX (in a container: the 'graphics' driver capability); the CPU does without",
        cuda_missing,
    ),
    Probe(
        "mitsuba-llvm", _TRACE.format(device="cpu"), False,
        "pip install karellen-llvm-core, or set DRJIT_LIBLLVM_PATH to libLLVM 16 or newer (14 is refused, 15 may abort)",
        lambda: "" if llvm_library() else "no libLLVM found",
    ),
    Probe(
        "denoiser", _DENOISER, False,
        "CPU: pip install 'raytac[denoise]'; CUDA: the driver's nvoptix.bin in /usr/share/nvidia (containers often lack it)",
        _no_denoiser,
    ),
    Probe(
        "mujoco", _MUJOCO, True,
        "pip install 'mujoco>=4.0,<5'; where MUJOCO_GL is set, unset it or install what it names (egl: libEGL, osmesa: libOSMesa)",
    ),
    Probe("exr", _EXR, True, "pip install 'OpenEXR>=3.3,<4'"),
    Probe("assets", _ASSETS, True, "reinstall raytac, or run it from a complete checkout"),
    Probe("figures, meshes", _FIGURES, True, "pip install matplotlib trimesh"),
    Probe("warp", _WARP, True, "pip install 'warp-lang>=1.19,<2'"),
    Probe(
        "pytetwild", _TETWILD, False, "pip install 'raytac[ipc]'",
        _absent("soft objects on the soft pad need it", "pytetwild", "pyvista"),
    ),
    Probe(
        "report", _REPORT, False, "pip install 'raytac[report]'",
        _absent("raytac compare needs it", "jinja2", "pyarrow", "skimage"),
    ),
    Probe(
        "view", _VIEW, False, "pip install 'raytac[view]'",
        _absent("raytac view needs it", "viser", "websockets", "msgspec"),
    ),
    Probe(
        "mujoco-warp", _GPU, False, "pip install 'raytac[gpu]'",
        _absent("worlds on MuJoCo Warp, thousands on one GPU, need it", "mujoco_warp"),
    ),
    Probe(
        "envs", _ENVS, False, "pip install 'raytac[envs]'",
        _absent("raytac.envs, raytac play and AddTactile need it", "gymnasium", "mink"),
    ),
)  # fmt: skip


def diagnose(probes: Sequence[Probe] = PROBES, *, timeout: float = 180.0) -> Report:
    """Run every probe, and decide what the default job will use."""
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        checks = list(pool.map(lambda probe: run_probe(probe, timeout=timeout), probes))
    works = {check.name for check in checks if check.ok}
    device = "cuda" if "mitsuba-cuda" in works else "cpu" if "mitsuba-llvm" in works else "none"
    return Report(device, (*checks, _check_ipc()), {k.removeprefix("versions."): v for k, v in versions().items()})


def run_probe(probe: Probe, *, timeout: float = 180.0) -> Check:
    """Run one probe in its own process; an abort, crash or hang is a result, not an error."""
    if reason := probe.skip():
        return Check(probe.name, False, probe.required, reason, probe.fix)
    package_parent = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join(part for part in (package_parent, os.environ.get("PYTHONPATH", "")) if part)
    start = time.perf_counter()
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-c", probe.code],
            capture_output=True, text=True, timeout=timeout, check=False, env=os.environ | {"PYTHONPATH": path},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Check(probe.name, False, probe.required, f"gave no answer within {timeout:.0f} s", probe.fix)
    seconds = time.perf_counter() - start
    if done.returncode == 0:
        detail = f"{_last_line(done.stdout)} ({seconds:.1f} s){_library_used(probe)}"
        return Check(probe.name, True, probe.required, detail, "")
    detail = f"{_how_it_ended(done.returncode)}: {_last_line(done.stderr) or 'no message'}{_library_used(probe)}"
    return Check(probe.name, False, probe.required, detail, probe.fix)


def _library_used(probe: Probe) -> str:
    if probe.name != "mitsuba-llvm":
        return ""
    chosen = "set by DRJIT_LIBLLVM_PATH" if LLVM_NAMED_BY_USER else "found"
    return f"; LLVM {chosen}: {llvm_library()}"


def _how_it_ended(code: int) -> str:
    if code >= 0:
        return "failed"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""


def _check_ipc() -> Check:
    where = foreign_ipc()
    if where is None:
        return Check("ipc", True, False, "the package of that name is raytac's own", "")
    fix = "uninstall the other package, or put raytac first on the path; only the soft pad needs it"
    return Check("ipc", False, False, f"another package answers to that name: {where}", fix)
