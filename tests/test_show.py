"""Frames as figures, files and cards for notebooks; cards of sensors, worlds and data sets."""

from __future__ import annotations

import base64
import copy
import io
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import raytac
from raytac.errors import BackendError, InputError
from raytac.frame import MissingOutputError, TactileFrame
from raytac.gel.surface import GelSurface
from raytac.io.html import SIDE, coloured
from raytac.io.images import read_png

OUTPUTS = ("rgb", "layers", "normals", "depth", "wrench", "traction")
VOID = {"img", "br"}


class Cards(HTMLParser):
    """Tags of a page, which must close in order, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.feed(page)
        assert not self.open, self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open += [] if tag in VOID else [tag]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def pictures(page: str) -> list[Image.Image]:
    """Pictures of a page, which come from nowhere else."""
    assert page.count("<img") == page.count('src="data:image/png;base64,') and "http" not in page and "<script" not in page
    data = re.findall(r"base64,([^\"]+)\"", page)
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in data]


@pytest.fixture(scope="module")
def sensor() -> raytac.TactileSensor:
    return raytac.TactileSensor("gelsight_mini_7x9", outputs=OUTPUTS, markers="fots", num_envs=2, resolution=(160, 120))


@pytest.fixture(scope="module")
def frame(sensor: raytac.TactileSensor) -> TactileFrame:
    return sensor.press("coin", depths=np.array([0.3e-3, 0.7e-3]))


@pytest.fixture(scope="module")
def bare() -> TactileFrame:
    grid = raytac.gel.make_grid(raytac.load_sensor("gelsight_mini").gelpad, 0.5e-3)
    return TactileFrame(GelSurface.at_rest(grid))


def test_a_card_of_a_frame_shows_its_pictures(sensor: raytac.TactileSensor, frame: TactileFrame) -> None:
    page = frame._repr_html_()
    said = Cards(page).text
    assert "2 environments" in said and "up to 0.70 mm" in said and "rgb" in said and f"{frame.force[1, 2]:.2f} N" in said
    shown = pictures(page)
    assert len(shown) == 4 and all(max(image.size) <= SIDE for image in shown) and len(page) < 400_000
    plain = raytac.TactileSensor(outputs=("rgb", "normals", "depth"), resolution=(160, 120), pitch=sensor.pitch)
    one = plain.render(frame.surface.height[1] - frame.surface.grid.rest, frame.surface.grid.pitch)
    (image, dent, normals, depth) = pictures(one._repr_html_())
    np.testing.assert_array_equal(np.asarray(image), one.rgb[0])  # small enough to be whole
    middle = np.asarray(normals)[5, 5].astype(int)
    assert middle[2] > 240 and abs(middle[0] - 128) < 25  # flat gel looks at the camera
    assert np.asarray(dent).std() > 10 and np.asarray(depth).std() > 10


def test_a_card_works_with_missing_outputs_and_failed_environments(bare: TactileFrame) -> None:
    assert len(pictures(bare._repr_html_())) == 1 and "up to 0.00 mm" in Cards(bare._repr_html_()).text
    height = np.full((1, *bare.surface.grid.shape), np.nan, np.float32)
    lost = TactileFrame(
        GelSurface(bare.surface.grid, height, bare.surface.contact, bare.surface.contact_centre), failed=np.array([True])
    )
    page = lost._repr_html_()
    assert "1 of 1 environments" in Cards(page).text and np.ptp(np.asarray(pictures(page)[0])) == 0


def test_colours_follow_the_numbers() -> None:
    colours = coloured(np.array([[0.0, 0.5, 1.0, 2.0, np.nan]]), 0.0, 1.0)[0]
    assert colours.tolist() == [[68, 1, 84], [33, 145, 140], [253, 231, 37], [253, 231, 37], [160, 160, 160]]
    assert coloured(np.zeros((2, 2)), 0.0, 0.0).tolist() == np.full((2, 2, 3), [68, 1, 84]).tolist()


def test_cards_escape_what_they_are_given(tmp_path: Path) -> None:
    from raytac.io.html import card, picture

    page = card("<b>&", {"a<": "<script>"}, picture(np.zeros((2, 3, 3), np.uint8), '"><x'))
    assert "<script" not in page and Cards(page).text == '<b>&a<<script>"><x'


def test_a_sensor_shows_its_image_at_rest_once_it_has_a_renderer(sensor: raytac.TactileSensor, frame: TactileFrame) -> None:
    new = copy.copy(raytac.TactileSensor("gelsight_mini"))
    assert repr(new) == "TactileSensor(gelsight_mini, 320 x 240 px, rigid+raytrace-fast; outputs: rgb; environments: 1)"
    page = new._repr_html_()
    assert not pictures(page) and "320 × 240 px" in Cards(page).text and new._mode is None
    (rest,) = pictures(sensor._repr_html_())
    np.testing.assert_array_equal(np.asarray(rest), sensor.rest().rgb[0])
    assert "fots" in Cards(sensor._repr_html_()).text


def test_a_world_says_what_it_is_and_computes_nothing() -> None:
    world = raytac.TactileWorld("ball_rolling", num_envs=2)
    said = Cards(world._repr_html_()).text
    assert "ball_rolling" in said and "sensor" in said and "environments2" in said
    assert all(sensor._mode is None for sensor in world.sensors.values())


def test_a_frame_is_saved_as_files_that_numpy_and_viewers_read(frame: TactileFrame, tmp_path: Path) -> None:
    written = frame.save(tmp_path / "frame")
    assert [path.name for path in written] == ["frame.npz", "rgb_000.png", "rgb_001.png"]
    np.testing.assert_array_equal(read_png(written[2]), frame.rgb[1])
    with np.load(written[0]) as kept:
        np.testing.assert_array_equal(kept["rgb"], frame.rgb)
        np.testing.assert_array_equal(kept["layers.red"], frame.layers["red"])
        np.testing.assert_array_equal(kept["markers.displacement"], frame.markers.displacement)
        np.testing.assert_array_equal(kept["height"], frame.surface.height)
        assert kept["grid_x"].shape == (frame.surface.height.shape[2],)
        assert set(kept) >= {"wrench", "force", "traction", "depth", "normals", "failed", "contact_on_grid"}
    assert frame.save(tmp_path / "one.png", env=1) == [tmp_path / "one.png"]
    np.testing.assert_array_equal(read_png(tmp_path / "one.png"), frame.rgb[1])
    assert frame.save(tmp_path / "all.npz") == [tmp_path / "all.npz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.npz", "frame", "one.png"]


def test_a_frame_that_cannot_be_saved_says_why(frame: TactileFrame, bare: TactileFrame, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.png or \.npz, or be a folder"):
        frame.save(tmp_path / "frame.jpg")
    with pytest.raises(MissingOutputError, match="rgb"):
        bare.save(tmp_path / "frame.png")
    with pytest.raises(InputError, match="env = 2"):
        frame.save(tmp_path / "frame.png", env=2)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="a file of that name exists"):
        frame.save(tmp_path / "file")
    assert [path.name for path in bare.save(tmp_path / "bare")] == ["frame.npz"]


def test_a_figure_shows_all_that_is_there(frame: TactileFrame, bare: TactileFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    from matplotlib import pyplot

    figure = frame.show(1)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["image; arrows: markers × 5", "indentation [mm]", "normals", "depth [mm]", "pressure [kPa]"]
    assert "environment 1 of 2" in figure.get_suptitle() and f"{frame.force[1, 2]:.2f}" in figure.get_suptitle()
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), frame.rgb[1])
    assert [axes.get_title() for axes in bare.show().axes if axes.get_title()] == ["indentation [mm]"]
    assert not pyplot.get_fignums()
    with pytest.raises(InputError, match="env = 5"):
        frame.show(5)


def test_without_matplotlib_the_error_says_what_to_install(bare: TactileFrame, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(BackendError, match=r"show\(\) needs matplotlib.*pip install matplotlib"):
        bare.show()


def test_importing_stays_cheap() -> None:
    code = "import raytac.frame, sys; assert not {'matplotlib', 'PIL', 'html'} & set(sys.modules), sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], check=True)
