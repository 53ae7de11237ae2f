"""Denoise sampled images: OptiX's denoiser on CUDA, Open Image Denoise on the CPU. Both are biased; labels say when one ran."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from raytac.errors import BackendError

__all__ = ["make_denoiser"]


def make_denoiser(mi: Any, device: str, resolution: tuple[int, int]) -> Callable[[np.ndarray], np.ndarray]:
    """A function from a noisy linear image (H, W, 3) to a clean one, for images of ``resolution`` (width, height).

    Raises:
        BackendError: on the CPU without the package mitsuba-oidn.
    """
    if device == "cuda":
        optix = mi.OptixDenoiser(input_size=list(resolution))
        return lambda image: np.array(optix(mi.TensorXf(image)))
    try:
        oidn = importlib.import_module("mitsuba_oidn")  # an extra: absent from the default install
    except ImportError as error:
        raise BackendError(
            "denoising on the CPU needs Open Image Denoise: `pip install raytac[denoise]`, or render with denoise=False"
        ) from error
    return lambda image: oidn.denoise(np.ascontiguousarray(image, dtype=np.float32), hdr=True)
