"""The ray tracer's lights fitted to photographs of ball presses by least squares, and contact circles in turn with them.

The forward model is raytac's own: the ball pressed into the rigid pad, the ``fast`` ray tracer with shadows and inter-reflection, the
sensor's response with the real background as flat field. Light is additive, so one rendering with every LED in a layer of its own
gives the derivatives by a parameter of all LEDs at once, and derivatives by powers are exact.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable

import numpy as np
from tqdm import tqdm

from raytac.calibrate.light_parameters import CEILING, LightParameters, darkest
from raytac.calibrate.photographs import Photographs, decode, encode
from raytac.gel.surface import GelSurface
from raytac.optics.lamp import Lamp
from raytac.optics.raytrace import RayTracer
from raytac.specs import SensorSpec
from raytac.specs.sensor_check import led_corners

__all__ = ["LightFit", "solve"]

STEPS = np.array([0.15, 0.15, 0.15, 0.03, 0.03, 0.1])
"""Steps of the derivatives: position [mm], azimuth and elevation of the axis [rad], lobe exponent. Wide enough to cross the cells of a
shadow walk."""
CIRCLE_STEP = 0.4
"""Step [px] of the derivatives by a circle: wide enough for the grid of the pad."""
CIRCLE_SIGMA = np.array([1.0, 1.0, 1.5])
"""How far [px] a contact circle is believed to be from its label: x, y, radius."""
NOISE = 4.0
"""Residual [levels] of a pixel that a label is weighed against."""
VIEW_MARGIN = 0.3
"""How far [mm] the plane through an LED across its axis, its 90-degree cut-off, stays from every point of the visible pad."""


class LightFit:
    """Residuals in 8-bit levels: the presses with the real background as flat field (disc, and the ring up to twice the labelled radius at
    half the weight), the image at rest, and a penalty [500 levels/mm] where an LED leaves its place or its cut-off comes near the view."""

    def __init__(
        self,
        sensor: SensorSpec,
        shots: Photographs,
        press: Callable[[np.ndarray], GelSurface],
        p: LightParameters,
        weight: float,
        device: str,
    ) -> None:
        """``press`` gives the pad at rest and under the ball at circles (N, 3); ``weight`` is that of a pixel at rest. The light that comes
        over the case is that of ``p`` and stays; so do the pixels that count, those about the circles of ``shots``."""
        self.sensor, self.shots, self.press_balls, self.weight = sensor, shots, press, weight
        self.circles, self.surface = shots.circles.copy(), press(shots.circles)
        height, width = shots.background.shape[:2]
        rho = shots.distance(sensor)
        self.press, self.row, self.column = np.nonzero(rho < 2)
        self.share = np.where(rho[self.press, self.row, self.column] < 1, 1.0, 0.5)[:, None]
        self.darkest = darkest(shots.background, 1.0)
        native, (cx, cy) = sensor.camera.resolution, sensor.camera.principal_point
        v, u = (np.mgrid[:height, :width] + 0.5) * native[0] / width
        self.r2 = (((u - cx) ** 2 + (v - cy) ** 2) / (native[0] ** 2 + native[1] ** 2) * 4).reshape(-1, 1)
        lit = dataclasses.replace(sensor, lights=p.lights(np.ones((len(p.leds), 3))))
        self.tracer = RayTracer(lit, resolution=(width, height), outputs=("layers",), layers="led", device=device)

    def light(self, p: LightParameters) -> list[np.ndarray]:
        """Exposed light of every LED at power 1: in the pixels of presses, in the same pixels at rest, at rest (L, …)."""
        leds = p.lights(np.ones((len(p.leds), 3))).leds
        self.tracer.lamps = [Lamp.from_spec(self.tracer.mi, led) for led in leds]
        layers = self.tracer.render_layers(self.surface)
        light = self.sensor.response.exposure * np.stack([layer[..., 0] for layer in layers.values()]).astype(float)
        rest = light[:, 0]
        return [light[:, 1 + self.press, self.row, self.column], rest[:, self.row, self.column], rest.reshape(len(light), -1)]

    def penalty(self, p: LightParameters) -> np.ndarray:
        camera, half = self.sensor.camera, 5e2 * np.array(self.sensor.case.size)
        x, y = (5e2 * n * pitch for n, pitch in zip(camera.resolution, camera.pixel_pitch, strict=True))
        corners = np.array([(sx * x, sy * y, z) for sx in (-1, 1) for sy in (-1, 1) for z in (-0.3, -1.2)])
        over = []
        for led in p.lights().leds:
            edge = 1e3 * np.array(led_corners(led))
            over += [VIEW_MARGIN - (corners - 1e3 * np.array(led.position)) @ np.array(led.axis), edge[:, 2] - CEILING]
            over += [np.ravel(np.abs(edge[:, :2]) - half + 0.1), 1e3 * self.sensor.case.floor_z + 0.1 - edge[:, 2]]
        return 500 * np.maximum(np.concatenate(over), 0)

    def residuals(self, p: LightParameters, light: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([*(part.ravel() for part in self._images(p, light)[0]), self.penalty(p)])

    def _images(self, p: LightParameters, light: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Residuals of presses (N, 3) and rest (M, 3); slopes of the first by light pressed and at rest, of the second by that at rest."""
        power, (gamma, *stray, a1, a2) = p.powers()[0], p.response
        pressed, flat, rest = (np.maximum(part.T @ power, 1e-7) for part in light)
        black = np.array(stray) * self.darkest**gamma
        lit = (decode(self.shots.background[self.row, self.column], gamma) - black) * pressed / flat
        still_lit = rest * (1 + self.r2 * (a1 + a2 * self.r2))
        image, still = encode(lit + black, gamma), encode(still_lit + black, gamma)
        apart = [self.share * (image - self.shots.presses[self.press, self.row, self.column])]
        apart.append(self.weight * (still - self.shots.background.reshape(-1, 3)))
        gain = self.share * image / gamma / np.maximum(lit + black, 1e-6) * lit
        rest_gain = self.weight * still / gamma / np.maximum(still_lit + black, 1e-6) * still_lit / rest
        return apart, [gain / pressed, -gain / flat, rest_gain]

    def jacobian(self, p: LightParameters, light: list[np.ndarray]) -> np.ndarray:
        (power, slope), count, (apart, gains) = p.powers(), len(p.leds), self._images(p, light)
        images, limits = sum(part.size for part in apart), self.penalty(p)
        jac = np.zeros((images + len(limits), 9 * count + len(p.response)), np.float32)

        def column(k: int, parts: list[np.ndarray], weights: np.ndarray) -> None:
            pressed, flat, rest = (gain * (part[:, None] * weights) for gain, part in zip(gains, parts, strict=True))
            jac[:images, k] = np.concatenate([(pressed + flat).ravel(), rest.ravel()])

        for k, step in enumerate(STEPS):
            all_moved = p.leds.copy()
            all_moved[:, k] += step
            change = [(new - old) / step for new, old in zip(self.light(p.moved(all_moved)), light, strict=True)]
            for led in range(count):
                column(6 * led + k, [part[led] for part in change], power[led])
                alone = p.leds.copy()
                alone[led, k] += 1e-4
                jac[images:, 6 * led + k] = (self.penalty(p.moved(alone)) - limits) / 1e-4
        for led in range(count):
            for k in range(3):
                column(6 * count + 3 * led + k, [part[led] for part in light], slope[led, k])
        now = np.concatenate([part.ravel() for part in apart])
        for k in range(len(p.response)):  # no light depends on the response: differences cost nothing
            response = p.response + 1e-4 * np.eye(len(p.response))[k]
            moved = self._images(dataclasses.replace(p, response=response), light)[0]
            jac[:images, 9 * count + k] = (np.concatenate([part.ravel() for part in moved]) - now) / 1e-4
        return jac

    def refine_circles(self, p: LightParameters, labels: np.ndarray) -> None:
        """Move every press's circle by one step of Gauss and Newton's method, the light held, towards the image and its label (N, 3).

        A label weighs as ``CIRCLE_SIGMA`` says, and a step is at most a pixel in each of x, y and radius.
        """
        here, slopes = self._images(p, self.light(p))[0][0], []
        for k in range(3):
            self.surface = self.press_balls(self.circles + CIRCLE_STEP * np.eye(3)[k])
            slopes.append((self._images(p, self.light(p))[0][0] - here) / CIRCLE_STEP)
        belief = np.diag((NOISE / CIRCLE_SIGMA) ** 2)
        for i, label in enumerate(labels):
            inside = self.press == i
            jac, off = np.stack([slope[inside].ravel() for slope in slopes], axis=1), here[inside].ravel()
            step = np.linalg.solve(jac.T @ jac + belief, jac.T @ off + belief @ (self.circles[i] - label))
            self.circles[i] -= np.clip(step, -1, 1)
        self.surface = self.press_balls(self.circles)


