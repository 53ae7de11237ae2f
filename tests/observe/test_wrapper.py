"""``AddTactile``: an environment of one's own passes Gymnasium's check with noisy cameras, since a seed seeds them too."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from raytac.errors import InputError
from raytac.observe import ObservationSettings, Randomization, TactileObserver
from raytac.observe.wrapper import AddTactile, AddTactileVector
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


class Counting(gymnasium.vector.VectorEnv):
    """Two environments of episodes of two and three steps; a frame shows which step it is of."""

    def __init__(self, mode: AutoresetMode, sensor: TactileSensor) -> None:
        self.num_envs, self.metadata = 2, {"autoreset_mode": mode}
        self.single_observation_space = gymnasium.spaces.Box(-1.0, 9.0, (1,), np.float32)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, 2)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, 2)
        self.count, self._frames = np.zeros(2, int), {k: sensor.rest(range(k)) for k in (1, 2)}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.count[(options or {}).get("reset_mask", [True, True])] = 0
        return self._seen(), {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        mode, before = self.metadata["autoreset_mode"], self.count >= [2, 3]
        self.count = np.where(before & (mode == AutoresetMode.NEXT_STEP), 0, self.count + 1)
        ended = self.count >= [2, 3]
        if mode == AutoresetMode.SAME_STEP:
            self.count = np.where(ended, 0, self.count)
        return self._seen(), np.zeros(2), ended, np.zeros(2, bool), {}

    def _seen(self) -> np.ndarray:
        return self.count[:, None].astype(np.float32)

    def frames(self, envs: list[int] | None = None) -> dict[str, Any]:
        count = self.count if envs is None else self.count[envs]
        return {"sensor": self._frames[len(count)].with_values(wrench=np.repeat(count[:, None].astype(float), 6, axis=1))}


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_vector_begins_each_environments_stack_with_its_episode(mode: AutoresetMode) -> None:
    settings = ObservationSettings(("wrench",), stack=2, normalise=False)
    observer = TactileObserver("gelsight_mini", settings, num_envs=2)
    sensor = observer.make_sensor(device="cpu", pitch=0.4e-3)
    inner = Counting(mode, sensor)
    envs = AddTactileVector(inner, {"sensor": observer}, inner.frames)
    first, _ = envs.reset(seed=3)
    assert envs.observation_space.contains(first) and first["sensor_wrench"].shape == (2, 2, 6)
    actions = np.zeros((2, 1), np.float32)
    seen = []
    for _ in range(4):
        observed, _, ended, _, _ = envs.step(actions)
        if mode == AutoresetMode.DISABLED and ended.any():
            observed, _ = envs.reset(options={"reset_mask": ended})
        seen.append(observed["sensor_wrench"][:, :, 0].astype(int).tolist())
        np.testing.assert_array_equal(observed["sensor_wrench"][:, -1, 0], observed["observation"][:, 0])
    # Last frame and present one, of both environments: an episode begins with its first frame twice.
    next_step = [[[0, 1], [0, 1]], [[1, 2], [1, 2]], [[0, 0], [2, 3]], [[0, 1], [0, 0]]]
    same_step = [[[0, 1], [0, 1]], [[0, 0], [1, 2]], [[0, 1], [0, 0]], [[0, 0], [0, 1]]]
    assert seen == (next_step if mode == AutoresetMode.NEXT_STEP else same_step)


def test_a_vector_takes_observers_of_its_size_only() -> None:
    observer = TactileObserver("gelsight_mini", ObservationSettings(("wrench",)), num_envs=3)
    inner = Counting(AutoresetMode.NEXT_STEP, observer.make_sensor(device="cpu", pitch=0.4e-3))
    with pytest.raises(InputError, match=r"observers\['sensor'\] = 3: must be of 2 environments"):
        AddTactileVector(inner, {"sensor": observer}, inner.frames)


def test_frames_in_place_of_their_function_are_refused(wrapped: AddTactile) -> None:
    with pytest.raises(InputError, match=r"frames = 'dict'.*pass the function"):
        AddTactile(Pressing(), wrapped.observers, {})  # type: ignore[arg-type]
