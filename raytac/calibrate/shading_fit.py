"""Colour shading from one photograph of the untouched sensor: what fitted lights lack of its brightness, as a smooth gain.

Lights are fitted with that photograph as flat field, so they tell how a press changes the image and not how bright every pixel is at
rest. Uneven pigment and gel, the lens, and light that no LED of the model gives are in the quotient; a polynomial carries it in the
sensor's own file, so that the sensor looks right without the photograph.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from raytac.calibrate.photographs import decode
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics.response import fit_log_gain
from raytac.optics.trace.config import RayTraced
from raytac.optics.trace.tracer import total
from raytac.specs import SensorSpec

__all__ = ["DEGREE", "with_shading"]

DEGREE = 6
"""Of the polynomial: 28 numbers a channel."""
RIDGE = 1e-5
"""Pull of the coefficients to 0: far below what a level of the image is worth, but where a photograph is dark."""
GRID_PITCH = 0.12e-3
"""Spacing of the pad's nodes [m]; the pad is smooth."""


def with_shading(
    sensor: SensorSpec,
    background: np.ndarray,
    *,
    degree: int = DEGREE,
    device: str = "auto",
    tracing: RayTraced | None = None,
) -> SensorSpec:
    """The sensor with the colour shading that brings its image at rest to ``background`` (H, W, 3) [levels], seen by all of its camera.

    Least squares of the logarithm of the quotient, weighted so that residuals are levels of the image to first order. ``tracing``:
    how rays are traced.

    Raises:
        InputError: more than half of a channel of ``background`` is not brighter than the sensor's black level, or no light reaches a
            pixel at rest.
        BackendError: the ray tracer cannot run on ``device``.
    """
    height, width = background.shape[:2]
    bare = sensor.response.unshaded
    plain = dataclasses.replace(sensor, response=bare)
    tracer = (tracing or RayTraced()).build(plain, resolution=(width, height), outputs=("layers",), device=device)
    rest = total(tracer.render_layers(GelSurface.at_rest(make_grid(sensor.gelpad, GRID_PITCH))))[0] * tracer.response.scale
    if not (rest > 0).all():
        rule = "leave this many values of the image at rest dark, and no gain makes these bright"
        raise InputError("lights", value=int((rest <= 0).sum()), rule=rule)
    gamma, black = bare.gamma, np.asarray(bare.black_level)
    light = decode(background, gamma)
    target = light - black
    lit = target > 0
    if (lit.mean((0, 1)) < 0.5).any():
        rule = "more than half of a channel must be brighter than the black level"
        raise InputError("background", value=lit.mean((0, 1)).round(2).tolist(), rule=rule)
    # d level / d log gain = 255/γ · light^(1/γ − 1) · target
    slope = np.where(lit, 255 / gamma * np.maximum(light, 1e-6) ** (1 / gamma - 1) * target, 0.0)
    gain = np.where(lit, target, rest) / rest
    red, green, blue = (fit_log_gain(gain[..., c], slope[..., c] ** 2, degree, ridge=RIDGE) for c in range(3))
    return dataclasses.replace(
        sensor, response=dataclasses.replace(bare, shading_red=red, shading_green=green, shading_blue=blue)
    )
