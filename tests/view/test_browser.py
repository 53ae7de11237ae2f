"""The page in a real browser without a window: it draws, its buttons and sliders work. Skipped where there is no Chromium."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from raytac.sensor import TactileSensor
from raytac.specs import load_press
from raytac.view.press_session import PressSession
from raytac.view.viewer import Viewer

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
def viewer() -> Iterator[Viewer]:
    sensor = TactileSensor("gelsight_mini", physics="rigid", optics="phong", outputs=("rgb", "wrench"), resolution=(160, 120))
    with Viewer(PressSession(sensor, load_press("sphere")), port=0) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(viewer: Viewer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        context = driver.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"),
            executable_path=CHROMIUM,
            headless=True,
            args=list(FLAGS),
            viewport={"width": 1000, "height": 620},
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
    field = page.locator("input[type=text]").first
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
