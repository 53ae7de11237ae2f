"""Choose Mitsuba's variant once per process; the only place that imports Mitsuba first."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

import drjit as dr

from raytac.device import LLVM_MINIMUM, LLVM_NAMED_BY_USER, cpu_cores, llvm_library, resolve_device
from raytac.errors import BackendError

VARIANTS = {"cuda": "cuda_ad_rgb", "cpu": "llvm_ad_rgb"}


def load_mitsuba(device: str = "auto") -> tuple[Any, str]:
    """Import Mitsuba with the variant for ``device`` (``auto``, ``cpu``, ``cuda``).

    Returns the module and the device that it runs on. A process has one variant: types of Mitsuba plugins are bound to the first, and
    ``auto`` stays with it. The first ``cuda`` of a process traces one ray; where that fails, ``auto`` warns and takes the CPU.

    Raises ``BackendError``: no LLVM library or one too old (CPU), no CUDA that works, or a process that already uses the other variant.
    """
    resolved = resolve_device(device)
    if resolved == "cpu":
        _require_llvm()
    import mitsuba as mi

    name = _started(mi, device, resolved)
    from raytac.optics.trace.led import register

    register(mi)
    return mi, name


def _started(mi: Any, device: str, name: str) -> str:
    """The device whose variant is set in ``mi``: ``name``, or what ``auto`` falls back to."""
    # A variant that could be set and did not trace is still set, and nothing renders with it.
    current = None if mi.variant() == getattr(mi, "raytac_failed_variant", None) else mi.variant()
    active = next((known for known, variant in VARIANTS.items() if variant == current), None)
    if active is not None and device == "auto":
        return active
    if current not in (None, VARIANTS[name]):
        raise BackendError(
            f"this process already renders with {mi.variant()}, so {VARIANTS[name]} (device {name!r}) cannot be used; "
            "keep one device per process"
        )
    if active is not None:
        return name
    failure = _try_variant(mi, VARIANTS[name], trace=name == "cuda")
    if failure and name == "cuda" and device == "auto":
        warnings.warn(
            f"CUDA does not trace here, so the CPU does: {failure} (`raytac doctor` tells more)", RuntimeWarning, stacklevel=4
        )
        _require_llvm()
        name, failure = "cpu", _try_variant(mi, VARIANTS["cpu"])
    if failure:
        raise BackendError(f"Mitsuba variant {VARIANTS[name]} does not work here: {failure}; run `raytac doctor`")
    return name


def _try_variant(mi: Any, variant: str, *, trace: bool = False) -> str:
    """Set the variant, trace a ray if asked, and return why that failed, noted in ``mi``.

    A CUDA whose libraries load may still not trace: no kernel image for the card, no OptiX in a container, a driver that is too old.
    """
    failure = ""
    try:
        mi.set_variant(variant)
        if trace:
            scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
            if not scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))[0]:
                failure = "a ray missed what it must hit"
    except (ImportError, RuntimeError) as error:
        failure = " ".join(str(error).split()) or type(error).__name__
    if failure:
        mi.raytac_failed_variant = variant
    elif getattr(mi, "raytac_failed_variant", None) == variant:
        mi.raytac_failed_variant = None
    return failure


def _require_llvm() -> None:
    library = llvm_library()
    if library is None:
        raise BackendError(
            "the ray tracer needs LLVM (or an NVIDIA GPU), and no libLLVM was found: "
            "`pip install karellen-llvm-core`, or set DRJIT_LIBLLVM_PATH to a libLLVM of version 16 or newer; "
            "`raytac doctor` tells what was tried"
        )
    version = dr.detail.llvm_version()
    if version[0] < LLVM_MINIMUM and not LLVM_NAMED_BY_USER:
        raise BackendError(
            f"Dr.Jit has loaded libLLVM {'.'.join(map(str, version))}, which may abort the process, because drjit or mitsuba was imported "
            f"before raytac: import raytac.optics first, or set DRJIT_LIBLLVM_PATH={library}"
        )


def share_cores() -> None:
    """Let Dr.Jit use at most half of the cores from now on; a smaller number set before stays.

    Its threads wait busily for the next image. Where physics and a policy run between two images, those threads take their cores, and
    libraries whose threads wait for each other then wait for threads that do not run.
    """
    dr.set_thread_count(min(dr.thread_count(), max(cpu_cores() // 2, 1)))


RENDERER = RLock()
"""Lock around recording, launching, waiting: Dr.Jit records in one place of the process."""


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's garbage collector out of the block, where Dr.Jit may record kernels.

    An array made from NumPy memory on the CPU returns it by a host callback when it is freed. If the collector frees one while a frozen
    function is recorded, Dr.Jit 1.5 aborts the process ("enqueue_host_func(): this function cannot be recorded!"). Only reference
    cycles wait for the collector, and optical modes that are thrown away are such: they hold the recordings of their own methods.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def peak_bytes(call: Callable[[], object], device: str, *, calls: int = 3) -> int:
    """Most bytes of Dr.Jit's arrays in one of ``calls`` runs of ``call``, beyond those before.

    It is 0 without Dr.Jit. Kernels run beside the code that launches them, so memory that one frees may or may not be free for the next:
    only the largest of several runs is the same in every process. The allocator's cache is emptied before each run, which makes the next
    calls slower. Acceleration structures of the ray tracer (Embree, OptiX) are not Dr.Jit arrays and not counted.
    """
    backend = dr.JitBackend.CUDA if device == "cuda" else dr.JitBackend.LLVM
    peak = 0
    for _ in range(calls):
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(backend)
        call()
        dr.sync_thread()
        peak = max(peak, dr.detail.malloc_watermark(backend) - before)
    return peak
