"""Pictures of a pad: the tactile image, its difference from rest, height and normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from raytac.view.session import PadView, Snapshot, round_up

PICTURES: tuple[str, ...] = ("tactile image", "difference × 2", "height", "normals")
"""Pictures of a sensor; a pad has those that its session computes."""
ARROW_SCALE = 2.0
"""Length of a drawn arrow over the displacement, so that tenths of a pixel are seen."""
_GAIN = 2.0
"""Levels of the difference over those of the image: shallow imprints change few."""
_LEAST_WIDTH = 480
"""Least width [px] to which images are enlarged, by a whole factor, for crisp arrows."""
_SHORTEST = 1.0
"""Arrows of fewer enlarged pixels are drawn as dots."""
_INK = (255, 220, 60)
_LEAST_RANGE = 1e-4
"""Smallest range of a height picture [m]; it hides the noise at rest."""


def pictures_of(pads: Mapping[str, PadView]) -> tuple[str, ...]:
    """Pictures that some of the pads have; all, without pads."""
    return (
        PICTURES if not pads else tuple(kind for kind in PICTURES if any(_source(pad, kind) is not None for pad in pads.values()))
    )


def _source(pad: PadView, kind: str) -> np.ndarray | None:
    """The array of a pad that a picture is made of."""
    if kind == "difference × 2":
        return None if pad.rest_rgb is None else pad.rgb
    return {"tactile image": pad.rgb, "height": pad.height, "normals": pad.normals}[kind]


class HeightScale:
    """Range of height pictures [m], which only grows until ``reset``."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin again, without a range."""
        self.low, self.high = np.inf, -np.inf

    def include(self, pad: PadView) -> None:
        """Let the range reach the heights of a pad, down to a round depth below the highest."""
        seen = pad.height[np.isfinite(pad.height)] if pad.height is not None else np.zeros(0)
        if len(seen):
            self.high = max(self.high, float(seen.max()))
            deep = max(self.high - float(seen.min()), _LEAST_RANGE)
            self.low = min(self.low, self.high - round_up(deep))

    @property
    def label(self) -> str:
        """Range in words, for people."""
        low, high = (round(1e3 * end, 2) + 0.0 for end in (self.low, self.high))
        return f"z from {low:.2f} mm (dark) to {high:.2f} mm (bright)"


def picture(
    pad: PadView, kind: str = "tactile image", *, arrows: bool = False, heights: HeightScale | None = None
) -> np.ndarray | None:
    """8-bit image (H', W', 3) of a pad's sensor, or None if it has no such picture.

    Args:
        kind: one of ``PICTURES``.
        arrows: draw the markers' displacements over it.
        heights: range of the colours of ``height``; None is the pad's own.
    """
    source = _source(pad, kind)
    if source is None:
        return None
    if kind == "difference × 2":
        assert pad.rest_rgb is not None
        image = np.clip(128.0 + _GAIN * (source.astype(float) - pad.rest_rgb), 0.0, 255.0).astype(np.uint8)
    elif kind == "normals":
        image = np.rint(127.5 * (1.0 + np.nan_to_num(source) * [1.0, 1.0, -1.0])).astype(np.uint8)
    elif kind == "height":
        image = _coloured(pad, heights)
    else:
        image = source
    if not arrows or pad.markers_px is None:
        return image
    return _with_arrows(image, *pad.markers_px)


def _coloured(pad: PadView, heights: HeightScale | None) -> np.ndarray:
    from matplotlib import colormaps

    assert pad.height is not None
    if heights is None:
        heights = HeightScale()
        heights.include(pad)
    share = (np.nan_to_num(pad.height, nan=heights.low) - heights.low) / max(heights.high - heights.low, 1e-12)
    return np.rint(255.0 * colormaps["viridis"](np.clip(share, 0.0, 1.0))[..., :3]).astype(np.uint8)


