"""Sweeps: every key is read in SI units, names and relative paths find their files, and what is wrong is named."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import trimesh

from raytac.errors import MeshError, SpecError
from raytac.specs import available, load_sweep

LEAST = 'objects = ["sphere"]\ncount = 3\n'
PRESS = "[press]\ndepth_mm = [0.2, 1]\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_a_mesh_is_an_object_of_a_sweep(tmp_path: Path) -> None:
    trimesh.creation.box((4.0, 6.0, 3.0)).export(tmp_path / "part.stl")
    text = 'sensors = ["gelsight_mini"]\nobjects = ["sphere", "part.stl"]\ncount = 3\n' + PRESS
    _, part = load_sweep(written(tmp_path, text)).objects
    assert part.name == "part" and part.object.triangles is not None
    assert math.isclose(float(part.object.triangles.vertices[:, 1].max()), 3e-3)  # millimetres, its middle at the origin
    with pytest.raises(MeshError, match=r"no_such\.stl.*does not exist"):
        load_sweep(written(tmp_path, text.replace("part.stl", "no_such.stl")))


@pytest.mark.parametrize("name", available("sweep"))
def test_shipped_sweeps_are_read(name: str) -> None:
    sweep = load_sweep(name)
    assert sweep.name == name and sweep.count >= 1 and sweep.source is not None


def test_every_key_comes_out_in_si(tmp_path: Path) -> None:
    (tmp_path / "ball.toml").write_text(
        '[object]\nkind = "sphere"\nradius_mm = 3\n[[trajectory]]\nkind = "indent"\ndepth_mm = 1\n'
    )
    text = """
    sensors = ["gelsight_mini", "gelsight_mini_9x11"]
    objects = ["ball.toml", "coin"]
    count = 50
    shard_size = 10
    seed = 7
    physics = "ipc"
    pad = "medium"
    optics = "raytrace"
    outputs = ["rgb", "traction"]
    markers = "surface"
    resolution = [160, 120]
    pitch_mm = 0.2
    variants = 3
    frames_per_stage = 12
    [press]
    depth_mm = [0.2, 1]
    x_mm = [-1, 2]
    yaw_deg = [-90, 180]
    tilt_deg = [0, 10]
    shear_mm = [0.1, 0.5]
    twist_deg = [-3, 3]
    [randomization]
    led_power = 0.1
    noise = 2
    [randomization.markers]
    noise_px = 0.5
    shift_mm = 0.3
    turn_deg = 180
    """
    sweep = load_sweep(written(tmp_path, text))
    assert [s.name for s in sweep.sensors] == ["gelsight_mini", "gelsight_mini_9x11"]
    assert [s.name for s in sweep.objects] == ["ball", "coin"] and sweep.objects[0].object.params["radius"] == 3e-3
    assert (sweep.count, sweep.shard_size, sweep.seed, sweep.variants) == (50, 10, 7, 3)
    assert (sweep.physics, sweep.pad, sweep.optics, sweep.markers) == ("ipc", "medium", "raytrace", "surface")
    assert sweep.frames_per_stage == 12
    assert sweep.outputs == ("rgb", "traction") and sweep.resolution == (160, 120) and sweep.pitch == 0.2e-3
    ranges = sweep.ranges
    assert ranges.depth == (0.2e-3, 1e-3) and ranges.x == (-1e-3, 2e-3) and ranges.y == (0.0, 0.0)
    assert ranges.yaw == pytest.approx((-math.pi / 2, math.pi)) and ranges.shear == (0.1e-3, 0.5e-3)
    assert sweep.randomization == {"led_power": 0.1, "noise": 2.0}
    assert sweep.marker_perturbation == pytest.approx({"noise_px": 0.5, "shift": 0.3e-3, "turn": math.pi})


def test_a_short_sweep_is_rigid_with_the_table(tmp_path: Path) -> None:
    sweep = load_sweep(written(tmp_path, LEAST + PRESS))
    assert (sweep.physics, sweep.optics, sweep.markers, sweep.resolution) == ("rigid", "taxim", None, None)
    assert not sweep.randomization and not sweep.marker_perturbation


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LEAST, "press: missing table [press]"),
        (LEAST + "[press]\n", "press.depth_mm: missing key"),
        (LEAST + "[press]\ndepth_mm = [1, 0.2]", "press.depth_mm = [1.0, 0.2]: must be the least and the greatest"),
        (LEAST + "[press]\ndepth_mm = [0.2]", "press.depth_mm = [0.2]: must be 2 numbers"),
        (LEAST + PRESS + "depth = 3", "press.depth: unknown key; did you mean 'depth_mm'"),
        ("count = 3\n" + PRESS, "objects: missing key: must be a list"),
        ("objects = []\ncount = 3\n" + PRESS, "objects = []"),
        ('objects = ["sphere", "sphere"]\ncount = 3\n' + PRESS, "none twice"),
        ('objects = "sphere"\ncount = 3\n' + PRESS, "objects = 'sphere': must be a list"),
        ('objects = ["sphre"]\ncount = 3\n' + PRESS, "did you mean 'sphere'"),
        ('objects = ["none"]\ncount = 3\n' + PRESS, "objects = 'none': must be press scenes with an object"),
        ('objects = ["sphere"]\ncount = 0\n' + PRESS, "count = 0"),
        ('pad = "fine"\n' + LEAST + PRESS, "physics must be"),
        (LEAST + PRESS + "[randomization]\nled_power = 1.5", "randomization.led_power = 1.5"),
        (LEAST + PRESS + "[randomization.markers]\ndropout = 1", "randomization.markers.dropout = 1"),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=re.escape(message)):
        load_sweep(written(tmp_path, text))


def test_files_of_one_stem_are_refused(tmp_path: Path) -> None:
    (tmp_path / "sphere.toml").write_text(
        '[object]\nkind = "sphere"\nradius_mm = 3\n[[trajectory]]\nkind = "indent"\ndepth_mm = 1\n'
    )
    with pytest.raises(SpecError, match="names of their own"):
        load_sweep(written(tmp_path, 'objects = ["sphere", "sphere.toml"]\ncount = 3\n' + PRESS))
