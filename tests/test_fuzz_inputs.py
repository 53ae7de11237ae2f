"""Whatever a file or an argument holds, a reader or constructor succeeds or raises one of the package's own errors, with a bounded message.

2,000 mutated TOML files (300 of them by default, all with ``-m slow``), 200 meshes, 200 array files and 500 sets of arguments. Cases are
derandomised: the same on every machine.
"""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ipc import IpcError
from raytac import TactileSensor
from raytac.assets import asset_root
from raytac.errors import RaytacError
from raytac.gel.surface import GelSurface, make_grid
from raytac.io.metrics import read_metrics
from raytac.markers import ContactSettings, MarkerPerturbation, Superposition
from raytac.observe import ObservationSettings, Randomization, TactileObserver
from raytac.optics import Phong, RayTraced, Taxim
from raytac.optics.image.mlp_weights import load_mlp
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.folder import load_calibration, save_calibration
from raytac.optics.taxim.table import PolyTable, ShadowTable, TaximConstants
from raytac.shapes.part import hfield_part, mesh_part, primitive
from raytac.specs import load_lights, load_press, load_sensor, load_sweep
from raytac.specs.marker_motion import load_marker_motion
from raytac.specs.mesh import load_mesh
from raytac.specs.press import PressScene
from raytac.specs.sweep import PressRanges
from raytac.specs.task_file import load_scene, load_task

LONGEST = 2500
"""Characters of a message, with the path of a temporary folder in it."""


def run(count: int, check: Callable[[st.DataObject], None]) -> None:
    quiet = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much, HealthCheck.large_base_example]
    settings(max_examples=count, derandomize=True, deadline=None, database=None, suppress_health_check=quiet)(
        given(st.data())(check)
    )()


def succeeds_or_refuses(call: Callable[[], object]) -> bool:
    """Whether it succeeds; any error that is not the package's own fails the test."""
    try:
        call()
    except (RaytacError, IpcError) as error:
        assert 0 < len(str(error)) <= LONGEST
        return False
    return True


# ------------------------------------------------------------------------------------------------------------------------ TOML

READERS: Mapping[str, Sequence[Callable[[Path], object]]] = {
    "scenes/sensors/gelsight_mini_7x9.toml": (load_sensor,),
    "scenes/sensors/gelsight_dome.toml": (load_sensor,),
    "lights/gelsight_mini.toml": (load_lights,),
    "scenes/press/pins.toml": (load_press, load_scene),
    "scenes/press/soft_ball.toml": (load_press,),
    "scenes/tasks/lift_cube.toml": (load_task, load_scene),
    "scenes/tasks/roll_ball.toml": (load_task,),
    "scenes/sweeps/demo.toml": (load_sweep,),
    "scenes/markers/gelsight_mini.toml": (load_marker_motion,),
}
VALUES = (
    "nan", "inf", "-inf", "-1", "0", "0.5", "1", "1e308", "-1e308", "1e-323", "true", '""', '"x"', '"gelsight_mini"', '"coin"',
    "[]", "[1]",
    "[nan, nan]", "[1, 2, 3]", "[[1]]", "{}", "{a = 1}", "2020-01-01", "12:00:00", "9" * 5000, "0x" + "F" * 5000, "[" + "1," * 3000 + "]",
    "[" * 200 + "]" * 200, "[" * 5000, "{a=" * 150 + "1" + "}" * 150, '"' + "y" * 5000 + '"', '"../../../../etc/passwd"', '"/dev/zero"',
    '"/dev/zero.toml"', '"\\u0000"', '"\\ud800"', '"a\\nb"', '"~nobody/x.toml"', '["sphere", "sphere"]', "9223372036854775808",
    "1e999999",
    "2020-13-45", ".".join(["a"] * 2000) + " = 1", "-0.0", "1_000", "'''", "\ufeff1",
)  # fmt: skip
LINES = (
    "[gelpad]",
    "[[led]]",
    "[object]",
    "[[trajectory]]",
    "[robot]",
    "[[body]]",
    "[press]",
    "zz = 1",
    'base = "gelsight_mini"',
    "[" + "a." * 900 + "a]",
)
BYTES = (b"\xff", b"\0", b"\r", b"[", b"]", b'"', b"=", b"\xef\xbb\xbf", b"{", b"#")


