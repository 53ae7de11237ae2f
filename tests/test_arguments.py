"""Arguments and specifications that cannot be: refused with name, value and rule, whatever type they are of."""

from __future__ import annotations

import copy
import math
import pickle
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac import TactileSensor
from raytac.checks import check_numbers, check_seeds
from raytac.envs import PushCubeEnv, PushCubeVectorEnv
from raytac.errors import InputError, RaytacError, SpecError
from raytac.gel.surface import GelSurface
from raytac.specs import load_press, load_sensor, load_sweep
from raytac.specs.press import PressScene
from raytac.specs.sensor import SensorSpec
from raytac.specs.task_file import load_task
from raytac.world.world import TactileWorld

MINI, BALL = load_sensor("gelsight_mini"), load_press("sphere")
TASK, SWEEP = load_task("roll_ball"), load_sweep("demo")


def quick(**options: Any) -> TactileSensor:
    return TactileSensor(**{"outputs": ("height",), "pitch": 1e-3, **options})


def ragged() -> list[list[float]]:
    return [[0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    "value",
    [np.zeros((2, 2), complex), np.full((2, 2), np.datetime64("2020-01-01")), np.full((2, 2), "x"), ragged(), [[None, None]] * 2,
     np.zeros((2, 2), bool), np.zeros((2, 2), object), np.ma.masked_array(np.ones((2, 2)), mask=np.eye(2, dtype=bool)),
     np.zeros((3, 7)), 0.5, None, "x"],
    ids=["complex", "dates", "text", "ragged", "None", "truth", "objects", "masked", "shape", "scalar", "nothing", "word"],
)  # fmt: skip
def test_what_is_no_box_of_real_numbers_is_refused(value: Any) -> None:
    with pytest.raises(InputError, match="offsets = "):
        check_numbers("offsets", value, (2, 2))
    if value is not None:  # no offsets at all
        with pytest.raises(InputError, match="offsets = "):
            quick(num_envs=2).press(BALL, offsets=value)


@pytest.mark.parametrize("seeds", [[1], [1, 2, 3], [1, -1], [1, 1.5], [1, "2"], 5, "12", np.array(1)])
def test_seeds_are_whole_and_one_for_each_environment(seeds: Any) -> None:
    with pytest.raises(InputError, match="seeds"):
        quick(num_envs=2).load(BALL, seeds=seeds)
    assert check_seeds("seeds", np.array([3, 4]), 2) == [3, 4]


@pytest.mark.parametrize("pitch", [1e-9, 1e-30, 0.0, -1.0, math.nan, math.inf, 1.0, "x", True, [1e-3], 10**400])
def test_a_pitch_is_a_number_that_leaves_two_to_8192_cells(pitch: Any) -> None:
    with pytest.raises(InputError, match="pitch = "):
        quick(pitch=pitch)


@pytest.mark.parametrize("steps", [math.nan, 1.5, 0, -1, "x", None, True, 10**30])
def test_steps_are_whole(steps: Any) -> None:
    pad = quick().load(BALL)
    with pytest.raises(InputError, match="steps_per_stage = "):
        list(pad.run(steps))
    with pytest.raises(InputError, match="steps = "):
        list(pad.follow(BALL.trajectory[0], steps))


@pytest.mark.parametrize("optics", [None, 5, [], object(), SensorSpec, "nope"])
def test_an_optical_mode_is_a_name_or_can_render(optics: Any) -> None:
    with pytest.raises(InputError, match="optics = "):
        TactileSensor(optics=optics)


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("gelpad", "poisson_ratio", 0.5),
        ("gelpad", "poisson_ratio", -1.0),
        ("gelpad", "youngs_modulus", 0.0),
        ("gelpad", "youngs_modulus", math.nan),
        ("gelpad", "density", 0.0),
        ("gelpad", "friction", math.nan),
        ("gelpad", "friction", -1.0),
        ("gelpad", "size", (math.nan, 0.02)),
        ("gelpad", "thickness", None),
        ("gelpad", "bonded", "front"),
        ("coat", "roughness", 0.0),
        ("case", "floor_z", 0.1),
        ("camera", "resolution", (320.5, 240)),
        ("response", "gamma", 0.0),
        ("markers", "rows", 1.5),
        ("refraction", "ior", 0.5),
    ],
)
def test_a_sensor_changed_in_code_obeys_the_rules_of_a_file(part: str, name: str, value: Any) -> None:
    with pytest.raises(SpecError, match=f"{part}\\.{name}.* = .*must be"):
        replace(getattr(MINI, part), **{name: value})


def test_parts_that_do_not_fit_each_other_are_refused_where_a_sensor_is_made() -> None:
    thin = replace(MINI, gelpad=replace(MINI.gelpad, thickness=3e-4))
    with pytest.raises(SpecError, match=r"gelpad\.dome_radius_mm"):
        quick(sensor=thin)
    with pytest.raises(SpecError, match="gelpad = 5: must be a GelpadSpec"):
        replace(MINI, gelpad=5)
    with pytest.raises(SpecError, match=r"led\.axis"):
        replace(MINI.lights.leds[0], axis=(0.0, 0.0, 2.0))


