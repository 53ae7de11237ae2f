"""Films as GIF or MP4, of pictures of one size."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from raytac.errors import BackendError


def gif_bytes(pictures: Sequence[np.ndarray], rate: float) -> bytes:
    """A GIF that repeats, of 8-bit pictures (H, W, 3) of one size, ``rate`` a second."""
    from PIL import Image

    # One palette for all, so that what stands still does not flicker. Dithering would put grain on the smooth images of sensors.
    sample = np.concatenate([picture[::4, ::4] for picture in pictures[:: max(1, len(pictures) // 12)]])
    palette = Image.fromarray(sample).quantize(255, method=Image.Quantize.MEDIANCUT, kmeans=3)
    images = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    stream = io.BytesIO()
    images[0].save(stream, "GIF", save_all=True, append_images=images[1:], duration=round(1e3 / rate), loop=0)
    return stream.getvalue()


def check_mp4() -> None:
    """Raise ``BackendError`` if the package that writes MP4 is not installed."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise BackendError("MP4 needs imageio-ffmpeg: pip install 'raytac[video]'; a GIF needs nothing")


def mp4_bytes(pictures: Sequence[np.ndarray], rate: float) -> bytes:
    """An MP4 (H.264) of 8-bit pictures (H, W, 3) of one size, ``rate`` a second.

    Sides are cut to even numbers of pixels, as the usual format of colours wants them.

    Raises ``BackendError``: imageio-ffmpeg is not installed, or fails.
    """
    check_mp4()
    import tempfile

    import imageio_ffmpeg  # type: ignore[import-not-found]

    height, width = (2 * (side // 2) for side in pictures[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        try:
            writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=rate, macro_block_size=2, quality=7)
            writer.send(None)
            for picture in pictures:
                writer.send(np.ascontiguousarray(picture[:height, :width]))
            writer.close()
            return path.read_bytes()
        except (OSError, RuntimeError) as error:
            raise BackendError(f"imageio-ffmpeg could not write the film: {error}") from error