def solve(problem: LightFit, p: LightParameters, iterations: int, label: str) -> LightParameters:
    """Levenberg and Marquardt's method with bounds: steps are cut off at the bounds, a parameter that is pushed out of them rests.

    An interrupt ends the fit with what it reached.
    """
    low, high = p.bounds(problem.sensor)
    p, damping = p.at(np.clip(p.flat(), low, high)), 1e-2
    light = problem.light(p)
    residuals = problem.residuals(p, light)
    try:
        for _ in (bar := tqdm(range(iterations), desc=label, leave=False, disable=None)):
            x, jac, before = p.flat(), problem.jacobian(p, light), float(residuals @ residuals)
            normal, slope = (jac.T @ jac).astype(float), (jac.T @ residuals.astype(np.float32)).astype(float)
            free = ~(((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0)))
            cost = before
            while damping < 1e6 and cost >= before:
                damped, step = normal + np.diag(damping * np.maximum(np.diag(normal), 1e-9)), np.zeros_like(x)
                step[free] = np.linalg.solve(damped[np.ix_(free, free)], -slope[free])
                trial = p.at(np.clip(x + step, low, high))
                seen = problem.light(trial)
                off = problem.residuals(trial, seen)
                cost = float(off @ off)
                damping *= 4
            if cost >= before:
                break
            p, light, residuals, damping = trial, seen, off, max(damping / 12, 1e-6)
            bar.set_postfix(rmse=f"{np.sqrt(cost / len(residuals)):.3f}")
            if before - cost < 1e-4 * before:
                break
    except KeyboardInterrupt:
        print("interrupted: going on with what was reached", file=sys.stderr)
    return p
