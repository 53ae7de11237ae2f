"""A small U-Net from the coat to the image: inputs, layers and file. It needs no PyTorch.

Networks that map rendered contact to a sensor's image see whole pictures, so that they may learn shadows: the adversarial one of
Kim et al. (Marker-embedded tactile image generation, RA-L 2023), a diffusion model of Higuera et al. (Learning to read braille,
arXiv 2304.01182). Here the picture is the coat, and nothing is random. A pixel has the inputs

    2 s_x, 2 s_y, d, c, u, v,

with s the slopes of the displacement from rest, d that displacement [mm], c = 1 where the object touches, and u, v in [−1, 1] over the
image. The U-Net (Ronneberger, Fischer and Brox, MICCAI 2015) has two 3 × 3 convolutions with ReLU a level, means of 2 × 2 on the way
down, bilinear interpolation on the way up, and a last 1 × 1 layer to the change of the image over ``LEVELS``. What it says of a coat at
rest is taken off, so that the image at rest is the background exactly.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import CalibrationError
from raytac.optics.image.network_files import check_header, file_provenance, file_view, header_arrays
from raytac.optics.taxim.restricted_pickle import check_file_numbers, npz_arrays

FORMAT, VERSION = "raytac unet", 1
"""Format and version of a file; the version counts changes of inputs, arithmetic or arrays."""
INPUTS = 6
LEVELS = 100.0
"""Levels that an output of 1 stands for."""
_LARGEST, _DEEPEST = 256, 8
"""Most channels and levels of a file."""


@dataclass(frozen=True)
class UnetWeights:
    """Weights of a U-Net, and the image at rest (H, W, 3) uint8, whose size is the network's."""

    widths: tuple[int, ...]
    """Channels at every level, the finest first."""
    layers: dict[str, np.ndarray]
    """Arrays of ``layer_shapes``."""
    background: np.ndarray
    provenance: dict[str, str] = field(default_factory=dict)
    """``sensor`` names the sensor that it was fitted to."""
    view: tuple[float, float] | None = None
    """Width and height of the pad in that sensor's view [m]; None where it is not known."""


def layer_shapes(widths: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Shapes of all arrays: ``<layer>.weight`` (out, in, k, k) and ``<layer>.bias`` (out,)."""
    convolutions = {}
    for k, (above, own) in enumerate(itertools.pairwise((INPUTS, *widths))):
        convolutions |= {f"down{k}.0": (own, above, 3), f"down{k}.2": (own, own, 3)}
    for k, (own, below) in enumerate(itertools.pairwise(widths)):
        convolutions |= {f"up{k}.0": (own, own + below, 3), f"up{k}.2": (own, own, 3)}
    convolutions["last"] = (3, widths[0], 1)
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (out, above, side) in convolutions.items():
        shapes |= {f"{name}.weight": (out, above, side, side), f"{name}.bias": (out,)}
    return shapes


def save_unet(weights: UnetWeights, path: Path) -> None:
    """Write the network as a compressed ``.npz``, its layers in half precision."""
    arrays: dict[str, Any] = {name: array.astype(np.float16) for name, array in weights.layers.items()}
    arrays |= header_arrays(FORMAT, VERSION, weights.provenance, weights.view)
    np.savez_compressed(path, background=weights.background, widths=np.array(weights.widths), **arrays)


def load_unet(path: str | Path) -> UnetWeights:
    """A network of ``save_unet``: its file, or the folder that holds it; else CalibrationError."""
    path = Path(path)
    path = path / "unet.npz" if path.is_dir() else path
    if not path.is_file():
        raise CalibrationError("must be a file unet.npz, or a folder that holds one", file=path)
    check_header(path, FORMAT, VERSION, "`python experiments/train_unet.py` fits it again")
    widths = npz_arrays(path, ("widths",))["widths"]
    whole = widths.dtype.kind == "i" and widths.ndim == 1
    if not whole or not 1 <= len(widths) <= _DEEPEST or widths.min() < 1 or widths.max() > _LARGEST:
        rule = f"must be 1 to {_DEEPEST} numbers of channels, each 1 to {_LARGEST}"
        raise CalibrationError(rule, file=path, key="widths", value=widths)
    levels = tuple(widths.tolist())
    shapes = layer_shapes(levels)
    arrays = npz_arrays(path, ("background", *shapes))
    layers = {name: check_file_numbers(path, name, arrays[name], shape).astype(np.float32) for name, shape in shapes.items()}
    background = arrays["background"]
    if (
        background.dtype != np.uint8
        or background.ndim != 3
        or background.shape[2] != 3
        or min(background.shape[:2]) < 2 ** len(levels)
    ):
        rule = f"must be uint8 of shape (H, W, 3), each side >= {2 ** len(levels)} pixels"
        raise CalibrationError(rule, file=path, key="background", value=f"{background.dtype} {background.shape}")
    return UnetWeights(levels, layers, background, file_provenance(path), file_view(path))