def enlarged(image: np.ndarray) -> np.ndarray:
    """An 8-bit image (H, W, 3), larger by the whole factor that makes it wide enough for a page."""
    from PIL import Image

    height, width = image.shape[:2]
    factor = -(-_LEAST_WIDTH // width)
    if factor == 1:
        return image
    return np.asarray(Image.fromarray(image).resize((factor * width, factor * height), Image.Resampling.BILINEAR))


def _with_arrows(image: np.ndarray, rest: np.ndarray, moved: np.ndarray) -> np.ndarray:
    from PIL import Image, ImageDraw

    large = Image.fromarray(enlarged(image))
    factor, draw = large.width // image.shape[1], ImageDraw.Draw(large)
    starts, arrows_px = factor * rest, factor * ARROW_SCALE * moved
    for (x, y), (dx, dy) in zip(starts, arrows_px, strict=True):
        if not np.isfinite([x, y, dx, dy]).all():
            continue
        length = float(np.hypot(dx, dy))
        if length < _SHORTEST:
            draw.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=_INK)
            continue
        end = np.array([x + dx, y + dy])
        draw.line([(x, y), tuple(end.tolist())], fill=_INK, width=2)
        along, across = np.array([dx, dy]) / length, np.array([-dy, dx]) / length
        head = min(7.0, 0.5 * length)
        tip = [end, end - head * along + 0.45 * head * across, end - head * along - 0.45 * head * across]
        draw.polygon([tuple(point.tolist()) for point in tip], fill=_INK)
    return np.asarray(large)


FILM_HEIGHT, STILL_HEIGHT = 360, 720
"""Height of the pictures of a film, and of a single one [px]."""
_CAPTION, _GAP = 26, 8
"""Height of the text below pictures, and the space between them [px]."""


def film_picture(
    snapshot: Snapshot,
    kind: str,
    *,
    arrows: bool,
    heights: HeightScale,
    view: np.ndarray | None = None,
    height: int = FILM_HEIGHT,
) -> np.ndarray:
    """One picture of a film: the 3-D view if there is one, then every pad with its force.

    Returns an 8-bit image (H, W, 3) with even sides, which video formats need.
    """
    from PIL import Image, ImageDraw

    panels: list[tuple[np.ndarray, str]] = [] if view is None else [(view, _clock(snapshot))]
    for name, pad in snapshot.pads.items():
        image = picture(pad, kind, arrows=arrows, heights=heights)
        if image is not None:
            panels.append((image, f"{name}   {_force(pad)}"))
    sizes = [(max(2, round(image.shape[1] * height / image.shape[0])), height) for image, _ in panels]
    sized = [Image.fromarray(panel[0]).resize(size, Image.Resampling.LANCZOS) for panel, size in zip(panels, sizes, strict=True)]
    width = sum(image.width for image in sized) + _GAP * (len(sized) + 1)
    sheet = Image.new("RGB", (width + width % 2, height + 2 * _GAP + _CAPTION), (250, 250, 250))
    draw, x = ImageDraw.Draw(sheet), _GAP
    for image, (_, text) in zip(sized, panels, strict=True):
        sheet.paste(image, (x, _GAP))
        draw.text((x + 2, height + _GAP + 5), text, fill=(40, 40, 40), font_size=14)
        x += image.width + _GAP
    return np.asarray(sheet)


def _clock(snapshot: Snapshot) -> str:
    return "" if snapshot.time is None else f"t = {snapshot.time:.2f} s"


def _force(pad: PadView) -> str:
    if pad.wrench is None or not np.isfinite(pad.wrench).all():
        return ""
    return "F = ({:+.2f}, {:+.2f}, {:+.2f}) N".format(*(pad.wrench[:3] + 0.0))


def films_equal_size(pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The pictures on sheets of the largest one's size, so that they make a film."""
    height, width = (max(image.shape[k] for image in pictures) for k in (0, 1))
    sheets = []
    for image in pictures:
        sheet = np.full((height, width, 3), 250, np.uint8)
        sheet[: image.shape[0], : image.shape[1]] = image
        sheets.append(sheet)
    return sheets
