"""Choose Mitsuba's variant once per process; the only place that imports Mitsuba first."""

from __future__ import annotations

from typing import Any

from raytac.device import llvm_library, resolve_device
from raytac.errors import BackendError

__all__ = ["VARIANTS", "load_mitsuba"]

VARIANTS = {"cuda": "cuda_ad_rgb", "cpu": "llvm_ad_rgb"}


def load_mitsuba(device: str = "auto") -> tuple[Any, str]:
    """Import Mitsuba with the variant for ``device`` (``auto``, ``cpu``, ``cuda``).

    Returns the module and the device that it runs on. A process has one variant: types of Mitsuba plugins are bound to the first.

    Raises:
        BackendError: no LLVM library (CPU), no CUDA device, or a process that already uses the other variant.
    """
    name = resolve_device(device)
    if name == "cpu" and llvm_library() is None:
        raise BackendError(
            "the ray tracer needs LLVM (or an NVIDIA GPU), and no libLLVM was found: "
            "`pip install karellen-llvm-core`, or set DRJIT_LIBLLVM_PATH to a libLLVM of version 16 or newer; "
            "`raytac doctor` tells what was tried"
        )
    import mitsuba as mi

    variant = VARIANTS[name]
    if mi.variant() not in (None, variant):
        raise BackendError(
            f"this process already renders with {mi.variant()}, so {variant} (device {name!r}) cannot be used; "
            "keep one device per process"
        )
    if mi.variant() is None:
        try:
            mi.set_variant(variant)
        except (ImportError, RuntimeError) as error:
            raise BackendError(f"Mitsuba variant {variant} does not start: {error}; run `raytac doctor`") from error
    from raytac.optics import led

    led.register(mi)
    return mi, name
