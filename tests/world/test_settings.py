"""Settings of sensors and controls are checked where they are given, and the message names the value."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac import InputError, PadStepper, TactileReader, TactileWorld, mount
from raytac.gel.traction import cell_areas
from raytac.specs import load_sensor
from raytac.specs.sensor import NoiseSpec

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
        ({"noise": True}, "has no noise"),
    ],
)
def test_settings_of_sensors_are_checked_at_construction(
    make: Callable[..., Any], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        make(lying(collide=make is TactileReader), **settings)


def test_images_of_a_world_have_grain_on_request() -> None:
    """Of the variance that the file gives, in every environment another."""
    sensor = dataclasses.replace(load_sensor("gelsight_mini_9x11"), noise=NoiseSpec((100.0, 100.0, 100.0), (100.0, 100.0, 100.0)))
    spec = mujoco.MjSpec.from_string(f'<mujoco><option cone="elliptic"/><worldbody>{BALL}</worldbody></mujoco>')
    mounted = mount(spec, sensor, body="world", pose=np.eye(4))
    clean, noisy = (
        TactileWorld(spec, sensors=[mounted], outputs=("rgb",), resolution=(320, 240), num_envs=2, device="cpu", noise=noise)
        .observe()["sensor"]
        .rgb.astype(float)
        for noise in (False, True)
    )
    off = noisy - clean
    assert off.std() == pytest.approx(10.0, rel=0.1)
    assert abs(np.corrcoef(off[0].ravel(), off[1].ravel())[0, 1]) < 0.02


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


def test_a_world_is_not_copied_and_says_what_it_is(world: TactileWorld) -> None:
    for action in (copy.deepcopy, pickle.dumps):
        with pytest.raises(InputError, match="build one in each process"):
            action(world)
    with world as same:
        assert same is world
    world.close()
    mounted = world.composed.sensors[0]
    texts = [repr(one) for one in (world, world.step(), mounted)]
    assert max(map(len, texts)) < 400 and "2 environments" in texts[0] and "wrench={sensor: float64 (2, 6)}" in texts[1]
    assert "gelsight_mini_9x11" in texts[2]


def test_two_sensors_at_one_place_are_refused() -> None:
    spec = mujoco.MjSpec.from_string(f'<mujoco><option cone="elliptic"/><worldbody>{BALL}</worldbody></mujoco>')
    for name in ("one", "two"):
        mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4), name=name)
    with pytest.raises(InputError, match=r"'two'.*is mounted where 'one' is"):
        TactileWorld(spec)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"pose": np.eye(4) + 25.0 * np.eye(4, k=3)}, "25 m from.*in metres"), ({"mass": 22.0}, "22 kg.*in kilograms")],
)
def test_millimetres_and_grams_are_warned_of(options: dict[str, Any], message: str) -> None:
    with pytest.warns(UserWarning, match=message) as caught:
        mount(mujoco.MjSpec.from_string("<mujoco/>"), "gelsight_mini", body="world", **options)
    assert caught[0].filename == __file__


def test_a_body_in_millimetres_is_asked_for_its_units() -> None:
    ball = BALL.replace("0 0 .0052", "0 0 4.99").replace(".005", "5")
    spec = mujoco.MjSpec.from_string(f'<mujoco><option cone="elliptic"/><worldbody>{ball}</worldbody></mujoco>')
    mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4))
    with pytest.raises(InputError, match=r"bonded to; it is 10 m large: are its units metres\?"):
        TactileWorld(spec)


def test_what_the_page_on_own_models_says_of_a_frame() -> None:
    world = TactileWorld(lying(), outputs=("wrench", "traction"), markers="fots", pitch=0.4e-3)
    for _ in range(100):
        world.step()
    frame = world.observe("sensor")["sensor"]
    assert -frame.force[0, 2] == pytest.approx(0.05 * 9.81, rel=1e-3)
    np.testing.assert_array_equal(frame.wrench[:, :3], frame.force)
    areas = cell_areas(frame.surface.grid)[..., None]
    np.testing.assert_allclose((frame.traction * areas).sum((1, 2)), frame.force, atol=1e-6)
    assert frame.markers.displacement.shape == frame.markers.displacement_px.shape == (1, 99, 2)
    assert frame.surface.indentation.max() > 5e-5 and not frame.failed.any()