def mutated_toml(data: st.DataObject, text: str) -> bytes:
    """One to three changes: a value, a line taken away, doubled or put in; perhaps some bytes."""
    lines = text.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        keyed = [i for i, line in enumerate(lines) if re.match(r"\s*\w+\s*=", line)] or [0]
        i = data.draw(st.sampled_from(keyed))
        change = data.draw(st.sampled_from(["value", "value", "value", "value", "drop", "double", "insert"]))
        if change == "value":
            lines[i] = f"{lines[i].split('=')[0]}= {data.draw(st.sampled_from(VALUES))}"
        elif change == "insert":
            lines.insert(i, data.draw(st.sampled_from(LINES)))
        else:
            lines[i : i + 1] = [] if change == "drop" and len(lines) > 1 else [lines[i], lines[i]]
    content = "\n".join(lines).encode()
    if data.draw(st.integers(0, 5)) == 0:
        i = data.draw(st.integers(0, len(content)))
        content = content[:i] + data.draw(st.sampled_from(BYTES)) + content[data.draw(st.integers(i, len(content))) :]
    return content


@pytest.mark.parametrize("count", [150, pytest.param(2000, marks=pytest.mark.slow)])
def test_mutated_toml(count: int, tmp_path: Path) -> None:
    accepted = 0
    texts = {name: (asset_root("scenes").parent / name).read_text("utf-8") for name in READERS}

    def check(data: st.DataObject) -> None:
        nonlocal accepted
        name = data.draw(st.sampled_from(sorted(READERS)))
        path = tmp_path / "mutated.toml"
        path.write_bytes(mutated_toml(data, texts[name]))
        for load in READERS[name]:
            accepted += succeeds_or_refuses(lambda load=load: load(path))

    run(count, check)
    assert 0 < accepted < count, "some mutations are harmless, most are not"


# ---------------------------------------------------------------------------------------------------------------------- meshes


def spoiled(data: st.DataObject, content: bytes, tokens: Sequence[bytes]) -> bytes:
    """Some bytes flipped, cut, doubled or replaced by a token."""
    for _ in range(data.draw(st.integers(1, 3))):
        i = data.draw(st.integers(0, max(len(content) - 1, 0)))
        change = data.draw(st.sampled_from(["flip", "cut", "token", "double", "drop"]))
        if change == "flip" and content:
            content = content[:i] + bytes([content[i] ^ data.draw(st.integers(1, 255))]) + content[i + 1 :]
        elif change == "cut":
            content = content[:i]
        elif change == "token":
            content = content[:i] + data.draw(st.sampled_from(tokens)) + content[i + data.draw(st.integers(0, 8)) :]
        else:
            j = data.draw(st.integers(i, min(i + 200, len(content))))
            content = content[:i] + (content[i:j] * 2 if change == "double" else b"") + content[j:]
    return content


MESH_TOKENS = (b"nan", b"inf", b"1e400", b"-1", b"0", b"999999999999", b"\0", b"\xff\xff\xff\xff", b"\nf 0 0 0\n", b"\nmtllib fifo\n",
               b"\ncall x\n",
               b"\nelement vertex 2000000000\n", b"property list uint int vertex_indices\n", b"solid x\n", b"/")  # fmt: skip


def test_mutated_meshes(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # a reader that opened it would wait for ever
    ball = trimesh.creation.icosphere(subdivisions=1, radius=4.0)
    good: dict[str, bytes] = {}
    for name, kind, options in (
        ("a.stl", "stl", {}),
        ("b.obj", "obj", {}),
        ("c.ply", "ply", {}),
        ("d.ply", "ply", {"encoding": "ascii"}),
        ("e.stl", "stl_ascii", {}),
    ):
        content: Any = ball.export(file_type=kind, **options)
        good[name] = content if isinstance(content, bytes) else content.encode()
        (tmp_path / name).write_bytes(good[name])
        assert len(load_mesh(tmp_path / name, 1e-3)[1]) == len(ball.faces)

    def check(data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(good)))
        path = tmp_path / name
        path.write_bytes(spoiled(data, good[name], MESH_TOKENS))
        scale = data.draw(st.sampled_from([1e-3, 1e-3, 1e-3, 0.0, float("nan"), 1e300]))
        succeeds_or_refuses(lambda: load_mesh(path, scale))

    run(200, check)


# ---------------------------------------------------------------------------------------------------------------------- arrays

HEADERS = (
    ("'<f8'", "'|O'"), ("'<f8'", "'<c16'"), ("'<f8'", "'<M8[D]'"), ("'<f8'", "'<U3'"), ("'<f8'", "'|V8'"), ("'<f8'", "[('a','<f8')]"),
    ("(", "(-"), ("(", "(10000000000000"), (", ", ", 3, "), ("False", "True"), ("'shape'", "'shap'"), ("NUMPY\x01", "NUMPY\x09"),
    ("'<f4'", "'>f4'"), ("'|u1'", "'|i1'"), ("8", "'x'"),
)  # fmt: skip


