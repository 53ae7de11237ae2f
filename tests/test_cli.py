"""The command line: errors are one line that names the choices, and nothing is written before they are found."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import raytac
from raytac import learn
from raytac.cli import COMMANDS, main
from raytac.cli.press import PressArgs
from raytac.io.metrics import read_metrics
from raytac.specs import load_sensor
from tests.forked import run_forked

TOUCH = """
[object]
kind = "sphere"
radius_mm = 4.0
[[trajectory]]
kind = "indent"
depth_mm = 0.1
"""


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["coin", "--outputs", "rgb,hight"], ["outputs = 'hight'", "did you mean 'height'", "normals"]),
        (["coin", "--resolution", "320*240"], ["resolution", "WIDTHxHEIGHT"]),
        (["coin", "--resolution", "9" * 5000 + "x1"], ["resolution = '9999", "…", "WIDTHxHEIGHT"]),
        (["coin", "--physics", "soft"], ["physics = 'soft'", "rigid"]),
        (["coin", "--optics", "phng"], ["optics = 'phng'", "did you mean 'phong'"]),
        (
            ["coin", "--optics", "taxim", "--integrator", "reference"],
            ["integrator = 'reference'", "is no option of optics='taxim'", "calibration, shadows"],
        ),
        (["coin", "--optics", "phong", "--outputs", "rgb,layers"], ["layers", "rgb, normals, depth, height"]),
        (["coin", "--optics", "phong", "--no-shadows"], ["shadows = False", "no option of optics='phong'", "lights, background"]),
        (["coin", "--shadows", "--no-shadows"], ["contradict each other"]),
        (["coin", "--integrator", "reference", "--no-shadows"], ["shadows = False", "'reference' follows light"]),
        (["coin", "--optics", "taxim", "--calibration", "none/here"], ["none/here", "polycalib.npz"]),
        (["coin", "--integrator", "pth"], ["integrator = 'pth'", "fast, reference, path"]),
        (["coin", "--spp", "0"], ["spp = 0"]),
        (["coin", "--resolution", "99999x4"], ["resolution = 99999", "8192"]),
        (["coin", "--seed", "-1"], ["seed = -1"]),
        (["con"], ["'con'", "did you mean", "coin"]),
        (["no/such/scene.toml"], ["no/such/scene.toml", "does not exist"]),
        (["coin", "--sensor", "gelsight_min"], ["gelsight_mini"]),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(
    args: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["press", *args]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.startswith("raytac: error: ") and told.err.count("\n") == 1
    for word in words:
        assert word in told.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verbose", [False, True])
def test_warp_is_heard_only_if_asked(verbose: bool, tmp_path: Path) -> None:
    scene = tmp_path / "touch.toml"
    scene.write_text(TOUCH, encoding="utf-8")
    words = ["press", str(scene), "--physics", "ipc", "--outputs", "height", "--device", "cpu", "--out", "there"]
    done = run_forked("-m", "raytac", *words, *(["--verbose"] if verbose else []), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    heard = done.stdout + done.stderr
    assert ("Module ipc." in heard and "Warp" in heard) is verbose
    if not verbose:
        assert "Warp" not in heard and "Module" not in heard
        assert all(line.startswith("there") for line in done.stdout.splitlines())


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"raytac {raytac.__version__}\n"


BAD = ([], ["press"], ["pres", "coin"], ["press", "coin", "--device", "gpu"], ["press", "coin", "--sed", "1"])


@pytest.mark.parametrize("args", BAD)
def test_unknown_commands_and_options_exit_with_2(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main(args)
    assert exit.value.code == 2
    assert capsys.readouterr().err


def test_a_press_without_images_from_any_folder(tmp_path: Path) -> None:
    done = run_forked("-m", "raytac", "press", "sphere", "--outputs", "height", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "runs" / "press" / "sphere"
    assert done.stdout.split() == [f"runs/press/sphere/{name}" for name in ("height.npy", "metrics.json", "preview.png")]
    assert np.load(out / "height.npy").ndim == 2
    metrics = read_metrics(out / "metrics.json")
    assert metrics["mode"] == "rigid" and "time.optics_ms" not in metrics


def test_the_overview_is_one_line_a_command_and_fits_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 90
    assert {line.split()[0] for line in lines if line.startswith("  ")} == set(COMMANDS)
    for args, word in (([], "must be given"), (["pres"], "did you mean 'press'?")):
        with pytest.raises(SystemExit):
            main(args)
        assert word in capsys.readouterr().err


def test_the_force_of_a_press_has_no_negative_zero(caplog: pytest.LogCaptureFixture) -> None:
    figures = {
        "contact.max_indentation_mm": 0.7,
        "contact.force_x_n": -1e-4,
        "contact.force_y_n": 0.0,
        "contact.force_z_n": -1.996,
    }
    with caplog.at_level(logging.INFO, "raytac"):
        PressArgs(scene="coin")._log_result(figures)
    assert "force on the pad 0.00, 0.00, -2.00 N" in caplog.text


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_ctrl_c_says_that_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("raytac.cli.press.run_press", interrupted)
    assert main(["press", "coin", "--outputs", "height", "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "raytac: interrupted; nothing written\n"


def test_ctrl_c_in_a_training_says_where_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(vars(learn), "train_policies", interrupted)  # the real one needs PyTorch
    assert main(["train", "--out", str(tmp_path)]) == 130
    kept = f"checkpoints that were written are kept in {tmp_path}; the same command goes on from there"
    assert capsys.readouterr().err == f"raytac: interrupted; {kept}\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_own_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    told = capsys.readouterr().out
    assert ended.value.code == 0 and f"usage: raytac {name} " in told and "{None}" not in told


@pytest.mark.parametrize(
    ("option", "given", "rule"),
    [("--depth", "0.8mm", "must be a number, not '0.8mm'"), ("--spp", "2.5", "must be a whole number, not '2.5'")],
)
def test_an_option_that_may_be_left_out_names_what_it_takes(
    option: str, given: str, rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["press", "coin", option, given])
    assert ended.value.code == 2 and f"Error parsing {option}: {rule}" in capsys.readouterr().err


def test_the_spacing_of_the_height_map_is_chosen(tmp_path: Path) -> None:
    command = ["press", "sphere", "--outputs", "height", "--pitch", "0.4", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    size = load_sensor("gelsight_mini").gelpad.size  # (x, y); rows along y
    rows, columns = np.load(tmp_path / "out" / "height.npy").shape
    assert abs((rows - 1) * 0.4e-3 - size[1]) < 0.4e-3 and abs((columns - 1) * 0.4e-3 - size[0]) < 0.4e-3


def test_messages_of_the_library_are_lines_on_standard_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    hollow = trimesh.creation.box((6.0, 4.0, 3.0))
    hollow.update_faces(np.arange(12) > 0)
    hollow.export(tmp_path / "open.stl")
    command = ["press", str(tmp_path / "open.stl"), "--depth", "0.5", "--outputs", "height", "--out", str(tmp_path / "out")]
    assert main([*command, "--repair"]) == 0
    assert capsys.readouterr().err.startswith(f"raytac: warning: {tmp_path / 'open.stl'}: closed 1 hole")
    assert not logging.getLogger("raytac").handlers


def test_help_names_the_choices(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["press", "--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for words in ("{fast,reference,path}", "{rgb,layers,normals,depth,height,wrench,traction}", "256 if not given"):
        assert words in told


def test_out_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("mine")
    assert main(["press", "sphere", "--outputs", "height", "--out", str(tmp_path / "out")]) == 2
    assert "a file of that name exists" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_the_same_seed_gives_the_same_height(tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert main(["press", "sphere", "--outputs", "height", "--seed", "3", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a" / "height.npy").read_bytes() == (tmp_path / "b" / "height.npy").read_bytes()


def shell(command: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[bytes]:
    """A quick press to ``command``'s output, in a shell; ``{press}`` in it is the press."""
    press = f"{sys.executable} -m raytac press sphere --resolution 16x12 --outputs height --out"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | env
    return subprocess.run(
        ["bash", "-c", command.replace("{press}", press)], cwd=cwd, env=environment, capture_output=True, check=False
    )


