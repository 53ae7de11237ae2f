"""Settings of sensors and controls are checked where they are given, and the message names the value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac import InputError, PadStepper, TactileReader, TactileWorld, mount

BALL = '<body name="ball" pos="0 0 .0052"><freejoint/><geom size=".005" mass=".05"/></body>'


def lying(*, collide: bool = False) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(f'<mujoco><option cone="elliptic"/><worldbody>{BALL}</worldbody></mujoco>')
    mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4), collide=collide)
    return spec.compile()


@pytest.fixture(scope="module")
def world() -> TactileWorld:
    return TactileWorld(lying(), outputs=("wrench",), pitch=0.4e-3, num_envs=2)


@pytest.mark.parametrize("make", [TactileWorld, PadStepper, TactileReader])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"outputs": ("rbg",)}, "rgb"),
        ({"outputs": ("force",)}, "always comes.*'wrench' adds"),
        ({"markers": "fot"}, "fots"),
        ({"optics": "raytrac"}, "raytrace"),
        ({"pitch": 0.4}, "in metres"),
    ],
)
def test_settings_of_sensors_are_checked_at_construction(make: Callable[..., Any], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(lying(collide=make is TactileReader), **settings)


def test_nothing_to_touch_is_refused() -> None:
    with pytest.raises(InputError, match=r"touches.*must name one body or more"):
        TactileWorld(lying(), touches=[])


def test_one_sensor_may_be_named_without_a_list(world: TactileWorld) -> None:
    assert list(world.observe("sensor")) == ["sensor"]
    with pytest.raises(InputError, match="'left'"):
        world.observe("left")


def test_errors_of_controls_name_the_shape_or_the_number() -> None:
    drivable = TactileWorld("ball_rolling", outputs=("wrench",), num_envs=2)
    count = drivable.model.nu
    with pytest.raises(InputError, match=rf"\(4, {count}\).*shape.*\({count},\) or \(2, {count}\)"):
        drivable.step(np.zeros((4, count)))
    bad = np.zeros((2, count))
    bad[1, 0] = np.nan
    with pytest.raises(InputError, match=r"control\[1, 0\].*nan"):
        drivable.step(bad)
