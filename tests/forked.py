"""Scripts in processes of their own that begin with the packages imported, as forks of one that has imported them.

Of a short script most of the time is its imports. Whatever is about them, the environment of an interpreter's start, threads or signals
needs a new interpreter instead. The renderer is not among what is imported, since it starts a thread, and a fork has none.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from tests.one_thread import ONE_THREAD

ROOT = Path(__file__).parents[1]
IMPORTED = (
    "numpy",
    "scipy.ndimage",
    "scipy.optimize",
    "matplotlib.figure",
    "matplotlib.backends.backend_agg",
    "PIL.PngImagePlugin",
    "OpenEXR",
    "mujoco",
    "trimesh",
    "tyro",
    "tqdm.auto",
    "warp",
    "gymnasium",
    "raytac.cli",
    "raytac.sensor.tactile_sensor",
    "raytac.physics.rigid.pad",
    "raytac.physics.soft.pad",
    "raytac.report.preview",
    "raytac.markers.tracker",
    "raytac.world.world",
    "raytac.world.rigid_pads",
    "raytac.world.tactile_reader",
    "raytac.observe.observer",
)
"""Modules that several scripts import; those of absent extras are left out."""
_ENVIRONMENT = set(os.environ)


def run_forked(*command: str, cwd: Path, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``python *command``: a script or ``-m MODULE``, and arguments.

    ``env`` is added to the environment, in which PYTHONPATH, if the caller has none, is this checkout. The case's light is fitted with few
    paths and figures are saved with few dots, as in most tests. Raises RuntimeError if the process that is forked has ended.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [os.path.join(folder, name) for name in ("stdout", "stderr")]
        request = {
            "command": command,
            "cwd": str(cwd),
            "env": {"PYTHONPATH": str(ROOT), **os.environ, **(env or {})},
            "files": files,
        }
        server = _server()
        try:
            code = _ask(server, request)
        except BaseException:  # a timeout or Ctrl-C: the script may still run, and its answer would be taken for the next one's
            with contextlib.suppress(ProcessLookupError):
                os.killpg(server.pid, signal.SIGKILL)
            server.wait()
            _server.cache_clear()
            raise
        said, errors = (Path(file).read_text(encoding="utf-8") for file in files)
    return subprocess.CompletedProcess(command, code, said, errors)


def _ask(server: subprocess.Popen[str], request: dict[str, Any]) -> int:
    assert server.stdin is not None and server.stdout is not None
    answer = ""
    with contextlib.suppress(BrokenPipeError):
        server.stdin.write(json.dumps(request) + "\n")
        server.stdin.flush()
        answer = server.stdout.readline()
    if not answer:
        raise RuntimeError(f"the process that is forked ended with exit code {server.wait()}; standard error says why")
    return int(answer)


@cache
def _server() -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "MPLBACKEND": "Agg", **ONE_THREAD}
    command = [sys.executable, "-m", "tests.forked"]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    server = subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **pipes)

    def end() -> None:
        assert server.stdin is not None and server.stdout is not None
        if server.poll() is None:
            server.stdin.close()  # it ends when it reads no more
            server.wait()
        server.stdout.close()

    atexit.register(end)
    return server


def _serve() -> dict[str, Any] | None:
    """Answer requests by the exit code of a fork; returns in each fork, with its request, and None at the end."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin.buffer:
        child = os.fork()
        if child == 0:
            return json.loads(line)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), file=answers, flush=True)
    return None


def _become(request: dict[str, Any]) -> None:
    """Be the process that a request asks for, up to its end."""
    for stream, path in zip((sys.stdout, sys.stderr), request["files"], strict=True):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream.fileno())
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(request["cwd"])
    for name in _ENVIRONMENT - request["env"].keys():  # not of those that imports have set
        del os.environ[name]
    os.environ.update(request["env"])
    from tests import case_lights, coarse_figures

    coarse_figures.limit()
    case_lights.always_few()
    first, *arguments = request["command"]
    if first == "-m":
        sys.argv = arguments
        sys.path.insert(0, "")
        runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
    else:
        sys.argv = [first, *arguments]
        sys.path.insert(0, str(Path(first).parent))
        runpy.run_path(first, run_name="__main__")


if __name__ == "__main__":
    gc.disable()
    for name in IMPORTED:
        try:
            importlib.import_module(name)
        except ImportError:
            traceback.print_exc()
    assert len(os.listdir("/proc/self/task")) == 1, "a fork would lack the other threads"
    gc.freeze()
    gc.enable()
    asked = _serve()
    if asked is not None:
        _become(asked)
