"""Devices and the LLVM library of Dr.Jit's CPU code; imports no Mitsuba, Dr.Jit or Warp."""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import os
import re
import sys
from pathlib import Path

from raytac.errors import BackendError, InputError

__all__ = [
    "DEVICES",
    "cpu_cores",
    "cuda_device_count",
    "cuda_driver_version",
    "cuda_missing",
    "library_missing",
    "llvm_library",
    "optix_library",
    "resolve_device",
    "total_memory",
]

DEVICES = ("auto", "cpu", "cuda")
"""Names that every ``device`` option accepts."""

CUDA_MINIMUM = (12, 2)
"""Oldest CUDA that Dr.Jit 1.5 takes; below, it silently switches its CUDA backend off."""
CUDA_REFUSED = (12, 7)
"""CUDA whose OptiX Dr.Jit 1.5 refuses."""
LLVM_NAMED_BY_USER = bool(os.environ.get("DRJIT_LIBLLVM_PATH"))
"""True if the environment named a libLLVM at the start; else ``raytac.optics`` names one."""
LLVM_MINIMUM = 16
"""Oldest LLVM looked for: Dr.Jit 1.5 refuses 14, and 15 was seen to abort the process."""


def resolve_device(device: str = "auto", *, ray_tracing: bool = True) -> str:
    """Return ``"cuda"`` or ``"cpu"`` for a ``device`` option.

    ``"auto"`` is CUDA when a device answers (and, for ``ray_tracing``, the driver brings OptiX and is new enough), else the CPU. This
    loads the driver and runs nothing on it; the ray tracer traces a ray before it commits itself (``raytac.optics.runtime``).

    Raises:
        InputError: ``device`` is not one of ``DEVICES``.
        BackendError: ``"cuda"`` was asked for and does not work here.
    """
    if not isinstance(device, str) or device not in DEVICES:
        raise InputError("device", value=device, rule="must be a known device", choices=DEVICES)
    if device == "cpu":
        return "cpu"
    missing = cuda_missing(ray_tracing)
    if not missing:
        return "cuda"
    if device == "cuda":
        raise BackendError(f"device 'cuda' does not work here: {missing}; use 'cpu' or 'auto' (`raytac doctor` tells more)")
    return "cpu"


def cuda_missing(ray_tracing: bool = True) -> str:
    """Reason why CUDA cannot work here; empty if it should. Runs nothing on a device."""
    if cuda_device_count() == 0:
        return "no NVIDIA driver, or no CUDA device that this process may see"
    if not ray_tracing:
        return ""
    if optix_library() is None:
        return "the NVIDIA driver brings no OptiX (libnvoptix.so.1; in a container ask for the 'graphics' capability)"
    version = cuda_driver_version()
    if version < CUDA_MINIMUM:
        present, least = (".".join(map(str, v)) for v in (version, CUDA_MINIMUM))
        return f"the NVIDIA driver speaks CUDA {present}, and Dr.Jit needs {least} (driver R535 or newer)"
    if version == CUDA_REFUSED:
        return "the NVIDIA driver speaks CUDA 12.7 (R565), whose OptiX Dr.Jit refuses as prone to miscompile; older and newer ones work"
    return ""


@functools.cache
def cuda_device_count() -> int:
    """Number of CUDA devices that the driver shows this process; creates no CUDA context."""
    driver = _load(("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so"))
    if driver is None or driver.cuInit(0) != 0:
        return 0
    count = ctypes.c_int(0)
    return count.value if driver.cuDeviceGetCount(ctypes.byref(count)) == 0 else 0


@functools.cache
def cuda_driver_version() -> tuple[int, int]:
    """Newest CUDA (major, minor) that the driver speaks; (0, 0) without a driver."""
    driver, version = _load(("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so")), ctypes.c_int(0)
    if driver is None or driver.cuDriverGetVersion(ctypes.byref(version)) != 0:
        return 0, 0
    return version.value // 1000, version.value % 1000 // 10


def cpu_cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def total_memory(device: str) -> int:
    """Memory [byte] of the machine or of the first CUDA device, used or not; creates no context."""
    if device == "cpu":
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    driver, handle, size = _load(("nvcuda.dll", "libcuda.so.1", "libcuda.so")), ctypes.c_int(0), ctypes.c_size_t(0)
    if driver is None or driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(handle), 0):
        raise BackendError("the CUDA driver does not answer, so the device's memory is not known; run `raytac doctor`")
    if driver.cuDeviceTotalMem_v2(ctypes.byref(size), handle):
        raise BackendError("the CUDA driver does not tell the device's memory; run `raytac doctor`")
    return size.value


def library_missing() -> str:
    """Library of the system that Dr.Jit's wheel needs and that is not here; empty if all are."""
    if sys.platform == "linux" and _load(("libatomic.so.1",)) is None:
        return (
            "Dr.Jit needs libatomic.so.1 of the system: apt install libatomic1 (Debian, Ubuntu) or dnf install libatomic (Fedora)"
        )
    return ""


@functools.cache
def optix_library() -> str | None:
    """Name of the OptiX library that can be loaded, or None; ``DRJIT_LIBOPTIX_PATH`` wins."""
    name = os.environ.get("DRJIT_LIBOPTIX_PATH") or ("nvoptix.dll" if sys.platform == "win32" else "libnvoptix.so.1")
    return name if _load((name,)) is not None else None


def llvm_library() -> Path | None:
    """The libLLVM that Dr.Jit should use, or None if there is none.

    In this order: ``DRJIT_LIBLLVM_PATH`` as the user set it (even if the file is missing: Dr.Jit then says so; empty is not set), the
    one that the ``karellen-llvm-core`` package brought, the newest one of version 16 or later on the system.
    """
    if chosen := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return Path(chosen)
    return _packaged_llvm() or _system_llvm()


def _packaged_llvm() -> Path | None:
    try:
        files = importlib.metadata.files("karellen-llvm-core") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    named = [file for file in files if file.name in ("libLLVM.so", "libLLVM.dylib", "LLVM-C.dll")]
    paths = [Path(str(file.locate())) for file in named]
    beside = [Path(sys.prefix) / "lib" / name for name in ("libLLVM.so", "libLLVM.dylib")]  # RECORD may not list links
    return next((path.resolve() for path in (*paths, *beside) if path.exists()), None)


def _system_llvm() -> Path | None:
    folders = [Path(sys.prefix) / "lib", Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/local/lib")]
    folders += Path("/usr/lib").glob("*-linux-gnu")
    folders += [path for top in ("/usr/lib", "/opt/homebrew/opt", "/usr/local/opt") for path in Path(top).glob("llvm*/lib")]
    candidates: dict[Path, int] = {}
    for folder in folders:
        for path in (*folder.glob("libLLVM*.so*"), *folder.glob("libLLVM*.dylib")):
            match = re.fullmatch(r"libLLVM[-.](?:so\.)?(\d+)(?:\.\d+)*(?:\.so(?:\.\d+)*|\.dylib)?", path.name)
            version = match or re.search(r"(\d+)", path.parent.parent.name)
            if version and int(version[1]) >= LLVM_MINIMUM:
                candidates[path] = int(version[1])
    return max(candidates, key=lambda path: candidates[path], default=None)


def _load(names: tuple[str, ...]) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None