def spoiled_archive(data: st.DataObject, content: bytes) -> bytes:
    """An .npz with an array spoiled, dropped or added, or with its bytes spoiled."""
    if data.draw(st.booleans()):
        return spoiled(data, content, (b"\0" * 8, b"PK\x05\x06", b"\xff" * 4))
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = data.draw(st.sampled_from(sorted(members)))
    if data.draw(st.integers(0, 4)) == 0:
        del members[name]
    else:
        members[name] = spoiled_array(data, members[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    return out.getvalue()


def spoiled_array(data: st.DataObject, content: bytes) -> bytes:
    """An .npy with another header or with its bytes spoiled."""
    if data.draw(st.booleans()):
        old, new = data.draw(st.sampled_from(HEADERS))
        return content.replace(old.encode("latin1"), new.encode("latin1"), 1)
    return spoiled(data, content, (np.float64(np.nan).tobytes(), np.float64(1e300).tobytes(), b"\x93NUMPY", b"cos\nsystem\n"))


def a_table() -> PolyTable:
    rng = np.random.default_rng(1)
    n, shape, lengths = 8, (12, 16), rng.integers(0, 5, (3, 7, 4)).astype(np.int32)
    values = rng.uniform(-50, -10, (3, 7, 4, 5)).astype(np.float32)
    values[np.arange(5) >= lengths[..., None]] = 0
    shadow = ShadowTable(np.arange(7) * 0.9, values, lengths, 0.0, 0.05e-3, 0, 0.9, 2.0, 0.2, 0.1, "drop")
    background = rng.uniform(0, 255, (*shape, 3)).astype(np.float32)
    return PolyTable(rng.normal(size=(3, n, n, 6)), rng.random((n, n)) > 0.5, background, (2e-5, 3e-5), shadow,
                     gel_map=rng.uniform(0, 3, shape), surround=rng.normal(size=(3, n, n, 6)), one_sheet=rng.normal(size=(3, n, n, 6)),
                     constants=TaximConstants(ring_dilations=3))  # fmt: skip


def test_mutated_arrays(tmp_path: Path) -> None:
    folder = tmp_path / "calibration"
    save_calibration(a_table(), folder)
    good = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".npz", ".npy", ".json")}
    assert {"polycalib.npz", "dataPack.npz", "shadowTable.npz", "raytac.npz", "gelmap.npy", "params.json"} <= set(good)
    load_calibration(folder)

    def check(data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(good)))
        spoil = {".npz": spoiled_archive, ".npy": spoiled_array}.get(Path(name).suffix)
        content = (
            spoil(data, good[name]) if spoil else spoiled(data, good[name], (b"NaN", b"9" * 5000, b"[" * 5000, b"null", b'"x"'))
        )
        (folder / name).write_bytes(content)
        succeeds_or_refuses(lambda: load_calibration(folder))
        if name.endswith(".npz"):
            succeeds_or_refuses(lambda: load_mlp(folder / name))
        succeeds_or_refuses(lambda: read_metrics(folder / "params.json"))
        (folder / name).write_bytes(good[name])

    run(200, check)


# -------------------------------------------------------------------------------------------------------------------- arguments

MINI = load_sensor("gelsight_mini")
BALL = load_press("sphere")
COARSE = {"outputs": ("height",), "pitch": 1e-3}
SENSOR = TactileSensor(num_envs=2, **COARSE)
REST = GelSurface.at_rest(SENSOR.grid)
TASK = load_task("roll_ball")


def ragged() -> np.ndarray:
    array = np.empty(2, object)
    array[:] = [[1.0], [1.0, 2.0]]
    return array


ODD: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 2, 1.5, float("nan"), float("inf"), -float("inf"), 1e-9, 1e-30, 1e300, 10**30, 10**5000, "",
    "x", "rgb", "320x240",
    "9" * 5000, b"x", [], [1], [[1], [1, 2]], (1, 2), (0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (float("nan"),) * 2, {}, {"a": 1},
    {1: 2}, 1j, object(),
    object, np.float32(1.0), np.int64(3), np.nan, np.array(1.0), np.zeros(2), np.zeros((2, 2)), np.zeros((2, 4)), np.full(2, np.nan),
    np.zeros(2, complex), np.zeros((2, 2), complex), np.full((2, 2), np.datetime64("2020-01-01")), np.full(2, "x"), ragged(),
    np.ma.masked_array(np.ones(2), mask=[True, False]), np.zeros((0,)), Path("nowhere"), Path("x.toml"), "rigid", "coarse",
    "phong", "fots", ("rgb", "rgb"),
    np.zeros((2, 2), bool),
)  # fmt: skip


def press(**own: Any) -> object:
    return TactileSensor(num_envs=2, **COARSE).press(BALL, **own)


def pressed_pad(**changes: Any) -> object:
    return TactileSensor(replace(MINI, gelpad=replace(MINI.gelpad, **changes)), **COARSE).press(BALL)


def pressed_object(**changes: Any) -> object:
    return TactileSensor(**COARSE).press(replace(BALL, object=replace(BALL.object, **changes)))


