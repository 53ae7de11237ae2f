"""The page in a real browser without a window: it draws, its buttons and sliders work. Skipped where there is no Chromium."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from PIL import Image

from raytac.sensor import TactileSensor
from raytac.specs import load_press, load_task
from raytac.view.press_session import PressSession
from raytac.view.session import SessionMenu
from raytac.view.viewer import Viewer
from raytac.view.world_session import WorldSession
from raytac.world import TactileWorld

playwright = pytest.importorskip("playwright.sync_api", reason="playwright, which drives the browser, is not installed")

CHROMIUM = os.environ.get("CHROMIUM") or next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
pytestmark = [
    pytest.mark.slow,  # a browser without a graphics card
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium in PATH, and the variable CHROMIUM names none"),
]
FLAGS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
PATIENCE = 60_000
"""Of the browser [ms]: it draws without a graphics card."""


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    menu = SessionMenu({"object": ("sphere", "torus", "broken")}, {"object": "sphere"}, made)
    folder = tmp_path_factory.mktemp("runs")
    with Viewer(made({"object": "sphere"}), menu=menu, folder=folder, port=0) as opened:
        yield opened


def made(choice: Mapping[str, str]) -> PressSession:
    """The press of a choice in the page; its markers move."""
    sensor = TactileSensor(
        "gelsight_mini_7x9", optics="phong", markers="fots", outputs=("rgb", "wrench", "normals"), resolution=(160, 120)
    )
    return PressSession(sensor, load_press(choice["object"]))


@pytest.fixture(scope="module")
def page(viewer: Viewer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        context = driver.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"),
            executable_path=CHROMIUM,
            headless=True,
            args=list(FLAGS),
            viewport={"width": 1000, "height": 900},
            accept_downloads=True,
        )
        page = context.pages[0]
        page.set_default_timeout(PATIENCE)
        page.goto(viewer.url)
        page.get_by_text("paused").wait_for()
        yield page
        context.close()


def press(page: Any, button: str) -> None:
    # An event, not a click: waiting until a button stands still takes frames, of which a software renderer has few.
    page.get_by_role("button", name=button, exact=True).dispatch_event("click")


def number(page: Any, label: str) -> Any:
    """The field beside a slider."""
    return page.locator(f"xpath=//label[normalize-space()='{label}']/following::input[@type='text'][1]").first


def enter(page: Any, viewer: Viewer, label: str, value: float) -> None:
    """Type a value beside a slider until it is reached: a browser that draws slowly undoes what is typed while it catches up."""
    for _ in range(5):
        number(page, label).fill(f"{value:g}")
        number(page, label).press("Enter")
        for _ in range(40):
            page.wait_for_timeout(200)
            if abs(controls(viewer)[label] - value) < 0.02 and viewer.player.status.mode == "paused":
                return
    keep(page, "late")
    raise AssertionError(f"{label} is not {value:g}")


def choose(page: Any, label: str, option: str) -> None:
    """Choose an option of a drop-down."""
    box = page.locator(f"xpath=//label[normalize-space()='{label}']/following::input[1]").first
    box.dispatch_event("click")
    page.get_by_role("option", name=option, exact=True).dispatch_event("click")


def tick(page: Any, label: str) -> None:
    """Tick a box, or take the tick away."""
    page.locator(f"xpath=//label[normalize-space()='{label}']/following::input[@type='checkbox'][1]").first.dispatch_event(
        "click"
    )


def canvas(page: Any) -> np.ndarray:
    """The 3-D view, (H, W, 3), between the panels."""
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=PATIENCE))).convert("RGB"))
    return shot[:, 390:650]


def test_the_pad_is_drawn_in_the_colours_of_the_scale(page):
    page.wait_for_function("document.querySelector('canvas') !== null")
    for _ in range(20):  # the view fades in
        view = canvas(page).astype(int)
        purple = (view[..., 2] > view[..., 1] + 40) & (view[..., 0] > view[..., 1])
        if purple.mean() > 0.1:
            break
        page.wait_for_timeout(500)
    assert purple.mean() > 0.1, "no coat in viridis' first colour"


def test_pressing_by_hand_changes_image_and_view(page):
    before = canvas(page).astype(int)
    image = page.locator("img").first.get_attribute("src")
    field = number(page, "depth [mm]")
    field.fill("0.8")
    field.press("Enter")
    page.get_by_text("held by the sliders").wait_for()
    page.get_by_text("0.800 mm").first.wait_for()
    page.get_by_text("paused").wait_for()
    assert page.locator("img").first.get_attribute("src") != image
    for _ in range(20):
        after = canvas(page).astype(int)
        if (np.abs(after - before).max(axis=-1) > 30).mean() > 0.01:
            break
        page.wait_for_timeout(500)
    assert (np.abs(after - before).max(axis=-1) > 30).mean() > 0.01


def test_the_buttons_play_pause_and_reset(page, viewer):
    press(page, "Play")
    page.get_by_text("states/s").wait_for()
    press(page, "Pause")
    page.get_by_text("paused").wait_for()
    assert viewer.player.status.mode == "paused" and viewer.player.status.count > 0
    press(page, "Reset")
    page.get_by_text("start 100 %").wait_for()
    assert viewer.player.status.count == 0


def test_every_control_of_a_press_does_something(page, viewer):
    """Screenshots go to the folder of the variable ``RAYTAC_SCREENSHOTS``, to be looked at."""
    for label, value in (
        ("depth [mm]", 0.9),
        ("shear x [mm]", 0.3),
        ("shear y [mm]", -0.2),
        ("twist [°]", 5.0),
        ("force [N]", 2.0),
    ):
        enter(page, viewer, label, value)
    page.get_by_text("paused").wait_for()
    page.get_by_text("gelsight_mini_7x9: force [N]").wait_for()
    page.get_by_text("gelsight_mini_7x9: markers [px]").wait_for()
    keep(page, "press")
    image = page.locator("img").first
    for kind in ("difference × 2", "height", "normals", "tactile image"):
        before = image.get_attribute("src")
        choose(page, "picture", kind)
        wait_until(lambda before=before: image.get_attribute("src") != before, page)
        keep(page, kind.split()[0])
    before = image.get_attribute("src")
    tick(page, "arrows × 2")
    wait_until(lambda: image.get_attribute("src") != before, page)
    tick(page, "arrows × 2")
    tick(page, "plots")
    page.get_by_text("gelsight_mini_7x9: force [N]").wait_for(state="hidden")
    tick(page, "plots")
    for label in ("see through", "handle", "see through", "handle"):
        tick(page, label)
    press(page, "gelsight_mini_7x9")
    press(page, "all")
    count = len(viewer._page._history)
    number(page, "timeline").fill("1")
    number(page, "timeline").press("Enter")
    page.get_by_text(f"state 2 of {count}").wait_for()
    keep(page, "past")
    press(page, "Step")
    page.get_by_text("looking back").wait_for(state="hidden")


def test_what_is_saved_comes_as_a_download_with_the_3d_view(page):
    with page.expect_download(timeout=PATIENCE) as told:
        press(page, "PNG")
    saved = Image.open(told.value.path())
    assert told.value.suggested_filename.endswith(".png") and saved.height > 720 and saved.width > 1.5 * saved.height
    assert np.ptp(np.asarray(saved.convert("L"), int)[:700, :900]) > 100  # there is something in the 3-D view
    if os.environ.get("RAYTAC_SCREENSHOTS"):
        saved.save(os.path.join(os.environ["RAYTAC_SCREENSHOTS"], "saved.png"))
    tick(page, "save 3-D view")
    for kind, suffix in (("GIF", ".gif"), ("Recording", ".npz")):
        with page.expect_download(timeout=PATIENCE) as told:
            press(page, kind)
        assert told.value.suggested_filename.endswith(suffix)
        page.get_by_text(told.value.suggested_filename).first.wait_for()
    press(page, "MP4")
    page.get_by_text("imageio-ffmpeg").or_(page.get_by_text(".mp4")).first.wait_for()


def test_the_handle_can_be_dragged(page, viewer):
    press(page, "Reset")
    page.get_by_text("start 100 %").wait_for()
    page.wait_for_timeout(1000)
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=PATIENCE))).convert("RGB")).astype(int)
    middle = shot[:, 390:650]
    blue = (middle[..., 2] > 180) & (middle[..., 0] < 120) & (middle[..., 1] > 110) & (middle[..., 1] < 190)
    rows, columns = np.nonzero(blue)
    top = rows.argmin()  # the tip of the arrow along z
    x, y = 390 + int(columns[rows < rows.min() + 8].mean()), int(rows[top]) + 8
    page.mouse.move(x, y)
    page.wait_for_timeout(500)
    page.mouse.down()
    for k in range(1, 9):
        page.mouse.move(x, y + 6 * k)
        page.wait_for_timeout(150)
    page.mouse.up()
    wait_until(lambda: controls(viewer)["depth [mm]"] > 0.1, page)
    assert controls(viewer)["depth [mm]"] <= 1.6 + 1e-6
    keep(page, "dragged")


def test_another_object_is_chosen_and_one_that_cannot_be_is_said(page, viewer):
    choose(page, "object", "broken")
    page.get_by_text("no shipped file of this name").wait_for()
    assert viewer.player.session.title.startswith("sphere")
    keep(page, "error")
    choose(page, "object", "torus")
    page.get_by_text("torus · gelsight_mini_7x9").wait_for()
    page.get_by_text("paused").wait_for()
    press(page, "Step")
    wait_until(lambda: viewer.player.status.count == 1, page)
    assert viewer.player.session.title.startswith("torus")


def test_every_control_of_a_task_does_something(page, tmp_path):
    """In the same browser, on a page of its own: a robot with two sensors, steered and played."""
    world = TactileWorld(
        load_task("lift_cube"), optics="phong", outputs=("rgb", "wrench", "normals"), resolution=(80, 60), device="cpu"
    )
    session = WorldSession(world, steps=4)
    with Viewer(session, folder=tmp_path, port=0) as viewer:
        task = page.context.new_page()
        task.set_default_timeout(PATIENCE)
        task.goto(viewer.url)
        task.get_by_text("paused").wait_for()
        by_joints = [control for control in session.controls if control.name.startswith("joint ")]
        others = [control for control in session.controls if control not in by_joints]
        assert len(by_joints) == 7 and {"x", "yaw", "opening"} <= {control.name for control in others}
        for group in (others, by_joints):  # joints take over from the pose
            now, aims = session.snapshot().controls, {}
            for control in group:
                sign = 1 if now[control.name] + 10 * control.step <= control.high else -1
                aims[control.name] = now[control.name] + sign * 10 * control.step
            missing = list(group)
            for _ in range(5):  # a browser that draws slowly undoes what is typed while it catches up
                for control in missing:
                    number(task, control.label).fill(f"{aims[control.name]:.4f}")
                    number(task, control.label).press("Enter")
                task.wait_for_timeout(500)
                count = viewer.player.status.count
                press(task, "Step")
                wait_until(lambda count=count: viewer.player.status.count > count and viewer.player.status.mode == "paused", task)
                asked = session.snapshot().controls
                missing = [c for c in group if abs(asked[c.name] - aims[c.name]) > 2 * c.step]
                if not missing:
                    break
            assert {c.label for c in missing} == set()
        keep(task, "task")
        start = task.locator("img").first.get_attribute("src")
        began = session.snapshot().time or 0.0
        press(task, "Play")
        wait_until(lambda: viewer.player.status.count > 4, task)
        press(task, "Pause")
        task.get_by_text("paused").wait_for()
        assert (session.snapshot().time or 0.0) > began > 0.0
        for kind in ("height", "normals", "tactile image"):
            before = task.locator("img").first.get_attribute("src")
            choose(task, "picture", kind)
            wait_until(lambda before=before: task.locator("img").first.get_attribute("src") != before, task)
        assert start is not None
        for label in ("plots", "see through", "handle"):
            tick(task, label)
            tick(task, label)
        for look in (*world.sensors, "all"):
            press(task, look)
        number(task, "timeline").fill("1")
        number(task, "timeline").press("Enter")
        task.get_by_text(f"state 2 of {len(viewer._page._history)}").wait_for()
        keep(task, "task_past")
        tick(task, "save 3-D view")
        for kind in ("PNG", "Recording"):
            with task.expect_download(timeout=PATIENCE) as told:
                press(task, kind)
            assert (tmp_path / told.value.suggested_filename).stat().st_size > 1000
        press(task, "Reset")
        wait_until(lambda: viewer.player.status.count == 0, task)
        assert session.snapshot().time == 0.0
        task.close()


def controls(viewer: Viewer) -> dict[str, float]:
    """Value of every control in the state that is shown, by label."""
    shown = viewer._page._last
    assert shown is not None
    return {control.label: shown.controls[control.name] for control in viewer.player.session.controls}


def wait_until(happened: Callable[[], bool], page: Any) -> None:
    """Wait until the page or the session has done something."""
    for _ in range(200):
        if happened():
            return
        page.wait_for_timeout(200)
    keep(page, "late")
    raise AssertionError("it did not happen")


def keep(page: Any, name: str) -> None:
    """Keep a screenshot, if somebody wants to look at it."""
    folder = os.environ.get("RAYTAC_SCREENSHOTS")
    if folder:
        page.screenshot(path=os.path.join(folder, f"{name}.png"), timeout=PATIENCE)