def test_values_at_the_ends_of_a_range_are_taken_in_code_as_in_a_file() -> None:
    """0.2 mm is 0.0002 m only to rounding."""
    for thickness in (0.2 / 1000, 50 / 1000):
        assert replace(MINI.gelpad, thickness=thickness).thickness == thickness
    assert replace(MINI.gelpad, dome_radius=(math.inf, 1 / 1000)).dome_radius[0] == math.inf


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "blob"}, {"kind": []}, {"params": {}}, {"params": {"radius": -1.0}}, {"params": {"radius": math.nan}},
        {"params": {"radius": 1e6}},
        {"params": {"radius": 4e-3, "width": 1.0}}, {"params": 5}, {"quaternion": (0.0,) * 4}, {"quaternion": (math.nan,) * 4},
        {"position": (math.nan, 0.0, 0.0)}, {"position": (0.0, 0.0)}, {"mass": 0.0}, {"mass": math.nan}, {"dynamics": "loose"},
        {"poisson_ratio": 0.5}, {"youngs_modulus": 0.0},
    ],
    ids=str,
)  # fmt: skip
def test_an_object_changed_in_code_obeys_the_rules_of_a_file(changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="object"):
        replace(BALL.object, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "push"}, {"force": None}, {"depth": 1e-3}, {"force": math.nan}, {"force": math.inf}, {"duration": 0.0},
        {"duration": math.nan}, {"duration": 1e9}, {"shear": 2}, {"twist": math.nan},
    ],
    ids=str,
)  # fmt: skip
def test_a_stage_changed_in_code_obeys_the_rules_of_a_file(changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="trajectory"):
        replace(BALL.trajectory[0], **changes)
    with pytest.raises(SpecError, match="trajectory"):
        PressScene("a", BALL.object, [BALL.trajectory[0]])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"), [("density", 0.0), ("friction", math.nan), ("poisson_ratio", 0.5), ("mass", -1.0), ("kind", "blob")]
)
def test_a_body_changed_in_code_obeys_the_rules_of_a_file(name: str, value: Any) -> None:
    scene = load_task("roll_ball")
    with pytest.raises(SpecError, match=f"body\\.{name}"):
        replace(scene.bodies[1], **{name: value})
    with pytest.raises(SpecError, match=r"control_timestep_s = 0\.0031: must be a whole multiple"):
        replace(scene, control_timestep=0.0031)


