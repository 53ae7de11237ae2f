"""Denoise sampled images: OptiX's denoiser on CUDA, Open Image Denoise on the CPU."""

from __future__ import annotations

import functools
import importlib
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from raytac.errors import BackendError

_TRY_OPTIX = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
image = mi.OptixDenoiser(input_size=[32, 32])(mi.TensorXf(0.5, shape=(32, 32, 3)))
assert abs(float(mi.Float(image.array)[0]) - 0.5) < 0.05, "a grey image does not stay grey"
"""


def make_denoiser(mi: Any, device: str, resolution: tuple[int, int]) -> Callable[[np.ndarray], np.ndarray]:
    """A function from a noisy linear image (H, W, 3) to a clean one, for one ``resolution``.

    Raises BackendError: on the CPU without the package mitsuba-oidn; on CUDA where OptiX's denoiser does not work.
    """
    if device == "cuda":
        if failure := _optix_failure():
            raise BackendError(
                f"OptiX's denoiser does not work here: {failure}; it needs the driver's file nvoptix.bin, which many containers lack. "
                "Mount it to /usr/share/nvidia, or render with denoise=False"
            )
        optix = mi.OptixDenoiser(input_size=list(resolution))
        return lambda image: np.array(optix(mi.TensorXf(image)))
    try:
        oidn = importlib.import_module("mitsuba_oidn")  # an extra: absent from the default install
    except ImportError as error:
        raise BackendError(
            "denoising on the CPU needs Open Image Denoise: `pip install raytac[denoise]`, or render with denoise=False"
        ) from error
    return lambda image: oidn.denoise(np.ascontiguousarray(image, dtype=np.float32), hdr=True)


@functools.cache
def _optix_failure() -> str:
    """Why OptiX's denoiser fails here, or nothing; in its own process, since Dr.Jit aborts."""
    try:
        done = subprocess.run([sys.executable, "-c", _TRY_OPTIX], capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "it gave no answer within 120 s"
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    messages = [line for line in lines if "[DENOISER]" in line]
    return (messages or lines[-1:] or [f"it ended with code {done.returncode}"])[0]
