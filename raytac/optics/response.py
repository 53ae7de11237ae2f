"""The camera's response: radiance to 8-bit image, flat field, and mid-grey exposure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.polynomial import chebyshev

from raytac.errors import InputError, SpecError
from raytac.optics.camera import Pinhole
from raytac.optics.power import power
from raytac.specs.sensor import ResponseSpec, SensorSpec, shading_degree

SATURATED = 0.05
"""Share of pixels at full scale above which an image at rest counts as saturated."""
_LIMITS = (1e-9, 1e9)
"""Exposures that are looked at; the upper one is the largest that a file may have."""
_STEPS = 60


class Response:
    """u8 = 255 · S(clip(wb · exposure · vignette · shading · M L + black)^(1/γ)), rounded.

    M is the colour matrix, wb the white balance, S the tone curve. With ``monochrome`` what is clipped is the mean over channels, and all
    three show it.
    """

    def __init__(self, spec: ResponseSpec, camera: Pinhole, *, monochrome: bool = False) -> None:
        self.spec, self.monochrome = spec, monochrome
        width, height = camera.resolution
        u, v = np.meshgrid(np.arange(width) + 0.5 - camera.principal[0], np.arange(height) + 0.5 - camera.principal[1])
        r2 = (u**2 + v**2) / ((width**2 + height**2) / 4)
        a1, a2, a3 = spec.vignetting
        vignette = 1 + r2 * (a1 + r2 * (a2 + r2 * a3))
        even = spec.gain * vignette[..., None] * np.asarray(spec.white_balance)
        self.scale = (even * shading_gain(spec.shading, camera.resolution)).astype(np.float32)
        """Linear gain per pixel and channel, (H, W, 3); a flat field multiplies it."""
        self.black = np.asarray(spec.black_level, dtype=np.float32)
        self.matrix = np.array(spec.colour_matrix, np.float32)
        self.curve = spec.curve
        self._mixes = bool((self.matrix != np.eye(3)).any())

    def set_flat_field(self, background: np.ndarray, at_rest: np.ndarray) -> None:
        """Turn radiance ``at_rest`` (H, W, 3) into ``background`` (uint8); InputError if not > 0."""
        at_rest = self.mixed(at_rest)
        dark = int((at_rest <= 0).sum())
        if dark:
            which = f"{dark} of {at_rest.size} values rendered at rest are dark or negative after the colour matrix"
            rule = f"{which}, so no gain makes them bright"
            raise InputError("flat_field", value=background.shape, rule=rule)
        target = self.curve.straight(background.astype(np.float32) / 255) ** self.spec.gamma - self.black
        if self.monochrome:  # one gain of the mean, so that channels keep their weights
            self.scale = (self.scale * _grey(target) / _grey(at_rest * self.scale)).astype(np.float32)
            return
        self.scale = (target / at_rest).astype(np.float32)

    def mixed(self, linear: np.ndarray) -> np.ndarray:
        """Radiance (…, 3) after the colour matrix."""
        return linear @ self.matrix.T if self._mixes else linear

    def encode(self, mi: Any, linear: list[Any], scale: list[Any]) -> Any:
        """8-bit RGB (N·3) of three device arrays (B·H·W) of radiances; ``scale``: ``device_scale``."""
        if self._mixes:
            linear = [sum((float(m) * light for m, light in zip(row, linear, strict=True)), mi.Float(0)) for row in self.matrix]
        n = dr.width(linear[0])
        i = dr.arange(mi.UInt32, n)
        pixel = i % dr.width(scale[0])
        values = [linear[c] * dr.gather(mi.Float, scale[c], pixel) + float(self.black[c]) for c in range(3)]
        if self.monochrome:
            values = [(values[0] + values[1] + values[2]) / 3] * 3
        levels: list[Any] = [power(dr.clip(value, 0, 1), 1 / self.spec.gamma) for value in values]
        if not self.curve.is_plain:  # rounding may pass black or white
            levels = [dr.clip(self.curve.bent(u), 0, 1) for u in levels]
        out = [level * 255 + 0.5 for level in levels]
        # One kernel for the whole image; the interleaving one would otherwise trace it once a channel.
        dr.eval(out)
        return mi.UInt8(dr.ravel(mi.Color3f(*out)))

    def device_scale(self, mi: Any, camera: Pinhole | None = None) -> list[Any]:
        """``scale``, of the piece that a camera renders, as three device arrays."""
        scale = self.scale if camera is None else camera.cut(self.scale)
        return [mi.Float(np.ascontiguousarray(scale[..., c]).ravel()) for c in range(3)]

    def encode_numpy(self, linear: np.ndarray) -> np.ndarray:
        """8-bit image (…, H, W, 3) of linear radiance of that shape."""
        value = self.mixed(linear) * self.scale + self.black
        if self.monochrome:
            value = np.broadcast_to(_grey(value), value.shape)
        return (self.curve.bent(np.clip(value, 0, 1) ** (1 / self.spec.gamma)) * 255 + 0.5).astype(np.uint8)


def _grey(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis, which is kept."""
    return values.mean(axis=-1, keepdims=True)


