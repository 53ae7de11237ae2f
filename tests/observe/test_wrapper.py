"""``AddTactile``: an environment of one's own passes Gymnasium's check with noisy cameras, since a seed seeds them too."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from raytac.errors import InputError
from raytac.observe import ObservationSettings, Randomization, TactileObserver
from raytac.observe.wrapper import AddTactile
from raytac.sensor import TactileSensor


class Pressing(gymnasium.Env):
    """Nothing but a press that is there."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return np.zeros(2, np.float32), 0.0, False, False, {}


@pytest.fixture(scope="module")
def wrapped() -> AddTactile:
    settings = ObservationSettings(("rgb", "wrench"), resolution=(16, 12), optics="phong")
    observer = TactileObserver("gelsight_mini", settings, randomization=Randomization(exposure=0.2, noise=3.0))
    sensor: TactileSensor = observer.make_sensor(device="cpu", pitch=0.4e-3)
    frame = sensor.press("sphere")
    return AddTactile(Pressing(), {"sensor": observer}, lambda: {"sensor": frame})


def test_gymnasium_finds_nothing_wrong(wrapped: AddTactile) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a wrapper, and of a wrench without bounds
        check_env(wrapped, skip_render_check=True)


def test_a_seed_gives_the_same_images_and_another_does_not(wrapped: AddTactile) -> None:
    def images(seed: int | None) -> np.ndarray:
        first, _ = wrapped.reset(seed=seed)
        second = wrapped.step(np.zeros(1, np.float32))[0]
        assert wrapped.observation_space.contains(first) and first["observation"].shape == (2,)
        assert set(first) == {"observation", "sensor_rgb", "sensor_wrench"}
        return np.stack([first["sensor_rgb"], second["sensor_rgb"]])

    one = images(4)
    np.testing.assert_array_equal(images(4), one)
    assert np.abs(images(5).astype(int) - one).max() > 5 and np.abs(images(None).astype(int) - one).max() > 5
    assert not np.array_equal(one[0], one[1])  # noise of every frame


def test_names_and_settings_that_cannot_be_are_told(wrapped: AddTactile) -> None:
    observer = wrapped.observers["sensor"]
    with pytest.raises(InputError, match=r"observers = 'sensr'.*did you mean 'sensor'"):
        AddTactile(Pressing(), {"sensr": observer}, wrapped._frames).reset()
    with pytest.raises(InputError, match="gives 'sensor_rgb', which is a key of the observation already"):
        AddTactile(wrapped, {"sensor": observer}, wrapped._frames)
    with pytest.raises(InputError, match="one environment"):
        AddTactile(Pressing(), {"sensor": TactileObserver("gelsight_mini_9x11", num_envs=2)}, wrapped._frames)
