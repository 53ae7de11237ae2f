"""``raytac compare``: a small run from end to end, resuming, damaged rows, and modes that cannot run."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.cli.compare import CompareArgs
from raytac.errors import BackendError, InputError, RaytacError
from raytac.gel.surface import GelSurface
from raytac.io.images import read_png
from raytac.io.metrics import read_metrics
from raytac.optics.base import OpticalMode, OpticsImages
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.cache import table_folder
from raytac.report.compare.modes import Mode, Setting, chosen_modes, comparison_modes
from raytac.report.compare.page import FILES, write_comparison
from raytac.report.compare.run import Comparison, run_comparison
from raytac.report.compare.settings import CompareSettings, expected_bake_seconds, expected_seconds
from raytac.specs.sensor import SensorSpec
from tests import coarse_figures

for package in ("skimage", "jinja2", "pyarrow"):
    pytest.importorskip(package)
QUICK = ["compare", "--quick", "--device", "cpu"]
SETTINGS = CompareSettings(
    device="cpu", reference_spp=2, resolutions=((32, 24),), scenes=("sphere",), frames=3, budget_s=0.1, batch=2
)


class Grey:
    """An optical mode of one grey level that counts its images."""

    device = "cpu"

    def __init__(self, label: str, level: int, size: tuple[int, int]) -> None:
        self.label, self.level, self.size, self.rendered = label, level, size, 0

    def render(self, surface: GelSurface) -> OpticsImages:
        self.rendered += 1
        return OpticsImages(rgb=np.full((surface.batch, self.size[1], self.size[0], 3), self.level, np.uint8))


class Greys:
    """Modes of grey levels under the names of real ones; ``fail`` maps a family to what its building raises."""

    def __init__(
        self, families: tuple[str, ...] = ("fast", "taxim", "phong"), fail: dict[str, BaseException] | None = None
    ) -> None:
        self.fail, self.built = fail or {}, []
        self.modes = [Mode(family, self._builder(family, 40 * k), tuple) for k, family in enumerate(families, start=1)]

    def _builder(self, family: str, level: int):
        def build(setting: Setting) -> OpticalMode:
            if family in self.fail:
                raise self.fail[family]
            self.built.append(family)
            return Grey(family, level, setting.size)

        return build


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compare") / "out"
    assert main([*QUICK, "--out", str(out)]) == 0
    return out


def row_files(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (out / "rows").iterdir()}


def test_quick_run_writes_every_file(quick: Path) -> None:
    names = {path.name for path in quick.iterdir()}
    assert names == {*FILES, "sheet_sphere_80x60.png", "rows", "references"}
    assert not [path for path in quick.rglob("*.partial*")]


def test_rows_are_one_a_mode_and_say_what_was_measured(quick: Path) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(str(quick / "results.parquet"))
    rows = {row["mode"]: row for row in table.to_pylist()}
    expected = {mode.name for mode in comparison_modes((1, 4), quick=True)}
    keys = [key for key in read_metrics(quick / "metrics.json") if key.startswith("left_out.")]
    left_out = {key.removeprefix("left_out.").removesuffix(".80x60") for key in keys}
    assert len(rows) == table.num_rows and set(rows) | left_out == expected and not set(rows) & left_out
    assert {"fast", "reference.spp1", "reference.spp4", "path.spp1", "path.spp4"} <= set(rows)
    assert {"taxim", "taxim_shadow", "peer", "peer_shadow"} <= left_out
    for row in rows.values():
        assert row["scene"] == "sphere" and row["resolution"] == "80x60" and row["device"] == "cpu" and row["ms"] > 0
        for region in ("frame", "contact", "ring", "box"):
            assert 0 < row[f"{region}_mae"] <= row[f"{region}_rmse"] and -1 <= row[f"{region}_ssim"] <= 1
            assert row[f"{region}_psnr"] == pytest.approx(20 * np.log10(255 / row[f"{region}_rmse"]))
    assert rows["fast"]["frame_psnr"] > rows["reference.spp4"]["frame_psnr"] > rows["path.spp4"]["frame_psnr"] > 10
    # An unbiased mode at four times the samples has half the error, less the reference's own noise; paths that hit a strip by chance clip.
    assert 0.35 < rows["reference.spp4"]["frame_rmse"] / rows["reference.spp1"]["frame_rmse"] < 0.75
    assert 0.35 < rows["path.spp4"]["frame_rmse"] / rows["path.spp1"]["frame_rmse"] < 0.85
    # fast is far better than 32 samples a pixel can tell; 1 sample a pixel is not.
    assert rows["fast"]["at_noise"] is True and rows["path.spp1"]["at_noise"] is False
    # The peak of one and the same frame is 2.98 or 3.28 MiB from call to call, so the two have no fixed order where a frame is all.
    assert rows["fast"]["memory_mib"] > 0 and 0 < rows["fast"]["memory_mib_per_env"] < 2 * rows["fast"]["memory_mib"]
    assert b"versions.mitsuba" in (table.schema.metadata or {})


def test_metrics_are_those_of_the_rows(quick: Path) -> None:
    metrics = read_metrics(quick / "metrics.json")
    row = json.loads(next((quick / "rows").glob("sphere-80x60-fast-*.json")).read_text())["figures"]
    assert metrics["fast.cpu.80x60.psnr_db"] == metrics["fast.cpu.80x60.psnr_db.sphere"] == row["frame_psnr"]
    assert metrics["fast.cpu.80x60.fps"] == pytest.approx(1e3 / row["ms"])
    assert metrics["fast.cpu.80x60.contact_mae_levels.sphere"] == row["contact_mae"]
    assert float(metrics["path.cpu.80x60.spp_for_equal_error.sphere"]) > 4
    assert str(metrics["fast.cpu.80x60.time_ratio_path_equal_error_how.sphere"]).startswith("extrapolated")
    assert metrics["reference.spp"] == 32 and float(metrics["wall_s"]) > 0


def test_report_opens_offline_and_names_every_mode(quick: Path) -> None:
    page = (quick / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|<script|<link|@import|\bsrc=\"(?!data:)|url\(", page)
    for mode in comparison_modes((1, 4), quick=True):
        assert mode.label in page
    assert page.count("data:image/png;base64,") == 2 and "left out of a quick run" in page
    assert "its figures mean nothing" in page


def test_pictures_show_something(quick: Path) -> None:
    pareto, sheet = read_png(quick / "pareto.png"), read_png(quick / "sheet_sphere_80x60.png")
    assert pareto.shape[1] == sheet.shape[1] == round(7.16 * coarse_figures.MOST)
    assert coarse_figures.asked["pareto.png"] == coarse_figures.asked["sheet_sphere_80x60.png"] == 300
    for picture in (pareto, sheet):
        assert 0.002 < (picture < 128).any(axis=-1).mean() < 0.9
    # Second column of the sheet is fast: its image in colour, and below it a signed error that is neither flat nor saturated.
    columns = sheet[: sheet.shape[0] // 2, 123:233].reshape(-1, 3).astype(int)
    assert len(np.unique(columns, axis=0)) > 200


def test_run_again_it_measures_nothing_and_says_the_same(quick: Path) -> None:
    before, metrics = row_files(quick), read_metrics(quick / "metrics.json")
    assert main([*QUICK, "--out", str(quick)]) == 0
    again = read_metrics(quick / "metrics.json")
    assert row_files(quick) == before and again["rows_measured_in_this_run"] == 0
    differing = {key for key in metrics if metrics[key] != again.get(key)}
    assert differing <= {"wall_s", "rows_measured_in_this_run", "machine.load_at_start"}


def test_interrupted_it_keeps_finished_rows_and_goes_on(tmp_path: Path) -> None:
    first = Greys(fail={"phong": KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt):
        run_comparison(SETTINGS, tmp_path, first.modes)
    kept = row_files(tmp_path)
    assert first.built == ["fast", "taxim"] and len(kept) == 4  # a JSON file and a PNG each
    second = Greys()
    comparison = run_comparison(SETTINGS, tmp_path, second.modes)
    assert second.built == ["phong"] and comparison.measured == 1
    assert [row.figures["mode"] for row in comparison.rows] == ["fast", "taxim", "phong"]
    assert [int(row.image.max()) for row in comparison.rows] == [40, 80, 120]
    assert {name: time for name, time in row_files(tmp_path).items() if name in kept} == kept


def test_interrupting_the_command_leaves_rows_but_no_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    greys = Greys(fail={"taxim": KeyboardInterrupt()})
    monkeypatch.setattr("raytac.report.compare.run.comparison_modes", lambda *_, **__: greys.modes)
    assert main([*QUICK, "--out", str(tmp_path / "out")]) == 130
    assert "rows that are finished are kept" in capsys.readouterr().err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"rows", "references"}


def test_a_report_is_there_after_the_first_scene_and_grows(tmp_path: Path) -> None:
    settings, pages = replace(SETTINGS, scenes=("sphere", "coin", "pins")), []

    def report(comparison: Comparison) -> None:
        write_comparison(comparison, tmp_path, 1.0)
        metrics = read_metrics(tmp_path / "metrics.json")
        sheets = {path.name for path in tmp_path.glob("sheet_*.png")}
        pages.append((len(comparison.rows), comparison.pending, metrics["scenes_pending"], sheets))
        assert "Still running." in (tmp_path / "report.html").read_text()

    greys = Greys()
    comparison = run_comparison(settings, tmp_path, greys.modes, report)
    assert greys.built == ["fast", "taxim", "phong"]  # once each, not once a scene
    assert [page[:3] for page in pages] == [(3, ("coin, 32x24", "pins, 32x24"), 2), (6, ("pins, 32x24",), 1)]
    assert pages[0][3] == {"sheet_sphere_32x24.png"} and pages[1][3] == {"sheet_sphere_32x24.png", "sheet_coin_32x24.png"}
    write_comparison(comparison, tmp_path, 1.0)
    assert comparison.pending == () and "Still running." not in (tmp_path / "report.html").read_text()
    assert [row.figures["scene"] for row in comparison.rows] == [name for name in settings.scenes for _ in greys.modes]


def test_a_level_without_markers_is_refused_and_names_the_other_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*QUICK, "--level", "coarse", "--out", str(tmp_path / "out")]) == 2
    assert "--markers" in (said := capsys.readouterr().err) and "compare-physics" in said
    assert not (tmp_path / "out").exists()


def test_a_mode_that_fails_is_tried_once(tmp_path: Path) -> None:
    greys = Greys(fail={"taxim": BackendError("no table here")})
    comparison = run_comparison(replace(SETTINGS, scenes=("sphere", "coin")), tmp_path, greys.modes)
    assert [one.mode for one in comparison.left_out] == ["taxim"] and len(comparison.rows) == 4


def test_the_default_is_quick_enough_and_full_is_everything() -> None:
    short, full = CompareArgs().settings(), CompareArgs(full=True).settings()
    assert short == CompareSettings() and full == CompareSettings.full()
    every = comparison_modes(full.spp)
    assert chosen_modes(every, full.modes) == every and full.reference_spp == 1024 and full.frames == 60
    some = [mode.name for mode in chosen_modes(comparison_modes(short.spp), short.modes)]
    assert some == ["fast", "reference.spp4", "reference.spp16", "path.spp4", "path.spp16", "taxim", "taxim_shadow", "phong"]
    # 0.09 s of processor time a sample a pixel at 320x240, on two cores.
    assert expected_seconds(short, chosen_modes(comparison_modes(short.spp), short.modes), 0.045) < 240
    assert expected_seconds(full, every, 0.045) > 600
    assert CompareArgs(quick=True).settings().modes is None and CompareArgs(modes="all").settings().modes is None
    assert CompareArgs(modes="fast,path.spp4", full=True, spp=64).settings().reference_spp == 64
    assert [m.name for m in chosen_modes(every, ("fast", "path.spp4"))] == ["fast", "path.spp4"]


def test_the_estimate_has_the_bake_of_a_table_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sensor_spec: SensorSpec
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    short, frames = CompareArgs().settings(), []
    modes = chosen_modes(comparison_modes(short.spp), short.modes)
    seconds = expected_bake_seconds(sensor_spec, modes, lambda: frames.append(1) or 0.02)
    renders = BakeSettings().renders(sensor_spec.optics.shadows)
    assert renders >= 400 and renders * 0.02 < seconds < 3 * renders * 0.02 and len(frames) == 1
    assert expected_seconds(short, modes, 0.045, seconds) == pytest.approx(expected_seconds(short, modes, 0.045) + seconds)
    folder = table_folder(sensor_spec, BakeSettings(), 0, sensor_spec.camera.resolution)
    assert folder is not None and folder.is_relative_to(tmp_path)
    folder.mkdir(parents=True)
    assert expected_bake_seconds(sensor_spec, modes, lambda: frames.append(1) or 0.02) == 0.0
    (tmp_path / "other").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    assert expected_bake_seconds(sensor_spec, chosen_modes(modes, ("fast", "phong")), lambda: frames.append(1) or 0.02) == 0.0
    assert len(frames) == 1, "no frame is timed if there is nothing to bake"


@pytest.mark.parametrize("damage", ["cut", "changed", "picture", "no picture"])
def test_a_damaged_row_is_measured_again_with_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: str, greys_run: Path
) -> None:
    import shutil

    shutil.copytree(greys_run, tmp_path, dirs_exist_ok=True)
    path = next((tmp_path / "rows").glob("*-taxim-*.json"))
    whole = path.read_text()
    if damage == "cut":
        path.write_text(whole[: len(whole) // 2])
    elif damage == "changed":
        path.write_text(re.sub(r'"frame_mae": [0-9.]+', '"frame_mae": 0.01', whole))
    elif damage == "picture":
        path.with_suffix(".png").write_bytes(next((tmp_path / "rows").glob("*-phong-*.png")).read_bytes())
    else:
        path.with_suffix(".png").unlink()
    greys = Greys()
    comparison = run_comparison(SETTINGS, tmp_path, greys.modes)
    said = capsys.readouterr()
    assert greys.built == ["taxim"] and comparison.measured == 1
    assert path.name in said.out + said.err and "measured again" in said.out + said.err
    assert run_comparison(SETTINGS, tmp_path, Greys().modes).measured == 0


@pytest.fixture(scope="module")
def greys_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("greys")
    run_comparison(SETTINGS, out, Greys().modes)
    return out


def test_a_damaged_reference_is_computed_again_and_the_same(greys_run: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(greys_run, tmp_path, dirs_exist_ok=True)
    path = next((tmp_path / "references").glob("*.npz"))
    with np.load(path) as kept:
        halves = kept["halves"]
    path.write_bytes(path.read_bytes()[:100])
    assert run_comparison(SETTINGS, tmp_path, Greys().modes).measured == 0
    with np.load(path) as again:
        # Not to the last bit: the acceleration structure is built by several threads, in no fixed order.
        np.testing.assert_allclose(again["halves"], halves, rtol=1e-5, atol=1e-7)
    assert not np.array_equal(halves[0], halves[1])


def test_other_settings_are_other_rows(greys_run: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(greys_run, tmp_path, dirs_exist_ok=True)
    for changed in (replace(SETTINGS, seed=1), replace(SETTINGS, reference_spp=4), replace(SETTINGS, frames=4)):
        assert run_comparison(changed, tmp_path, Greys(("fast",)).modes).measured == 1
    other = [replace(mode, options="shadow") for mode in Greys(("fast",)).modes]
    assert run_comparison(SETTINGS, tmp_path, other).measured == 1


def test_a_mode_that_cannot_run_is_left_out_with_its_reason(greys_run: Path, tmp_path: Path) -> None:
    greys = Greys(fail={"taxim": BackendError("no table here")})
    comparison = run_comparison(SETTINGS, tmp_path, greys.modes)
    assert [row.figures["mode"] for row in comparison.rows] == ["fast", "phong"]
    assert [(one.mode, one.reason) for one in comparison.left_out] == [("taxim", "no table here")]
    write_comparison(comparison, tmp_path, 1.0)
    assert read_metrics(tmp_path / "metrics.json")["left_out.taxim.32x24"] == "no table here"
    assert "no table here" in (tmp_path / "report.html").read_text()


def test_untouched_pad_has_errors_of_the_frame_only(tmp_path: Path) -> None:
    comparison = run_comparison(replace(SETTINGS, scenes=("none",)), tmp_path, Greys().modes)
    figures = comparison.rows[0].figures
    assert figures["frame_mae"] is not None and figures["contact_mae"] is None and figures["noise_ring_rmse"] is None
    write_comparison(comparison, tmp_path, 1.0)
    assert not [key for key in read_metrics(tmp_path / "metrics.json") if "contact_mae" in key]


def test_sheets_of_an_earlier_run_do_not_stay(greys_run: Path, tmp_path: Path) -> None:
    (tmp_path / "sheet_gone_8x8.png").write_bytes(b"old")
    (tmp_path / "notes.txt").write_text("mine")
    write_comparison(run_comparison(SETTINGS, greys_run, Greys().modes), tmp_path, 1.0)
    assert not (tmp_path / "sheet_gone_8x8.png").exists() and (tmp_path / "notes.txt").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--scenes", "sphere,spere"], "sphere"),
        (["--scenes", " , "], "at least one"),
        (["--scenes", "sphere,scenes/press/sphere.toml"], "different names"),
        (["--resolutions", "320x"], "WIDTHxHEIGHT"),
        (["--resolutions", "320x240,8x8"], "SSIM"),
        (["--resolutions", "9000x240"], "8192"),
        (["--sensor", "gelsite"], "gelsight_mini"),
        (["--spp", "1"], "at least 2"),
        (["--frames", "0"], "at least 3"),
        (["--batch", "1"], "at least 2"),
        (["--modes", "fast,taxm"], "modes = 'taxm'"),
        (["--seed", "-1"], "2^32"),
        (["--markers", "--sensor", "gelsight_dome"], "calibrate markers"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    assert main(["compare", "--device", "cpu", "--out", str(tmp_path / "out"), *options]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("here")
    with pytest.raises(InputError, match="folder"):
        run_comparison(SETTINGS, tmp_path / "out", Greys().modes)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "pyarrow" else object())
    with pytest.raises(RaytacError, match=r"pyarrow.*raytac\[report\]"):
        SETTINGS.check()
