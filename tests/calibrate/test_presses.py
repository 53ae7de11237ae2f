"""Real presses are read from photographs and three published layouts, or refused with file and rule."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.calibrate.presses import RealPresses, read_presses
from raytac.errors import CalibrationError, InputError
from raytac.io.images import write_png

SHAPE = (24, 32, 3)
LABELS = "diameter,index,cx_px,cy_px,r_px,edge_score,fully_visible\n6.310mm,0,12,10,6,9,1\n6.310mm,7,28,10,5,9,0\n9.500mm,1,16,12,9,9,1\n"


def picture(level: int) -> np.ndarray:
    """An image whose channels and pixels differ, so that a swap or a turn shows."""
    return (np.arange(np.prod(SHAPE)).reshape(SHAPE) * 7 + level).astype(np.uint8)


@pytest.fixture
def labelled(tmp_path: Path) -> Path:
    (tmp_path / "labels.csv").write_text(LABELS, "utf-8")
    for name, level in (("background", 0), ("6.310mm_00", 1), ("6.310mm_07", 2), ("9.500mm_01", 3)):
        write_png(tmp_path / f"{name}.png", picture(level))
    return tmp_path


@pytest.fixture
def catalogued(tmp_path: Path) -> Path:
    (tmp_path / "catalog.csv").write_text("experiment_reldir,diameter(mm)\n6.310mm/0,6.310\n9.500mm/12,9.5\n", "utf-8")
    write_png(tmp_path / "background.png", picture(0))
    for level, place in enumerate(("6.310mm/0", "9.500mm/12"), start=1):
        (tmp_path / place).mkdir(parents=True)
        write_png(tmp_path / place / "gelsight.png", picture(level))
    return tmp_path


def pack(path: Path, **changed: np.ndarray) -> Path:
    arrays = {
        "f0": picture(0)[..., ::-1],
        "imgs": np.stack([picture(1), picture(2)])[..., ::-1],
        "touch_center": np.array([[12, 10], [20, 11]]),
        "touch_radius": np.array([6, 5]),
    }
    np.savez(path, allow_pickle=False, **(arrays | changed))
    return path


def test_a_labelled_folder(labelled: Path) -> None:
    presses = read_presses(labelled)
    assert len(presses) == 3 and presses.resolution == (32, 24)
    np.testing.assert_array_equal(presses.background, picture(0))
    np.testing.assert_array_equal(presses.images[1], picture(2))
    np.testing.assert_allclose(presses.ball_radius, [3.155e-3, 3.155e-3, 4.75e-3])
    np.testing.assert_allclose(presses.circles[1], [28, 10, 5])
    assert presses.fully_visible.tolist() == [True, False, True]
    assert presses.names == ("6.310mm_00", "6.310mm_07", "9.500mm_01")
    taken = presses.take(presses.fully_visible)
    assert taken.names == ("6.310mm_00", "9.500mm_01")
    np.testing.assert_array_equal(taken.images[1], picture(3))


def test_a_catalogue_has_no_circles(catalogued: Path) -> None:
    presses = read_presses(catalogued)
    assert presses.names == ("6.310mm/0", "9.500mm/12")
    np.testing.assert_allclose(presses.ball_radius, [3.155e-3, 4.75e-3])
    np.testing.assert_array_equal(presses.images[1], picture(2))
    assert np.isnan(presses.circles).all() and not presses.fully_visible.any()


def test_a_taxim_pack_is_turned_to_rgb_and_needs_the_ball(tmp_path: Path) -> None:
    path = pack(tmp_path / "dataPack.npz")
    for data in (path, tmp_path):
        presses = read_presses(data, ball_diameter=4e-3)
        np.testing.assert_array_equal(presses.background, picture(0))
        np.testing.assert_array_equal(presses.images[1], picture(2))
        np.testing.assert_allclose(presses.circles, [[12, 10, 6], [20, 11, 5]])
        np.testing.assert_allclose(presses.ball_radius, 2e-3)
    with pytest.raises(InputError, match=r"dataPack\.npz does not say"):
        read_presses(path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("diameter,index\n", "column 'cx_px'"),
        (LABELS.replace("12,10,6", "12,ten,6"), "line 2, cy_px = 'ten'"),
        (LABELS.replace("12,10,6", "12,nan,6"), "line 2, cy_px"),
        (LABELS.replace("12,10,6", "12,10,-6"), "r_px = '-6': must be a finite number > 0"),
        (LABELS.replace("28,10,5", "28,,5"), "line 3, cy_px"),
        (LABELS.replace("6.310mm,7", "0mm,7"), "line 3, diameter"),
        (LABELS.replace("6.310mm,7", "6.310mm,7.5"), "line 3, index"),
        (LABELS.replace("9.500mm,1", "9.500mm,2"), r"9\.500mm_02\.png: is missing"),
        (LABELS.splitlines()[0], "at least one press"),
    ],
)
def test_bad_labels_are_refused(labelled: Path, text: str, match: str) -> None:
    (labelled / "labels.csv").write_text(text, "utf-8")
    with pytest.raises(CalibrationError, match=match):
        read_presses(labelled)


def test_bad_images_are_refused(labelled: Path) -> None:
    write_png(labelled / "6.310mm_07.png", picture(0)[:20])
    with pytest.raises(CalibrationError, match=r"6\.310mm_07\.png.*size of background\.png, 32 x 24"):
        read_presses(labelled)
    (labelled / "6.310mm_07.png").write_bytes((labelled / "background.png").read_bytes()[:60])
    with pytest.raises(CalibrationError, match=r"6\.310mm_07\.png.*cannot be read"):
        read_presses(labelled)
    (labelled / "background.png").unlink()
    with pytest.raises(CalibrationError, match=r"background\.png: is missing"):
        read_presses(labelled)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"f0": np.zeros((24, 32), np.uint8)}, "one uint8 image"),
        ({"imgs": np.zeros((2, 20, 32, 3), np.uint8)}, "size of f0"),
        ({"imgs": np.zeros((2, *SHAPE))}, "uint8"),
        ({"touch_center": np.zeros((3, 2))}, "touch_center"),
        ({"touch_radius": np.array([6.0, np.nan])}, "touch_radius"),
        ({"touch_radius": np.array([6.0, 0.0])}, "must be > 0"),
    ],
)
def test_bad_packs_are_refused(tmp_path: Path, changed: dict[str, np.ndarray], match: str) -> None:
    with pytest.raises(CalibrationError, match=match):
        read_presses(pack(tmp_path / "dataPack.npz", **changed), ball_diameter=4e-3)


def test_what_is_no_data_set_is_refused(labelled: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must exist"):
        read_presses(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"labels\.csv, catalog\.csv, dataPack\.npz, background\.png"):
        read_presses(tmp_path / "empty")
    with pytest.raises(InputError, match="must not be given"):
        read_presses(labelled, ball_diameter=6e-3)
    with pytest.raises(InputError, match="> 0"):
        read_presses(labelled, ball_diameter=-1.0)
    with pytest.raises(InputError, match="folder or an"):
        read_presses(labelled / "background.png")


def test_circles_can_be_replaced(labelled: Path) -> None:
    presses: RealPresses = read_presses(labelled)
    moved = presses.with_circles(presses.circles + 1)
    np.testing.assert_allclose(moved.circles - presses.circles, 1)
    assert moved.images is presses.images


def test_plain_photographs_have_names_of_their_own_and_circles_only_where_a_table_says_so(tmp_path: Path) -> None:
    for k, name in enumerate(("background", "IMG 7", "a", "b")):
        write_png(tmp_path / f"{name}.png", np.full((12, 16, 3), 40 * k, np.uint8))
    with pytest.raises(InputError, match=r"ball-diameter-mm.*photographs alone"):
        read_presses(tmp_path)
    presses = read_presses(tmp_path, ball_diameter=4e-3)
    assert presses.names == ("IMG 7", "a", "b") and np.isnan(presses.circles).all()
    assert presses.images[:, 0, 0, 0].tolist() == [40, 80, 120] and (presses.ball_radius == 2e-3).all()
    (tmp_path / "circles.csv").write_text("press,held_out,cx_px,cy_px,r_px\nb,0,5.5,6,3\n", "utf-8")
    again = read_presses(tmp_path, ball_diameter=4e-3)
    assert again.circles[2].tolist() == [5.5, 6.0, 3.0] and np.isnan(again.circles[:2]).all()
    for text, said in (
        ("c,0,5,6,3", "must be a photograph's name.*IMG 7"),
        ("b,0,5,6,-3", "line 2, r_px"),
        ("b,0,,6,3", "must not be empty"),
    ):
        (tmp_path / "circles.csv").write_text(f"press,held_out,cx_px,cy_px,r_px\n{text}\n", "utf-8")
        with pytest.raises(CalibrationError, match=said):
            read_presses(tmp_path, ball_diameter=4e-3)
    (tmp_path / "circles.csv").unlink()
    write_png(tmp_path / "c.png", np.zeros((12, 17, 3), np.uint8))
    with pytest.raises(CalibrationError, match=r"size of background\.png"):
        read_presses(tmp_path, ball_diameter=4e-3)
