"""``TactileSensor`` with the soft pad: chosen by name or by scene, same outputs and units as the rigid one."""

from __future__ import annotations

import io
import warnings
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.gel.traction import cell_areas
from raytac.physics import PHYSICS, Correction, Ipc
from raytac.physics.soft.contact_width import NarrowContactWarning
from raytac.report.press import press_metrics
from raytac.sensor import TactileSensor
from raytac.specs import load_press
from raytac.specs.press import StageSpec

pytestmark = pytest.mark.usefixtures("few_cells")
OUTPUTS = ("height", "wrench", "traction")
SCENE = replace(load_press("sphere"), trajectory=(StageSpec("indent", depth=0.3e-3),))


@pytest.fixture(scope="module")
def frames():
    made = {}
    for physics in ("rigid", "ipc"):
        sensor = TactileSensor(outputs=OUTPUTS, physics=physics, pitch=0.2e-3, device="cpu")
        with pytest.warns(NarrowContactWarning) if physics == "ipc" else nullcontext():
            made[physics] = sensor, sensor.press(SCENE)
    return made


@pytest.mark.parametrize("physics", ["rigid", "ipc"])
def test_wrench_traction_and_area_mean_the_same(frames, physics):
    sensor, frame = frames[physics]
    assert frame.wrench.shape == (1, 6) and frame.traction.shape == (1, *sensor.grid.shape, 3)
    assert frame.wrench[0, :3] == pytest.approx(frame.force[0])
    total = (frame.traction[0].astype(float) * cell_areas(sensor.grid)[..., None]).sum(axis=(0, 1))
    assert total == pytest.approx(frame.wrench[0, :3], rel=1e-4, abs=1e-5)
    assert frame.wrench[0, 2] < -0.2
    assert frame.contact_area[0] == pytest.approx(frame.surface.contact.sum() * 0.2e-3**2, rel=0.01)
    assert ("force_law_area" in frame.outputs) == (physics == "rigid")
    assert (frame.unconverged.tolist() if "unconverged" in frame.outputs else None) == ([0] if physics == "ipc" else None)


def test_metrics_count_the_steps_that_did_not_converge(frames):
    sensor, frame = frames["ipc"]
    found = press_metrics(sensor, SCENE, frame.with_values(unconverged=np.array([3])), sensor.rest())
    assert found["contact.unconverged_steps"] == 3
    assert "contact.unconverged_steps" not in press_metrics(frames["rigid"][0], SCENE, frames["rigid"][1], sensor.rest())


def test_both_pads_make_about_the_same_press(frames):
    rigid, soft = frames["rigid"][1], frames["ipc"][1]
    assert soft.surface.indentation.max() == pytest.approx(rigid.surface.indentation.max(), rel=0.03)
    assert soft.wrench[0, 2] == pytest.approx(rigid.wrench[0, 2], rel=0.5)  # coarse cells are stiff
    assert soft.surface.coat is not None and rigid.surface.coat is None


def test_labels_tell_the_pads_apart(frames):
    assert frames["rigid"][0].label == "rigid" and frames["ipc"][0].label == "ipc-coarse"


def test_the_scene_chooses_unless_the_caller_does():
    scene = replace(load_press("none"), physics="ipc", pad="medium")
    sensor = TactileSensor(outputs=("height",), pitch=0.5e-3, device="cpu")
    assert sensor.press(scene).surface.coat is not None and sensor.label == "ipc-medium"
    assert sensor.physics is None  # as it was asked for: the next scene chooses again
    assert sensor.press(replace(scene, physics=None, pad=None)).surface.coat is None and sensor.label == "rigid"
    asked = TactileSensor(outputs=("height",), pitch=0.5e-3, device="cpu", physics="rigid")
    assert asked.press(scene).surface.coat is None and asked.label == "rigid"
    soft = TactileSensor(outputs=("height",), pitch=0.5e-3, device="cpu", physics="ipc")
    soft.press(scene)
    assert soft.physics == Ipc() and soft.label == "ipc-medium"


def test_a_scene_that_names_unknown_physics_is_refused_with_file_and_key(tmp_path):
    path = tmp_path / "odd.toml"
    path.write_text('physics = "mpm"\n[object]\nkind = "none"\n')
    with pytest.raises(SpecError, match=r"odd\.toml: physics = 'mpm'.*rigid, ipc"):
        TactileSensor(outputs=("height",)).load(path)


def test_no_object_no_force():
    sensor = TactileSensor(outputs=OUTPUTS, physics="ipc", pitch=0.5e-3, device="cpu")
    frame = sensor.press("none")
    assert not frame.wrench.any() and not frame.traction.any() and frame.contact_area[0] == 0.0
    assert np.array_equal(frame.height[0], sensor.grid.rest.astype(np.float32))


