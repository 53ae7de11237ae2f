"""``raytac compare-real`` and ``raytac calibrate DATASET``: scores of known images, and input that is refused with nothing written."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.calibrate.direct_fit import FitSettings
from raytac.calibrate.imprint import RIGID_PAD, press_surface
from raytac.calibrate.model_fits import MODES, fit_models
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.presses import RealPresses, by_press
from raytac.cli import main
from raytac.cli.calibrate import CalibrateArgs
from raytac.cli.compare_real import CompareRealArgs
from raytac.cli.fit_options import FROM_SCRATCH, OWN_LEDS, FitOptions, read_data
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.io.images import read_png, write_png
from raytac.optics import RayTraced
from raytac.report.markers import run_calibrate_markers
from raytac.report.real import real_splits, table_text
from raytac.report.real_calibration import run_calibrate_optics
from raytac.report.real_fits import ABLATIONS, RealSettings
from raytac.report.real_imprints import imprint_metrics, imprint_table
from raytac.report.real_scores import noise_floor, outliers, press_rows, press_scores, summary
from raytac.sensor import TactileSensor
from raytac.specs import load_sensor
from raytac.specs.sensor import UNMIXED

CIRCLES = np.array([[120.0, 100.0, 30.0], [200.0, 140.0, 28.0]])
SENSOR = load_sensor("gelsight_mini")


def shots() -> Photographs:
    presses = np.full((2, 240, 320, 3), 100.0)
    return Photographs(np.full((240, 320, 3), 98.0), presses, CIRCLES, np.full(2, 3.155e-3))


def test_errors_are_those_of_the_regions() -> None:
    """An image that is 6 levels off in the disc, 3 in the ring, and right elsewhere."""
    real = shots()
    rho = real.distance(SENSOR)[..., None]
    images = real.presses + np.where(rho < 1, 6.0, np.where(rho < 2, -3.0, 0.0))
    first, second = press_scores(SENSOR, images, real)
    assert (first["contact_mae"], first["contact_rmse"], first["ring_mae"]) == pytest.approx((6, 6, 3))
    x, y, r = CIRCLES[0]
    v, u = np.mgrid[:240, :320] + 0.5
    box = (u > x - r - 15) & (u < x + r + 16) & (v > y - r - 15) & (v < y + r + 16)
    square = np.mean((images - real.presses)[0][box] ** 2)
    assert first["box_psnr"] == pytest.approx(20 * np.log10(255 / np.sqrt(square)), abs=0.2)
    assert summary([first, second])["frame_mae"] == pytest.approx((first["frame_mae"] + second["frame_mae"]) / 2)
    assert noise_floor(SENSOR, real) == pytest.approx(2.0)
    metrics = {"raytrace.contact_mae": 6.0, "labelled.raytrace.contact_mae": 7.0, "labelled.raytrace.ring_mae": 4.0}
    text = table_text({**metrics, "noise_floor": 2.0}, ())
    assert "| ray tracer | 6.00 |" in text and "| 7.00, 4.00 |" in text and "Noise floor: 2.00" in text


def test_errors_of_the_ring_are_told_apart() -> None:
    """Red lies 3 levels low, green alternates by 2 levels around 1 level high, blue is right."""
    real = shots()
    wave = np.where(np.indices((240, 320)).sum(0) % 2, -1.0, 3.0)
    off = np.stack([np.full((240, 320), -3.0), wave, np.zeros((240, 320))], axis=-1)
    score = press_scores(SENSOR, real.presses + off, real)[0]
    by_channel = [score[f"ring_mae_{name}"] for name in ("red", "green", "blue")]
    assert by_channel == pytest.approx([3.0, 2.0, 0.0], abs=0.02) and score["ring_mae"] == pytest.approx(5 / 3, abs=0.01)
    skewed = np.where(np.arange(320) % 4 == 0, 9.0, 1.0)[:, None] * np.array([-1.0, 1.0, 0.0])
    score = press_scores(SENSOR, real.presses + skewed, real)[0]
    assert score["ring_even"] == pytest.approx(2 / 3), "the median leaves out what few pixels show"


def test_errors_are_listed_by_press() -> None:
    """In the order of the presses, folds after each other; labelled circles are not among them."""
    scores = [{"contact_mae": float(k), "ring_mae": 2.0 * k, "frame_mae": 9.0} for k in range(3)]
    both = {"press": {"raytrace": scores[:2], "mlp": scores[1:]}, "labelled_press": {"raytrace": scores[:2]}}
    lines = press_rows({"press": ["a", "b"]}, both)
    assert lines[0] == "split,press,mode,contact_mae,ring_mae"
    assert lines[1:3] == ["press,a,raytrace,0.0000,0.0000", "press,b,raytrace,1.0000,2.0000"]
    assert lines[3:] == ["press,a,mlp,1.0000,2.0000", "press,b,mlp,2.0000,4.0000"]
    with pytest.raises(ValueError, match="shorter"):
        press_rows({"press": ["a", "b", "c"]}, both)


def data_set(folder: Path, count: int, radius: float = 30.0, shape: tuple[int, int] = (240, 320)) -> Path:
    image = np.full((*shape, 3), 100, np.uint8)
    names = ["background.png", *(f"6.310mm_{k:02d}.png" for k in range(count))]
    for name in names:
        write_png(folder / name, image)
    rows = [f"6.310mm,{k},{100 + 10 * k},{100 + 5 * k},{radius}" for k in range(count)]
    (folder / "labels.csv").write_text("\n".join(["diameter,index,cx_px,cy_px,r_px", *rows]) + "\n", "utf-8")
    return folder


@pytest.mark.parametrize("command", ["calibrate", "compare-real"])
def test_data_that_cannot_be_fitted_are_refused_with_nothing_written(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    cases = {
        "few": (dict(count=3), "too few"),
        "wide": (dict(count=6, radius=52.0), "smaller than the ball"),
        "small": (dict(count=6, shape=(120, 160)), "sensor's size"),
    }
    for name, (how, message) in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        data_set(folder, **how)  # type: ignore[arg-type]
        assert main([command, str(folder), "--device", "cpu", "--out", str(out)]) == 2, name
        assert message in capsys.readouterr().err, name
    broken = tmp_path / "few" / "6.310mm_01.png"
    broken.write_bytes(b"no image")
    assert main([command, str(broken.parent), "--device", "cpu", "--out", str(out)]) == 2
    assert "cannot be read as an image" in capsys.readouterr().err
    assert main([command, str(tmp_path / "none"), "--out", str(out)]) == 2
    assert not out.exists() and not list(tmp_path.glob("*.partial"))


def test_halves_too_small_to_choose_a_prior_in_are_told_before_any_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six presses on either half of the pad are enough to fit to, but not for a choice that halves them again."""
    (tmp_path / "data").mkdir()
    command = ["compare-real", str(data_set(tmp_path / "data", count=12)), "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    assert "'left_right' to: at least 8, or 4 with a named prior" in capsys.readouterr().err
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob("*.partial"))


