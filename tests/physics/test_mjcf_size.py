"""Models that ask for more than there is are refused before they are compiled."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from raytac.errors import InputError, SpecError
from raytac.physics.geoms import body_parts, load_mjcf
from raytac.physics.mjcf_size import check_mjcf_size
from raytac.physics.objects import object_parts
from raytac.specs.press import ObjectSpec

BALL = '<mujoco><worldbody><body name="b"><geom size="0.004"/></body></worldbody></mujoco>'

URDF = '<robot name="r"><link name="l"><collision><geometry><mesh filename="pipe.stl"/></geometry></collision></link></robot>'


def model(tmp_path: Path, text: str, name: str = "m.xml") -> Path:
    (tmp_path / name).write_text(text)
    return tmp_path / name


def in_body(text: str) -> str:
    return BALL.replace("<geom", f"{text}<geom")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '<mujoco><asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset></mujoco>',
            "at most 4194304 nodes",
        ),
        (in_body('<replicate count="1000000000"><geom size=".004"/></replicate>'), "1e[+]09 copies, and at most 100000"),
        (
            in_body("<replicate count='1000'><replicate count='1000'><geom size='.004'/></replicate></replicate>"),
            "1e[+]06 copies",
        ),
        (in_body('<composite type="particle" count="2000 2000 2000"/>'), "copies"),
        (in_body(f'<replicate count="{"9" * 5000}"><geom size=".004"/></replicate>'), "copies"),
        (in_body('<replicate count="&#49;000000000"><geom size=".004"/></replicate>'), "copies"),
        (in_body(f'<replicate count="&#{"9" * 5000};"><geom size=".004"/></replicate>'), "must be whole numbers"),
        (
            in_body('<replicate count="1000000000"><geom size=".004"/></replicate>').replace("<mujoco>", '<mujoco model="<!--">')
            + "<!-- -->",
            "copies",
        ),
        (in_body('<!-- a -- comment --><replicate count="1000000000"><geom size=".004"/></replicate>'), "copies"),
        (in_body('<replicate count="1e9"><geom size=".004"/></replicate>'), "must be whole numbers"),
        ("<mujoco>" + "<body>" * 20000, "at most 200 elements within each other"),
    ],
    ids=[
        "hfield",
        "replicate",
        "nested",
        "composite",
        "digits",
        "entity",
        "long entity",
        "quoted comment",
        "comment",
        "float",
        "deep",
    ],
)
def test_a_model_that_asks_for_too_much_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_mjcf(model(tmp_path, text))
    assert len(str(caught.value)) < 1000
    model(tmp_path, text)
    outer = model(tmp_path, BALL.replace("<worldbody>", '<include file="m.xml"/><worldbody>'), "outer.xml")
    with pytest.raises(InputError, match=message):
        load_mjcf(outer)


def test_devices_and_pipes_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    text = '<mujoco><asset><mesh name="a" file="pipe.stl"/></asset><worldbody/></mujoco>'
    for changed in (
        text,
        text.replace("<asset>", f'<compiler meshdir="{tmp_path}"/><asset>'),
        '<mujoco><include file="pipe.stl"/></mujoco>',
        text.replace("<mesh", '<texture type="cube" fileup="pipe.stl"/><mesh').replace(
            'file="pipe.stl"/></', 'file="none.stl"/></'
        ),
        URDF,
        URDF.replace("pipe.stl", "package://robot/meshes/pipe.stl"),
        URDF.replace("pipe.stl", r"meshes\pipe.stl"),
    ):
        with pytest.raises(InputError, match=r"pipe\.stl: must be a regular file"):
            check_mjcf_size(model(tmp_path, changed))


@pytest.mark.parametrize(
    "part",
    ["<!--", "<![CDATA[", "<?", "<!", "<", "<a ", "<a b='", '<a "', """<a "'""", '<a" "', '<a b="c" '],
)
def test_what_is_not_closed_is_read_once(part: str, tmp_path: Path) -> None:
    """A time that grows with the square of the length would be many minutes; the limit is no measure of speed."""
    read_in_time(model(tmp_path, part * (1_000_000 // len(part))))


@pytest.mark.parametrize("part", ["b", " ", "b ", "=", "b= ", "b='' ", "/"])
def test_a_long_tag_is_read_once(part: str, tmp_path: Path) -> None:
    read_in_time(model(tmp_path, f"<a {part * (1_000_000 // len(part))}>"))


def read_in_time(path: Path) -> None:
    code = "import sys; from raytac.physics.mjcf_size import check_mjcf_size; check_mjcf_size(sys.argv[1])"
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    subprocess.run([sys.executable, "-c", code, str(path)], env=env, check=True, timeout=60)


def test_what_is_small_passes(tmp_path: Path) -> None:
    """Comments with two hyphens, tags over lines, both kinds of quotes, counts of some."""
    text = in_body("<!-- -- --><replicate\n count='3'\n offset=\"0.01 0 0\"><geom size='.001'/></replicate>")
    check_mjcf_size(path := model(tmp_path, text))
    assert len(body_parts(load_mjcf(model(tmp_path, text.replace("<!-- -- -->", ""))), "b")) == 4
    check_mjcf_size(model(tmp_path, '<mujoco><include file="m.xml"/></mujoco>'))  # of itself: MuJoCo says so
    check_mjcf_size(tmp_path / "none.xml")
    assert path.exists()


@pytest.mark.parametrize("size", ["1e30", "inf", "1001"])
def test_a_sphere_of_any_size_is_not_pressed(size: str, tmp_path: Path) -> None:
    path = model(tmp_path, BALL.replace("0.004", size))
    with pytest.raises(SpecError, match=r"lengths in \(0, 1000\] m"):
        object_parts(ObjectSpec("mjcf", {"path": str(path), "body": "b"}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1))