def test_output_that_nobody_reads_ends_quietly(tmp_path: Path) -> None:
    ended = shell("{press} out | true; echo ${PIPESTATUS[0]}", tmp_path)
    assert ended.stdout == b"141\n" and ended.stderr.startswith(b"raytac: indentation") and ended.stderr.count(b"\n") == 1
    assert (tmp_path / "out" / "metrics.json").is_file()


def test_output_to_a_full_device_is_one_line(tmp_path: Path) -> None:
    ended = shell("{press} out > /dev/full", tmp_path)
    assert ended.returncode == 2 and ended.stderr.count(b"\n") == 2 and b"No space left" in ended.stderr.splitlines()[1]


def test_a_disk_that_takes_no_more_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    ended = shell("ulimit -f 20; {press} out", tmp_path)
    assert ended.returncode == 2 and ended.stderr.count(b"\n") == 1 and b"cannot be written" in ended.stderr, ended.stderr
    assert not list(tmp_path.iterdir())


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii:strict"}


@pytest.mark.parametrize("locale", [ASCII, pytest.param({}, marks=pytest.mark.slow)], ids=["ascii", "utf-8"])
def test_paths_that_are_not_utf_8_are_written(tmp_path: Path, locale: dict[str, str]) -> None:
    scene = os.fsencode(tmp_path) + b"/sc\xe8ne.toml"
    Path(os.fsdecode(scene)).write_text(TOUCH)
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
    args = [
        sys.executable,
        "-m",
        "raytac",
        "press",
        scene,
        "--resolution",
        "16x12",
        "--outputs",
        "rgb,depth,height",
        "--out",
        os.fsencode(folder),
    ]
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])} | locale
    ended = subprocess.run(args, env=env, capture_output=True, check=False)
    assert ended.returncode == 0 and ended.stderr.count(b"\n") == 1, ended.stderr
    assert {path.name for path in folder.iterdir()} == {"rgb.png", "frame.exr", "height.npy", "preview.png", "metrics.json"}
    assert read_metrics(folder / "metrics.json")["scene"] == "sc\\udce8ne"


def test_a_system_without_a_library_of_the_renderer_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(name: str) -> None:
        raise NameError("name '_drjit_ext' is not defined")

    monkeypatch.setattr("raytac.cli.importlib", SimpleNamespace(import_module=fails))
    with pytest.raises(NameError):  # no library is missing: the error is another one
        main(["press", "coin"])
    monkeypatch.setattr("raytac.device._load", lambda names: None)
    assert main(["press", "coin"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("raytac: error: ") and "apt install libatomic1" in said and said.count("\n") == 1