def pressed_stage(**changes: Any) -> object:
    return TactileSensor(**COARSE).press(replace(BALL, trajectory=(replace(BALL.trajectory[0], **changes),)))


def updated(**changes: Any) -> object:
    return SENSOR.update(replace(REST, **changes), [0])


CONSTRUCTORS: Mapping[Callable[..., object], Mapping[str, Any]] = {
    TactileSensor: {
        "sensor": MINI, "physics": "rigid", "optics": "phong", "outputs": ("height",), "resolution": (32, 24),
        "device": "cpu", "seed": 1, "num_envs": 2, "pitch": 1e-3, "markers": None,
    },
    RayTraced: dict(vars(RayTraced())),
    Taxim: dict(vars(Taxim())),
    Phong: dict(vars(Phong())),
    press: {"offsets": None, "depths": None, "rotations": None, "shears": None, "twists": None, "seeds": None},
    pressed_pad: {name: getattr(MINI.gelpad, name) for name in vars(MINI.gelpad)},
    pressed_object: {name: getattr(BALL.object, name) for name in vars(BALL.object)},
    pressed_stage: {name: getattr(BALL.trajectory[0], name) for name in vars(BALL.trajectory[0])},
    updated: {name: getattr(REST, name) for name in ("height", "contact", "contact_centre", "pad_from_object")},
    lambda **own: list(SENSOR.load(BALL).run(**own)): {"steps_per_stage": 1},
    lambda **own: list(SENSOR.load(BALL).follow(**own)): {"stage": BALL.trajectory[0], "steps": 1},
    lambda **own: SENSOR.update(SENSOR.rest([0, 1]).surface, **own): {"envs": [0, 1]},
    PressScene: {"name": "a", "object": BALL.object, "trajectory": BALL.trajectory, "moves": "object", "physics": None, "pad": None},
    partial(replace, MINI.camera): dict(vars(MINI.camera)),
    partial(replace, MINI.response): dict(vars(MINI.response)),
    partial(replace, MINI.coat): dict(vars(MINI.coat)),
    partial(replace, MINI.case): dict(vars(MINI.case)),
    partial(replace, MINI.markers): dict(vars(MINI.markers)),
    partial(replace, MINI.refraction): dict(vars(MINI.refraction)),
    partial(replace, MINI.lights.leds[0]): dict(vars(MINI.lights.leds[0])),
    partial(replace, MINI): {name: value for name, value in vars(MINI).items() if name not in ("name", "source")},
    PressRanges: {"depth": (1e-4, 1e-3), "x": (0.0, 0.0), "yaw": (0.0, 1.0), "tilt": (0.0, 0.1), "shear": (0.0, 1e-3),
    "twist": (0.0, 0.1)},
    partial(replace, TASK.bodies[0]): {name: value for name, value in vars(TASK.bodies[0]).items() if name != "params"},
    partial(replace, TASK.robot): dict(vars(TASK.robot)),
    partial(replace, TASK): {name: value for name, value in vars(TASK).items() if name not in ("name", "source")},
    Randomization: {name: getattr(Randomization(), name) for name in vars(Randomization())},
    MarkerPerturbation: dict(vars(MarkerPerturbation())),
    ContactSettings: dict(vars(ContactSettings())),
    Superposition: dict(vars(Superposition())),
    ObservationSettings: dict(vars(ObservationSettings())),
    TactileObserver: {"sensor": MINI, "settings": ObservationSettings(("height",)), "num_envs": 2, "randomization": None, "seed": 0},
    BakeSettings: dict(vars(BakeSettings())),
    primitive: {"kind": "box", "size": (1e-3, 1e-3, 1e-3), "object_from_part": np.eye(4)},
    mesh_part: {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "object_from_part": None},
    hfield_part: {"size": (1e-3, 1e-3, 1e-3, 1e-3), "elevation": np.zeros((3, 3)), "object_from_part": None},
    make_grid: {"gelpad": MINI.gelpad, "pitch": 1e-3},
}  # fmt: skip
CASES = [(make, name) for make, good in CONSTRUCTORS.items() for name in good]


def test_the_arguments_that_are_changed_are_good_as_they_are() -> None:
    for make, good in CONSTRUCTORS.items():
        if good:
            make(**good)


@pytest.mark.filterwarnings("ignore")
def test_arguments() -> None:
    accepted = 0

    def check(data: st.DataObject) -> None:
        nonlocal accepted
        make, name = data.draw(st.sampled_from(CASES))
        changes = {name: data.draw(st.sampled_from(ODD))}
        if data.draw(st.integers(0, 3)) == 0:
            changes[data.draw(st.sampled_from(sorted(CONSTRUCTORS[make])))] = data.draw(st.sampled_from(ODD))
        accepted += succeeds_or_refuses(lambda: make(**{**CONSTRUCTORS[make], **changes}))

    run(500, check)
    assert 0 < accepted < 500