def test_options_of_the_other_thing_to_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, data = tmp_path / "out", tmp_path / "data"
    data.mkdir()
    data_set(data, count=6)
    cases = [([str(data)], ["--quick"], "'markers'"), ([str(data)], ["--level", "coarse"], "'markers'")]
    cases += [(["markers"], ["--model", "mlp"], "a data set"), (["markers"], ["--sides", "4,2,3"], "a data set")]
    for what, option, owner in cases:
        assert main(["calibrate", *what, *option, "--device", "cpu", "--out", str(out)]) == 2, option
        told = capsys.readouterr().err
        assert option[0][2:] in told and "belongs to `calibrate` with" in told and f"with {owner}, not" in told
    assert not out.exists()


@pytest.fixture(scope="module")
def of_itself(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Nine presses as a data set, images of the shipped Mini itself without cast shadows, and the one at rest."""
    data, grid = tmp_path_factory.mktemp("data"), make_grid(SENSOR.gelpad, 0.12e-3)
    places = [(x, y) for y in (70, 120, 170) for x in (80, 160, 240)]
    circles = np.array([(x, y, 26.0 + k % 3 * 3) for k, (x, y) in enumerate(places)])
    tracer = RayTraced(shadows=False).build(SENSOR, device="cpu")
    photographs = {"background": tracer.render(GelSurface.at_rest(grid)).rgb}
    for k in range(len(circles)):
        surface = press_surface(SENSOR, grid, circles[k : k + 1], np.array([3.155e-3]), RIGID_PAD)
        photographs[f"6.310mm_{k:02d}"] = tracer.render(surface).rgb
    for name, rgb in photographs.items():
        assert rgb is not None
        write_png(data / f"{name}.png", rgb[0])
    rows = [f"6.310mm,{k},{x},{y},{r}" for k, (x, y, r) in enumerate(circles)]
    (data / "labels.csv").write_text("\n".join(["diameter,index,cx_px,cy_px,r_px", *rows]) + "\n", "utf-8")
    background = photographs["background"]
    assert background is not None
    return data, background[0]


ONE_ROUND = ["--sides", "own", "--starts", "1", "--rounds", "1", "--prior", "tied", "--device", "cpu"]


@pytest.fixture
def fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the steps that a fit may take: one that begins where the light comes from is near its end by then."""
    monkeypatch.setattr("raytac.calibrate.ray_fit.FIRST", 30)


@pytest.mark.usefixtures("fewer_steps")
def test_calibrate_writes_a_sensor_that_needs_no_photograph(of_itself: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    """What is written renders fitted presses, and others, to about a level, wherever the folder is copied."""
    (data, background), made = of_itself, tmp_path / "made"
    mine = tmp_path / "mine" / "own.toml"
    mine.parent.mkdir()
    mine.write_text('base = "gelsight_mini"\n[markers]\nrows = 1\ncolumns = 1\nradius_mm = 0.2\n', "utf-8")
    assert main(["calibrate", str(data), *ONE_ROUND, "--sensor", str(mine), "--holdout", "3", "--out", str(made)]) == 0
    out = shutil.copytree(made, tmp_path / "copied" / "elsewhere")
    assert not any(str(tmp_path) in path.read_text("utf-8") for path in out.glob("*.toml"))
    shutil.rmtree(made)
    shutil.rmtree(mine.parent)
    metrics = json.loads((out / "metrics.json").read_text("utf-8"))
    assert (metrics["presses.fitted"], metrics["presses.held_out"]) == (6, 3)
    for key, most in {"fitted": 1.1, "fitted.alone": 1.1, "held_out": 1.5, "held_out.alone": 1.5}.items():
        assert metrics[f"{key}.contact_mae"] < most and metrics[f"{key}.ring_mae"] < 0.6, (key, metrics)
    written = load_sensor(out / "sensor.toml")
    assert all(len(found) == 28 for found in written.response.shading)
    assert (written.markers.rows, written.gelpad, written.marker_motion) == (1, SENSOR.gelpad, SENSOR.marker_motion)
    # Fitted without cast shadows, and so rendered, though the sensor that the fit began from casts them.
    assert SENSOR.optics.shadows and not written.optics.shadows
    images = [
        np.array(
            TactileSensor(written, device="cpu", resolution=(80, 60), optics=RayTraced(shadows=shadows)).press("pins").rgb, int
        )
        for shadows in (None, False, True)
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert (np.abs(images[0] - images[2]) > 8).mean() > 0.01
    rest = RayTraced().build(written, device="cpu").render(GelSurface.at_rest(make_grid(SENSOR.gelpad, 0.12e-3))).rgb
    assert rest is not None
    off = np.abs(rest[0].astype(int) - background)
    assert off.mean() < 0.5 and off.max() <= 8, (off.mean(), off.max())


@pytest.mark.usefixtures("fewer_steps")
def test_photographs_of_ones_own_become_a_sensor(
    of_itself: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder of PNGs and the ball's diameter are enough: circles are searched for, and lights are fitted to them."""
    (data, _), photos, out = of_itself, tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for path in data.glob("*.png"):
        shutil.copy(path, photos / path.name.replace("6.310mm_", "photo "))
    asked = ["calibrate", str(photos), *ONE_ROUND, "--holdout", "3", "--out", str(out)]
    assert main(asked) == 2 and "--ball-diameter-mm" in capsys.readouterr().err
    inside = [*asked[:-1], str(photos), "--ball-diameter-mm", "6"]
    assert main(inside) == 2 and "must not be the folder of the photographs" in capsys.readouterr().err
    assert main([*asked, "--ball-diameter-mm", "6.31"]) == 0
    said = capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text("utf-8"))
    assert f"| held out | {metrics['held_out.contact_mae']:.2f} | {metrics['held_out.ring_mae']:.2f} |" in said
    assert metrics["held_out.contact_mae"] < 2.5 and metrics["held_out.ring_mae"] < 1.0, metrics
    with (data / "labels.csv").open() as labels, (out / "circles.csv").open() as result:
        truth, circles = (list(csv.DictReader(file)) for file in (labels, result))
    for one, other in zip(truth, circles, strict=True):
        assert other["press"] == f"photo {int(one['index']):02d}"
        off = [abs(float(one[key]) - float(other[key])) for key in ("cx_px", "cy_px", "r_px")]
        assert max(off[:2]) < 1.5 and off[2] < 2.5, (one, other)
    drawn = read_png(out / "fit.png").astype(int)
    assert drawn.shape[1] > 250 and drawn.std() > 20
    assert load_sensor(out / "sensor.toml").lights.leds


@pytest.mark.slow
def test_compare_real_scores_every_mode(of_itself: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    (data, _), out = of_itself, tmp_path / "out"
    args = ["--folds", "3", "--tested", "1", "--no-regions", "--no-ablations", "--imprint", "fitted,rigid"]
    assert main(["compare-real", str(data), *ONE_ROUND, *args, "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text("utf-8"))
    for mode in MODES:
        assert metrics[f"{mode}.ms"] > 0 and metrics[f"{mode}.contact_mae"] > 0, mode
    for mode in ("raytrace", "raytrace_alone"):
        assert metrics[f"{mode}.contact_mae"] < 1.5 < metrics["background.contact_mae"], (mode, metrics)
    text = (out / "real.md").read_text("utf-8")
    assert f"| ray tracer, no photograph | {metrics['raytrace_alone.contact_mae']:.2f} |" in text
    assert (out / "real.png").stat().st_size > 10_000
    rows = [line.split(",") for line in (out / "presses.csv").read_text("utf-8").splitlines()]
    errors = [float(row[3]) for row in rows if row[0] == "press" and row[2] == "raytrace"]
    assert np.mean(errors) == pytest.approx(metrics["raytrace.contact_mae"], abs=1e-4) and len(set(errors)) == len(errors) > 1
    # The images are of the profile that is fitted, at the depth of the circle; the other imprints are of other surfaces.
    fitted, rigid = metrics["imprint.fitted.raytrace.contact_mae"], metrics["imprint.rigid.raytrace.contact_mae"]
    assert fitted < 1.5 and fitted < rigid < metrics["background.contact_mae"]
    assert (metrics["imprint.rigid.presses"], metrics["imprint.rigid.unreached"]) == (3, 0)
    assert metrics["imprint.rigid.depth_mm"] > metrics["imprint.rigid.overlap_depth_mm"]
    assert f"| {metrics['imprint.rigid.depth_mm']:.3f} | {rigid:.2f} |" in text


def test_imprints_are_means_over_presses_that_reached_their_circle() -> None:
    reached = {"reached": 1.0, "overlap_depth_mm": 0.6, "depth_mm": 0.9, "depth_over_overlap": 1.5}
    scores = {
        "rigid": [reached, {"reached": 0.0, "overlap_depth_mm": 2.0}],
        "rigid.raytrace": [{"contact_mae": 3.0, "contact_rmse": 4.0, "ring_mae": 2.0, "frame_mae": 1.0}],
        "ipc": [{"reached": 0.0, "overlap_depth_mm": 2.0}],
        "ipc.raytrace": [],
    }
    metrics = imprint_metrics(scores)
    assert (metrics["imprint.rigid.presses"], metrics["imprint.rigid.unreached"], metrics["imprint.ipc.unreached"]) == (2, 1, 1)
    assert (metrics["imprint.rigid.depth_mm"], metrics["imprint.rigid.overlap_depth_mm"]) == (0.9, 0.6)
    assert "imprint.ipc.raytrace.contact_mae" not in metrics
    (_, _, row, _) = imprint_table(metrics)
    assert "1 presses without" in row and row.endswith("| 0.900 | 3.00 | 4.00 | 2.00 | 1.00 |")


def test_presses_at_the_border_are_split_apart() -> None:
    """Folds of the others do not depend on them; each is tested once, and only fitted from half to half and shallow to deep."""
    rng = np.random.default_rng(0)
    inner = np.column_stack([rng.uniform(60, 260, 20), rng.uniform(60, 180, 20), rng.uniform(20, 40, 20)])
    edge = np.array([[5.0, 100, 30], [315, 100, 30], [10, 60, 39.9], [160, 2, 20], [310, 200, 45]])
    circles = np.insert(inner, [3, 3, 9, 15, 20], edge, axis=0)
    image = np.zeros((240, 320, 3), np.uint8)
    presses = RealPresses(image, np.repeat(image[None], 25, 0), np.full(25, 4e-3), circles, tuple(map(str, range(25))))
    whole = presses.fully_visible
    assert whole.sum() == 20
    splits = real_splits(presses, whole, RealSettings(folds=5))
    visible = np.flatnonzero(whole)
    for (_, (train, test)), (own_train, own_test) in zip(splits[:5], by_press(20, 5), strict=True):
        np.testing.assert_array_equal(test[whole[test]], visible[own_test])
        np.testing.assert_array_equal(train[whole[train]], visible[own_train])
        assert not set(train) & set(test) and len(train) + len(test) == 25
    tested = np.concatenate([test for _, (_, test) in splits[:5]])
    assert sorted(tested) == list(range(25))
    for kind, (_, test) in splits[5:]:
        assert whole[test].all(), kind
    kinds = dict(splits[5:])
    assert circles[kinds["left_right"][0], 0].max() < 160 <= circles[kinds["left_right"][1], 0].min()
    assert circles[kinds["shallow_deep"][0], 2].max() <= circles[kinds["shallow_deep"][1], 2].min()


def test_outliers_are_named_with_their_reasons() -> None:
    moved = np.array([[0.0, 0, 0], [0, -5, 0], [0, 0, 3.9]])
    three = Photographs(shots().background, np.zeros((3, 240, 320, 3)), np.full((3, 3), 100.0), np.full(3, 3e-3))
    found = outliers(["a", "b", "c"], np.array([2.0, 2.2, 5.0]), three.circles + moved, three)
    assert list(found) == ["b", "c"]
    assert found["b"] == "its circle is 5.0 px from the fitted one, more than 4"
    assert found["c"] == "its error in the contact is more than 2 times the median"


def test_photographs_of_another_size_need_the_side_of_a_pixel(tmp_path: Path) -> None:
    """The same command takes them; a fit begins from one response; presses at the border are read with the others."""
    data = data_set(tmp_path, count=6, radius=40.0, shape=(480, 640))
    with pytest.raises(InputError, match="say --pixel-mm"):
        read_data(data, "gelsight_mini", None, "1,1,1")
    spec, presses, photographs, said = read_data(data, "gelsight_mini", None, "1,1,1", pixel_mm=0.03)
    assert spec.camera.resolution == (640, 480) and spec.camera.pixel_pitch == pytest.approx((0.03e-3, 0.03e-3))
    assert spec.camera.principal_point == (320.0, 240.0) and len(presses) == len(photographs.presses) == 6 and not said
    assert spec.response.gamma == 1.4 and not any(spec.response.black_level) and not any(map(len, spec.response.shading))
    own = read_data(data, "gelsight_mini", None, "1,1,1", pixel_mm=0.03, own_response=True)[0]
    assert own.response == SENSOR.response
    with pytest.raises(InputError, match=r"in \(0, 1\) mm"):
        read_data(data, "gelsight_mini", None, "1,1,1", pixel_mm=30.0)
    wide = tmp_path / "wide"
    wide.mkdir()
    with pytest.raises(InputError, match="sides are as 320 to 240"):
        read_data(data_set(wide, count=6, shape=(240, 640)), "gelsight_mini", None, "1,1,1", pixel_mm=0.03)
    rows = (data / "labels.csv").read_text("utf-8").replace("6.310mm,0,100,100", "6.310mm,0,10,100")
    (data / "labels.csv").write_text(rows, "utf-8")
    _, presses, photographs, _ = read_data(data, "gelsight_mini", None, "1,1,1", pixel_mm=0.03)
    assert photographs.fully_visible.tolist() == [False] + [True] * 5
    _, presses, _, said = read_data(data, "gelsight_mini", None, "1,1,1", pixel_mm=0.03, border=False)
    assert len(presses) == 5 and said == {"6.310mm_00": "not used: it is not fully visible"}


def test_folds_test_every_press_once() -> None:
    splits = by_press(30, 5)
    assert sorted(np.concatenate([test for _, test in splits])) == list(range(30))


def test_a_fit_begins_from_scratch_unless_told_otherwise(tmp_path: Path) -> None:
    """The shipped lights were fitted to photographs, so nothing may begin from them unasked."""
    data = data_set(tmp_path, count=6)
    assert CompareRealArgs(data=data).sides == CalibrateArgs(what=str(data)).sides == FROM_SCRATCH
    scratch, own = (read_data(data, "gelsight_mini", None, sides)[0].lights for sides in (FROM_SCRATCH, OWN_LEDS))
    assert scratch.source is None and [sum(led.layer == c for led in scratch.leds) for c in ("red", "green", "blue")] == [
        12,
        8,
        9,
    ]
    assert own == SENSOR.lights
    doubled = read_data(data, "gelsight_mini", None, OWN_LEDS, 2)[0].lights
    assert len(doubled.leds) == 2 * len(own.leds)
    with pytest.raises(InputError, match="split = 2: is for --sides own"):
        read_data(data, "gelsight_mini", None, FROM_SCRATCH, 2)


def test_the_strength_of_priors_is_a_known_one_or_inner() -> None:
    assert FitOptions().chosen_prior is None and FitOptions(prior="tied").chosen_prior == "tied"
    with pytest.raises(InputError, match="inner, free, tied"):
        _ = FitOptions(prior="strong").chosen_prior


WRONG: dict[str, Any] = {
    "prior": ("strong", "free, tied, tied-dark, tied-darkest"),
    "device": ("gpu", "auto, cpu, cuda"),
    "starts": (0, "whole number >= 1"),
    "rounds": (float("nan"), "whole number >= 0"),
}
"""Values that a fit cannot use, and what must be said of them."""


@pytest.mark.parametrize("name", [*WRONG, "tested", "imprints", "level"])
def test_a_comparison_of_unknown_settings_cannot_be_set_up(name: str) -> None:
    own: dict[str, Any] = {
        "tested": (6, "must be 1 to 5"),
        "imprints": (("fitted", "soft"), "fitted, rigid, ipc"),
        "level": ("finest", "coarse, medium, fine"),
    }
    value, said = (WRONG | own)[name]
    with pytest.raises(InputError, match="imprint" if name == "imprints" else name) as told:
        RealSettings(**{name: value})
    assert said in str(told.value)


@pytest.mark.parametrize("name", [*WRONG, "modes", "fixed", "shadow_table"])
def test_a_fit_of_unknown_names_is_refused_at_once(name: str) -> None:
    own: dict[str, Any] = {
        "modes": (("raytrace", "ray"), "raytrace, raytrace_alone, taxim, mlp, phong"),
        "fixed": (("gama",), "gamma, stray"),
        "shadow_table": ("pins", "none, raytrace"),
    }
    value, said = (WRONG | own)[name]
    how: dict[str, Any] = {"settings": FitSettings(fixed=value)} if name == "fixed" else {name: value}
    with pytest.raises(InputError, match=name) as told:
        fit_models(SENSOR, shots(), **how)
    assert said in str(told.value)


@pytest.mark.parametrize("name", [*WRONG, "model", "holdout", "shadow_table"])
def test_a_calibration_by_unknown_names_writes_nothing(name: str, tmp_path: Path) -> None:
    own: dict[str, Any] = {
        "model": ("phong", "raytrace, taxim, mlp"),
        "holdout": (1, "0 or a whole number >= 2"),
        "shadow_table": ("raytrace", "belongs to the model 'taxim'"),
    }
    value, said = (WRONG | own)[name]
    how: dict[str, Any] = dict(model="raytrace", holdout=0, starts=1, rounds=0, prior=None, device="cpu") | {name: value}
    with pytest.raises(InputError, match=name) as told:
        run_calibrate_optics(SENSOR, shots(), ("0", "1"), tmp_path / "out", data="none", shadows=False, seed=0, start=0.0, **how)
    assert said in str(told.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "said"), [("level", "coarse, medium, fine"), ("device", "auto, cpu, cuda")])
def test_a_calibration_of_markers_by_unknown_names_writes_nothing(name: str, said: str, tmp_path: Path) -> None:
    how: dict[str, Any] = {"level": "coarse", "device": "cpu"} | {name: "none"}
    with pytest.raises(InputError, match=name) as told:
        run_calibrate_markers(SENSOR, tmp_path / "out", quick=True, seed=0, start=0.0, **how)
    assert said in str(told.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "without", "block"), [("no_colour_matrix", {"colour_mix": UNMIXED}, "mix"), ("no_tone_curve", {"tone": ()}, "tone")]
)
def test_the_fit_without_matrix_or_curve_has_none_whatever_the_sensor_has(name: str, without: dict[str, Any], block: str) -> None:
    response = dataclasses.replace(SENSOR.response, colour_mix=(-0.1,) * 6, tone=(0.1, 0.0, 0.2))
    own, ablation = dataclasses.replace(SENSOR, response=response), ABLATIONS[name]
    changed = ablation.sensor(own)
    assert changed == dataclasses.replace(own, response=dataclasses.replace(response, **without))
    assert ablation.fixed == (block,), "it stays so in the fit"