def test_unknown_names_are_refused_with_the_choices():
    with pytest.raises(InputError, match=r"physics.*'mpm'.*rigid, ipc"):
        TactileSensor(physics="mpm")
    with pytest.raises(InputError, match=r"level.*'huge'.*coarse, medium, fine"):
        TactileSensor(physics=Ipc(level="huge"))
    with pytest.raises(InputError, match=r"level.*'fine'.*no option of physics='rigid'"):
        PHYSICS.config("rigid", level="fine")
    with pytest.raises(InputError, match=r"physics.*rigid, ipc, or a configuration"):
        TactileSensor(physics=3)  # type: ignore[arg-type]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("progress", [False, True])
def test_a_long_press_shows_its_stages_on_a_terminal(progress, monkeypatch):
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    TactileSensor(outputs=("height",), physics="ipc", pitch=0.2e-3, device="cpu").press(SCENE, progress=progress)
    assert ("stage 1 of 1: indent" in screen.getvalue() and "step" in screen.getvalue()) is progress
    if not progress:
        assert screen.getvalue() == ""


def loop(scene: Any, outputs=("height", "wrench"), level="coarse") -> tuple[list[Any], list[str]]:
    """Frames of a press in three steps a stage, and the warnings of narrow contacts on the way."""
    sensor = TactileSensor(outputs=outputs, physics=Ipc(level), pitch=0.1e-3, device="cpu")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        frames = [sensor.update(state) for state in sensor.load(scene).run(steps_per_stage=3)]
    return frames, [str(w.message) for w in told if issubclass(w.category, NarrowContactWarning)]


def ball(radius, *stages):
    scene = load_press("sphere")
    return replace(scene, object=replace(scene.object, params={"radius": radius}), trajectory=stages)


def test_a_contact_of_few_cells_is_warned_of_once_a_press():
    deep, sideways = StageSpec("indent", depth=0.3e-3), StageSpec("shear", shear=(1e-4, 0.0))
    frames, told = loop(ball(1.5e-3, deep, sideways))
    assert len(frames) == 7 and frames[0].contact_cells.shape == (1,) and np.isnan(frames[0].contact_cells[0])
    assert 1.0 < frames[3].contact_cells[0] < 3.0
    assert len(told) == 1
    width = f"{frames[3].contact_cells[0]:.1f} cells across"
    assert all(word in told[0] for word in ("level = 'coarse'", width, "at least 6", "choose level='medium'"))


def test_neither_a_wide_contact_nor_a_given_force_nor_an_image_is_warned_of():
    frames, told = loop(ball(15e-3, StageSpec("indent", depth=0.8e-3)))
    assert frames[-1].contact_cells[0] > 6.0 and not told
    frames, told = loop(ball(8e-3, StageSpec("indent", depth=0.8e-3)))
    assert frames[-1].contact_cells[0] > 6.0 and not told
    assert np.nanmin(frames[1].contact_cells) < 6.0  # narrow on the way, as every contact is
    frames, told = loop(ball(1.5e-3, StageSpec("indent", force=0.2), StageSpec("shear", shear=(1e-4, 0.0))))
    assert frames[-1].contact_cells[0] < 3.0 and not told
    frames, told = loop(ball(3e-3, StageSpec("indent", depth=0.3e-3)), outputs=("height",))
    assert "contact_cells" not in frames[-1].outputs and not told


@pytest.mark.slow
def test_a_fine_pad_has_cells_enough_for_the_shipped_ball():
    frames, told = loop("sphere", level="fine")
    assert max(np.nan_to_num(frame.contact_cells[0]) for frame in frames) > 9.0 and not told


def test_without_images_the_device_is_the_solvers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A soft pad that was solved on CUDA is not said to have been on the CPU because nothing was rendered."""
    monkeypatch.setattr(
        "raytac.sensor.tactile_sensor.resolve_device", lambda device, ray_tracing=True: "cpu" if ray_tracing else "cuda"
    )
    assert TactileSensor("gelsight_mini", physics="ipc", outputs=("height",)).device_used == "cuda"
    assert TactileSensor("gelsight_mini", outputs=("height",)).device_used == "cpu"


def test_the_correction_of_the_surface_is_a_choice() -> None:
    heights = []
    for correction in (Correction(), None):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NarrowContactWarning)
            sensor = TactileSensor(outputs=("height",), physics=Ipc(correction=correction), pitch=0.3e-3, device="cpu")
            heights.append(sensor.press(SCENE).height)
    assert 5e-6 < np.abs(heights[0] - heights[1]).max() < 0.1e-3
    with pytest.raises(InputError, match=r"correction = 3: must be a Correction"):
        Ipc(correction=3)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("physics", "outputs", "shares"), [("ipc", ("rgb",), 1), ("ipc", ("height",), 0), ("rigid", ("rgb",), 0)]
)
def test_images_share_the_cores_with_the_solver(physics, outputs, shares, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = []
    monkeypatch.setattr("raytac.optics.runtime.share_cores", lambda: shared.append(1))
    TactileSensor(outputs=outputs, physics=physics, pitch=0.2e-3, device="cpu").load(SCENE)
    assert len(shared) == shares
