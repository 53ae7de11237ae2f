"""The package ``taxim`` as a peer: what it is given, and that it answers."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from raytac.errors import BackendError
from raytac.report.compare.peer_taxim import AWAY_MM, PeerTaxim, contact_height_map
from tests.conftest import BALL_DEPTH, BALL_RADIUS, make_surface

WIDTH_MM = 18.88


def test_height_map_is_the_ball_where_it_touches_and_away_elsewhere() -> None:
    surface = make_surface()
    heights = contact_height_map(surface, (160, 120), WIDTH_MM)
    assert heights.shape == (1, 120, 160) and heights.dtype == np.float32
    pitch = WIDTH_MM / 160
    x, y = np.meshgrid((np.arange(160) - 79.5) * pitch, (np.arange(120) - 59.5) * pitch)
    under = 1e3 * (BALL_RADIUS - BALL_DEPTH) - np.sqrt(np.maximum((1e3 * BALL_RADIUS) ** 2 - x**2 - y**2, 0))
    touching = heights[0] < AWAY_MM
    radius = np.hypot(*np.meshgrid(1e3 * surface.grid.x, 1e3 * surface.grid.y))[surface.contact[0]].max()
    assert touching[np.hypot(x, y) < radius - 0.3].all() and not touching[np.hypot(x, y) > radius + 0.3].any()
    inner = np.hypot(x, y) < radius - 0.3
    np.testing.assert_allclose(heights[0][inner], under[inner], atol=0.01)  # bilinear in cells of 0.2 mm
    assert heights.min() == pytest.approx(-1e3 * BALL_DEPTH, abs=0.01)


def test_pixels_beyond_the_pad_see_nothing() -> None:
    surface = make_surface()
    everywhere = np.ones_like(surface.contact)
    pressed = type(surface)(surface.grid, surface.height, everywhere, surface.contact_centre)
    heights = contact_height_map(pressed, (64, 48), 60.0)
    assert (heights[0, 0] == AWAY_MM).all() and (heights[0, 24, 20:44] < AWAY_MM).all()


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(BackendError, match=r"pip install taxim\[jax-cpu\]"):
        PeerTaxim((64, 48), shadow=False, device="cpu")


@pytest.mark.slow
def test_the_package_renders_the_contact_in_its_place() -> None:
    pytest.importorskip("taxim")
    pytest.importorskip("jax")
    peer = PeerTaxim((80, 60), shadow=False, device="cpu")
    surface, still = make_surface(batch=2), make_surface(depth=0.0)
    pressed, rest = peer.render(surface).rgb, peer.render(still).rgb
    assert pressed is not None and rest is not None and pressed.shape == (2, 60, 80, 3) and pressed.dtype == np.uint8
    change = np.abs(pressed[0].astype(int) - rest[0]).max(axis=-1)
    assert change[25:35, 35:45].max() > 20 and change[:8].max() < 5
    np.testing.assert_array_equal(pressed[0], pressed[1])