@pytest.mark.parametrize(
    ("spec", "changes", "message"),
    [
        (TASK, {"name": 5}, "name = 5: must be a text"),
        (TASK, {"robot": None}, "robot: must be a RobotSpec"),
        (TASK, {"bodies": ("x",)}, "body = ('x',): must be a tuple of BodySpec"),
        (TASK, {"bodies": list(TASK.bodies)}, "must be a tuple of BodySpec"),
        (TASK.robot, {"sensor": 3}, "robot.sensor = 3: must be a name, a path or a SensorSpec"),
        (TASK.robot, {"mounts": ("x",)}, "robot.mount = ('x',): must be a tuple of MountSpec"),
        (TASK.robot, {"arm_joints": (1,)}, "robot.arm_joints = (1,): must be a tuple of names"),
        (SWEEP, {"name": None}, "name: must be a text"),
        (SWEEP, {"ranges": None}, "ranges: must be a PressRanges"),
        (SWEEP, {"sensors": ("a",)}, "sensors = ('a',): must be a tuple of one or more SensorSpec"),
        (SWEEP, {"sensors": ()}, "sensors = (): must be a tuple of one or more SensorSpec"),
        (SWEEP, {"sensors": (MINI, MINI)}, "must have names of their own"),
        (SWEEP, {"objects": ("a",)}, "objects = ('a',): must be a tuple of one or more PressScene"),
        (SWEEP, {"objects": (load_press("none"),)}, "objects = 'none': must be press scenes with an object"),
        (SWEEP, {"pad": "fine", "physics": "rigid"}, 'physics must be "ipc"'),
        (SWEEP, {"count": 0}, "count = 0: must be a whole number in [1, 1000000000]"),
        (SWEEP, {"shard_size": True}, "shard_size = True: must be a whole number"),
        (SWEEP, {"seed": 2**32}, "seed = 4294967296: must be a whole number"),
        (SWEEP, {"randomization": 5}, "randomization = 5: must be a mapping"),
        (SWEEP, {"randomization": {"foo": 1}}, "randomization = 'foo': must have known names"),
        (SWEEP, {"randomization": {"body_mass": 0.1}}, "randomization = 'body_mass': must have known names"),
        (SWEEP, {"randomization": {"gamma": None}}, "randomization.gamma = 'None': must be a number in [0, 1)"),
        (SWEEP, {"marker_perturbation": {"noise": 1.0}}, "randomization.markers = 'noise': must have known names"),
        (SWEEP, {"marker_perturbation": {"shift": 1.0}}, "randomization.markers.shift_mm = 1000.0: must be a number in [0, 20]"),
        (MINI, {"name": 5}, "name = 5: must be a text"),
        (BALL, {"name": 5}, "name = 5: must be a text"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)  # fmt: skip
def test_what_a_changed_specification_holds_is_checked(spec: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=re.escape(message)):
        replace(spec, **changes)


def test_a_changed_specification_takes_what_its_fields_name() -> None:
    world = TactileWorld(replace(TASK, robot=replace(TASK.robot, sensor=MINI.source)))
    assert world.scene is not None and world.scene.robot.sensor == MINI.source
    noise = {"noise_px": 0.5, "dropout": 0.1, "shift": 1e-3, "turn": 0.1}
    assert replace(SWEEP, marker_perturbation=noise).marker_perturbation == noise
    assert replace(SWEEP, randomization={"noise": np.float64(2.0)}).randomization == {"noise": 2.0}


def test_a_surface_of_another_sensor_is_refused() -> None:
    sensor = quick()
    with pytest.raises(InputError, match=r"surface\.grid = .*must be a grid of this sensor's pad"):
        sensor.update(GelSurface.at_rest(quick(sensor="gelsight_dome").grid))
    flat = GelSurface.at_rest(replace(sensor.grid, rest=np.zeros_like(sensor.grid.rest)))
    with pytest.raises(InputError, match=r"surface\.grid = .*must rest on this sensor's dome"):
        sensor.update(flat)
    sensor.update(GelSurface.at_rest(quick(pitch=0.5e-3).grid))  # the same pad, finer


@pytest.mark.parametrize("envs", [[5], [-1], "x", [0, 0, 0], [], 1.5, [math.nan], [[0], [0, 1]]])
def test_environments_of_an_update_exist_and_are_one_for_each_row(envs: Any) -> None:
    sensor = quick(num_envs=2)
    state = next(iter(sensor.load(BALL).run()))
    with pytest.raises(InputError, match="envs = "):
        sensor.update(state, envs=envs)


@pytest.mark.parametrize(
    "changes",
    [{"height": None}, {"height": []}, {"height": np.zeros((1, 3, 3), np.float32)}, {"contact": np.zeros((1, 2, 2), bool)},
     {"contact_centre": np.zeros(2)}],
    ids=str,
)  # fmt: skip
def test_a_surface_checks_its_arrays(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"surface\\.{next(iter(changes))}"):
        replace(GelSurface.at_rest(quick().grid), **changes)


@pytest.mark.parametrize(
    "twin", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))], ids=["copy", "deepcopy", "pickle"]
)
def test_a_copy_of_a_sensor_is_another_of_the_same_settings(twin: Any) -> None:
    one = quick(num_envs=2, seed=7)
    frame = one.press(BALL)
    other = twin(one)
    assert (other.num_envs, other.seed, other.pitch, other.outputs) == (2, 7, 1e-3, ("height",))
    np.testing.assert_array_equal(other.press(BALL).height, frame.height)


@pytest.mark.renderer
def test_what_a_copy_would_lose_is_said() -> None:
    class Mode:
        label, device = "mine", "cpu"

        def render(self, surface: GelSurface) -> Any: ...

    with pytest.raises(InputError, match=r"optics = .*cannot be copied or pickled"):
        copy.deepcopy(TactileSensor(optics=Mode()))
    dotted = TactileSensor("gelsight_mini_7x9", outputs=("height",), markers="fots", pitch=1e-3)
    copy.deepcopy(dotted)
    dotted.press(BALL)
    with pytest.raises(InputError, match=r"markers = 'fots': cannot be copied or pickled once they have a history"):
        copy.deepcopy(dotted)


@pytest.mark.parametrize("make", [PushCubeEnv, lambda **options: PushCubeVectorEnv(1, **options)], ids=["one", "vector"])
def test_a_closed_environment_says_so(make: Any) -> None:
    env = make(tactile=None, device="cpu", render_mode="rgb_array")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(InputError, match=r"environment = 'closed': must not be used after close"):
            use()


class _Odd:
    def __repr__(self) -> str:
        raise KeyError


def test_a_message_is_bounded_whatever_the_value() -> None:
    deep: list[Any] = []
    for _ in range(5000):
        deep = [deep]
    wide: Any = [0] * 80
    for _ in range(20):
        wide = [wide] * 80
    for value in (10**6000, -(10**6000), [10**6000], deep, wide, {"a": deep}, "x" * 10**6, b"x" * 10**6, _Odd(), [_Odd()]):
        for error in (
            InputError("a", value=value, rule="must be b", choices=["y" * 1000] * 3000),
            SpecError("must be b", file="c" * 5000, key="k" * 10**5, value=value),
        ):
            assert "must be b" in str(error) and len(str(error)) < 2500
    assert str(InputError("a", value={"b": [1, (2,), 0.5]}, rule="r")) == "a = {'b': [1, (2,), 0.5]}: r"
    assert len(str(RaytacError("x" * 10**6))) < 2500