def mid_grey_exposure(sensor: SensorSpec, signal: np.ndarray) -> float:
    """Exposure at which the brightest channel's mean at rest is half of full scale.

    e solves max_c mean_p S(clip(e · s_pc + b_c, 0, 1)^(1/γ)) = 1/2 over channels c and pixels p, by bisection. The left side rises with e
    where no s is negative, or no b positive; otherwise e may be one of several solutions.

    Args:
        sensor: its response gives γ, the tone curve S and the black level b, and names the file of an error.
        signal: s, the linear image at rest with colour matrix, vignette, shading and white balance at exposure 1, (H, W, 3).

    Raises SpecError: the image is not darker than mid-grey at the least exposure, as its black level alone is brighter, or not brighter at
    the largest, as half of it or more is dark or negative after the colour matrix.
    """
    black, gamma, curve = np.asarray(sensor.response.black_level), sensor.response.gamma, sensor.response.curve
    if sensor.camera.monochrome:
        signal, black = _grey(signal), _grey(black)

    def brightness(exposure: float) -> float:
        return float(curve.bent(np.clip(exposure * signal + black, 0, 1) ** (1 / gamma)).mean(axis=(0, 1)).max())

    low, high = np.log(_LIMITS)
    if not brightness(_LIMITS[0]) < 0.5 < brightness(_LIMITS[1]):
        why = "too much of it is dark or negative after the colour matrix, or its black level alone is brighter"
        rule = f"no exposure makes the image at rest mid-grey: {why}"
        raise SpecError(rule, file=sensor.source, key="response.exposure", value=sensor.response.exposure)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if brightness(np.exp(middle)) < 0.5 else (low, middle)
    return float(f"{np.exp(0.5 * (low + high)):.4g}")


def saturated_share(rgb: np.ndarray) -> float:
    """Share of the pixels of an 8-bit image (…, 3) with a channel at 255."""
    return float((rgb == 255).any(axis=-1).mean())


def shading_gain(shading: Sequence[Sequence[float]], resolution: tuple[int, int]) -> np.ndarray:
    """Gain (H, W, C) at ``resolution`` by coefficients of C channels; none is a gain of 1."""
    x, y = (_centres(n) for n in resolution)
    return np.exp(np.stack([chebyshev.chebgrid2d(x, y, _table(c)).T for c in shading], -1))


def fit_log_gain(gain: np.ndarray, weight: np.ndarray, degree: int, *, ridge: float = 0.0) -> tuple[float, ...]:
    """Coefficients of the polynomial nearest to log ``gain`` (H, W) > 0 with weights (H, W).

    ``ridge`` pulls every coefficient to 0, relative to all weights together: it holds a fit where pixels without weight leave it free.
    """
    height, width = gain.shape
    root = np.sqrt(weight).ravel()
    basis = _basis((width, height), degree).reshape(gain.size, -1)
    pull = np.sqrt(ridge * weight.sum()) * np.eye(basis.shape[1])
    target = np.concatenate([np.log(gain).ravel() * root, np.zeros(len(pull))])
    coefficients, *_ = np.linalg.lstsq(np.concatenate([basis * root[:, None], pull]), target, rcond=None)
    return tuple(map(float, coefficients))


def _basis(resolution: tuple[int, int], degree: int) -> np.ndarray:
    """T_i(x) T_j(y) with i + j ≤ ``degree`` at the pixels' centres, (H, W, N)."""
    x, y = (chebyshev.chebvander(_centres(n), degree) for n in resolution)
    return np.stack([np.multiply.outer(y[:, j], x[:, i]) for i in range(degree + 1) for j in range(degree + 1 - i)], -1)


def _centres(count: int) -> np.ndarray:
    """Those of ``count`` pixels, −1 and 1 at the image's edges."""
    return (np.arange(count) + 0.5) / count * 2 - 1


def _table(coefficients: Sequence[float]) -> np.ndarray:
    """c_ij as a square array, 0 where i + j > n."""
    orders = np.arange(max(shading_degree(len(coefficients)), 0) + 1)
    table = np.zeros((len(orders), len(orders)))
    if len(coefficients):
        table[np.add.outer(orders, orders) <= orders[-1]] = coefficients
    return table
