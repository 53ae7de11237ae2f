"""``raytac view`` as a program: it serves, tells where, and ends on Ctrl-C; what cannot be is one line."""

from __future__ import annotations

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from raytac.cli import main
from raytac.cli import view as view_module
from raytac.cli.view import ViewArgs
from raytac.physics import Rigid
from raytac.specs import SensorSpec, load_press, load_sensor
from tests.view.page_client import PageClient

ROOT = Path(__file__).parents[2]


def command(*args: str, cwd: Path) -> subprocess.Popen[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    run = [sys.executable, "-m", "raytac", "view", *args]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # A shell's job in the background hands down that Ctrl-C is ignored.
    return subprocess.Popen(run, cwd=cwd, env=env, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **pipes)


def test_it_serves_until_ctrl_c(tmp_path):
    running = command(
        "sphere", "--optics", "phong", "--resolution", "80x60", "--port", "0", "--allow-host", "gpu3.example.org:80", cwd=tmp_path
    )
    try:
        assert running.stdout is not None
        for line in running.stdout:
            assert "viser" not in line and "listening" not in line
            found = re.search(r"open http://127\.0\.0\.1:(\d+) ", line)
            if found:
                break
        else:
            raise AssertionError(running.stderr.read() if running.stderr else "")
        for name, status in (("gpu3.example.org", 200), ("evil.example", 403)):
            link = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=10.0)
            link.request("GET", "/", headers={"Host": name})
            assert link.getresponse().status == status
        client = PageClient(int(found[1]))
        client.until(lambda: "sphere · gelsight_mini · rigid+phong" in client.texts(), "the title", 60.0)
        client.until(lambda: "paused" in client.texts(), "the first image", 60.0)
        client.set("depth [mm]", 0.5)
        client.until(lambda: "held by the sliders" in client.texts() and "0.500 mm" in client.texts(), "the press", 60.0)
        client.close()
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=30.0)
    finally:
        running.kill()
    assert running.returncode == 0 and "viewer closed" in out
    [line] = err.splitlines()  # of the request that was refused, and nothing of connections that come and go
    assert "evil.example" in line
    assert list(tmp_path.iterdir()) == []  # nothing is written


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("spheer",), "did you mean 'sphere'"),
        (("sphere", "--port", "99999"), r"port = 99999: must be a whole number in \[0, 65535\]"),
        (("sphere", "--optics", "pong"), "did you mean 'phong'"),
        (("sphere", "--physics", "soft"), "choose from: rigid, ipc"),
        (("sphere", "--resolution", "big"), "WIDTHxHEIGHT"),
        (("sphere", "--markers", "fots"), "markers"),
        (("sphere", "--allow-host", "http://gpu3.example.org/"), "allow_host = .*must be a host name"),
    ],
)
def test_what_cannot_be_is_one_line_and_nothing_is_served(tmp_path, monkeypatch, capsys, args, said):
    monkeypatch.chdir(tmp_path)
    assert main(["view", *args]) == 2
    told = capsys.readouterr()
    assert re.search(said, told.err) and len(told.err.strip().splitlines()) == 1, told.err
    assert "http" not in told.out and not list(tmp_path.iterdir())


def test_a_port_that_is_taken_is_said(capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        assert main(["view", "sphere", "--device", "cpu", "--port", str(other.getsockname()[1])]) == 2
    err = capsys.readouterr().err
    assert "in use" in err and "choose another one" in err


def upright(width: int, height: int) -> SensorSpec:
    """A sensor whose image has this many pixels."""
    spec = load_sensor("gelsight_mini")
    size, middle = (width, height), (width / 2, height / 2)
    return replace(spec, camera=replace(spec.camera, resolution=size, pixel_pitch=(0.0152 / width,) * 2, principal_point=middle))


@pytest.mark.parametrize(
    ("native", "shown"), [((240, 320), (240, 320)), ((960, 1280), (240, 320)), ((120, 90), (120, 90)), ((640, 480), (320, 240))]
)
def test_the_image_is_as_large_as_can_be_drawn_and_has_the_shape_of_the_sensor(native, shown):
    assert ViewArgs(scene="sphere")._settings(upright(*native))["resolution"] == shown
    assert ViewArgs(scene="sphere", resolution="60x80")._settings(upright(*native))["resolution"] == (60, 80)


def test_an_upright_sensor_is_shown_upright(monkeypatch):
    monkeypatch.setattr(view_module, "sensor_spec", lambda name: upright(240, 320))
    args = ViewArgs(scene="sphere", optics="phong", device="cpu")
    (view,) = args._press(load_press("sphere"), Rigid()).snapshot().pads.values()
    assert view.rgb is not None and view.rgb.shape == (320, 240, 3)


def test_only_sensors_with_dots_are_offered_where_markers_are_asked_for():
    scene = load_press("sphere")
    assert "digit" in ViewArgs(scene="sphere")._menu(scene).options["sensor"]
    offered = ViewArgs(scene="sphere", markers="fots", sensor="gelsight_mini_7x9")._menu(scene).options["sensor"]
    assert set(offered) == {"gelsight_mini_7x9", "gelsight_mini_9x11", "gelsight_mini_12x16"}
