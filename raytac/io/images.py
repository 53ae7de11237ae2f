"""Images on disk: 8-bit PNG, linear OpenEXR with named channels, sheets of pictures."""

from __future__ import annotations

import errno
import io
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from raytac.errors import InputError


def png_bytes(rgb_u8: np.ndarray) -> bytes:
    """A PNG file of ``rgb_u8``, (H, W, 3), uint8. Raises ``InputError`` for anything else."""
    if rgb_u8.ndim != 3 or rgb_u8.shape[2] != 3 or rgb_u8.dtype != np.uint8:
        raise InputError("rgb_u8", value=(rgb_u8.shape, str(rgb_u8.dtype)), rule="must have shape (H, W, 3) and type uint8")
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb_u8)).save(stream, "PNG")
    return stream.getvalue()


def write_png(path: str | Path, rgb_u8: np.ndarray) -> None:
    """Write ``png_bytes(rgb_u8)``. Raises the same."""
    Path(path).write_bytes(png_bytes(rgb_u8))


def read_png(path: str | Path) -> np.ndarray:
    """The image as RGB, shape (H, W, 3), uint8. Raises ``OSError``: no such file, or no image."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (ValueError, SyntaxError) as error:  # Pillow raises these too on a damaged file
        raise OSError(str(error)) from error


HEADER_PREFIX = "raytac:"
"""Header attributes of this package are ``raytac:sensor``, ``raytac:seed``, …; all are text."""


def vector_channels(name: str, image: np.ndarray, suffixes: str = "XYZ") -> dict[str, np.ndarray]:
    """Channels of a vector image.

    ``("N", (H, W, 3))`` gives ``{"N.X": (H, W), …}``; an empty name with the suffixes ``"RGB"`` gives ``{"R": …}``.
    """
    if image.ndim != 3 or image.shape[2] != len(suffixes):
        raise InputError(f"channels {name!r}", value=image.shape, rule=f"must have shape (H, W, {len(suffixes)})")
    return {f"{name}.{s}" if name else s: image[:, :, i] for i, s in enumerate(suffixes)}


def write_exr(path: Path, channels: Mapping[str, np.ndarray], header: Mapping[str, str] | None = None) -> None:
    """Write float32 channels, losslessly compressed; ``header`` keys get the prefix ``raytac:``.

    Args:
        channels: name to image of shape (H, W), all of one shape.

    Raises:
        InputError: no channels, shapes that differ, or a header value that is not text.
        OSError: the file cannot be written.
    """
    if not channels:
        raise InputError("channels", value={}, rule="must hold at least one image")
    shape = next(iter(channels.values())).shape
    for name, image in channels.items():
        if image.ndim != 2 or image.shape != shape:
            raise InputError(f"channel {name!r}", value=image.shape, rule=f"must have the shape of the others, {shape}")
    for key, value in (header or {}).items():
        if not isinstance(value, str):
            raise InputError(f"header {key!r}", value=value, rule="must be text")

    import OpenEXR

    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    attributes |= {
        HEADER_PREFIX + key: value.encode("utf-8", "backslashreplace").decode() for key, value in (header or {}).items()
    }
    images = {name: np.ascontiguousarray(image, dtype=np.float32) for name, image in channels.items()}
    # By another file, since the library takes no path that is not UTF-8.
    with tempfile.TemporaryDirectory() as folder, OpenEXR.File(attributes, images) as file:
        plain = Path(folder) / "image.exr"
        try:
            file.write(str(plain))
        except RuntimeError as error:
            raise OSError(errno.EIO, f"{error} The disk may be full.") from error
        path.write_bytes(plain.read_bytes())


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels by name, (H, W), and ``raytac:`` attributes; ``InputError`` if it is no EXR."""
    import OpenEXR

    if not path.is_file():
        raise InputError("EXR file", value=path, rule="must exist")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            header = {k.removeprefix(HEADER_PREFIX): v for k, v in file.header().items() if k.startswith(HEADER_PREFIX)}
    except (RuntimeError, ValueError) as error:
        raise InputError("EXR file", value=path, rule=f"must be readable as OpenEXR ({error})") from error
    return channels, header


def write_sheet(pictures: list[Path], out: Path, *, gap: int = 24) -> None:
    """Stack PNG files, ``gap`` white pixels apart, white on the right; ``InputError`` for none."""
    if not pictures:
        raise InputError("pictures", value=[], rule="must name at least one picture")
    images = [read_png(path) for path in pictures]
    width = max(image.shape[1] for image in images)
    sheet = np.full((sum(image.shape[0] for image in images) + gap * (len(images) - 1), width, 3), 255, np.uint8)
    top = 0
    for image in images:
        sheet[top : top + image.shape[0], : image.shape[1]] = image
        top += image.shape[0] + gap
    write_png(out, sheet)
