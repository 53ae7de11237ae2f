"""Grain of a camera, added to finished images: seeded, one random stream an environment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.specs.sensor import NoiseSpec, SensorSpec


def check_grain(sensor: SensorSpec) -> NoiseSpec:
    """Noise of a sensor whose images shall have grain; InputError if its file gives none."""
    if sensor.noise.is_none:
        rule = f"the sensor {sensor.name!r} has no noise: give its file a [noise] table, as raytac calibrate writes and digit has"
        raise InputError("noise", value=True, rule=rule)
    return sensor.noise


class Grain:
    """Noise of a sensor's pixels, as ``NoiseSpec`` says, for images of one resolution.

    A monochrome camera has that of the first channel in all three.

    A pixel of an image with fewer pixels than the camera's is the mean of several, so its variance is smaller by their number. Draws of
    an environment do not depend on how many there are.
    """

    def __init__(self, sensor: SensorSpec, resolution: tuple[int, int], *, seed: int, batch: int) -> None:
        """``resolution``: (width, height) [px] of the whole view. InputError as of ``check_grain``."""
        noise = check_grain(sensor)
        share = min(1.0, float(np.prod(resolution)) / float(np.prod(sensor.camera.resolution)))
        level = np.arange(256)[:, None] / 255
        dark, bright = np.array(noise.dark_variance), np.array(noise.bright_variance)
        self.sigma = np.sqrt(share * (dark + (bright - dark) * level)).astype(np.float32)
        """Standard deviation [levels] by 8-bit level and channel, (256, 3)."""
        self._drawn = 1 if sensor.camera.monochrome else 3
        self._streams = [np.random.default_rng((seed, env, 0x6A1)) for env in range(batch)]

    def reseed(self, env: int, seed: int) -> None:
        """Restart the stream of an environment, as that of environment 0 with this seed."""
        self._streams[env] = np.random.default_rng((seed, 0, 0x6A1))

    def seeds(self, envs: Sequence[int] | None = None) -> list[int]:
        """Seeds of the next images of environments, all if None: one draw of each."""
        chosen = range(len(self._streams)) if envs is None else envs
        drawn = {env: int(self._streams[env].integers(2**62)) for env in dict.fromkeys(chosen)}
        return [drawn[env] for env in chosen]

    def added(self, images: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
        """8-bit images (n, H, W, 3) with the grain of ``seeds``, rounded and cut at 0 and 255."""
        result = np.empty_like(images)
        for k, seed in enumerate(seeds):
            drawn = np.random.default_rng(seed).standard_normal((*images.shape[1:3], self._drawn), np.float32)
            drawn = drawn * self.sigma[images[k], np.minimum(np.arange(3), self._drawn - 1)]
            result[k] = np.clip(np.rint(images[k] + drawn), 0, 255).astype(np.uint8)
        return result
