"""Shadow rays that bounds leave out see all of their LED: with bounds that leave out none, every share is the same."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

from raytac.optics.geometry import CoatField, PixelSample, concave_cover
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.direct import arrival
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.occluders import Occluders, Wedge
from raytac.specs.sensor import RefractionSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import SMALL, grid_of, led, lit_from_three_sides, sensor

STRIPS = (
    led("left", (-12.5e-3, 1e-3, -5.5e-3), (0.0, 1e-3, -3e-3), size=(18e-3, 0.4e-3)),
    led("bottom", (2e-3, 12.0e-3, -6e-3), (0.0, 0.0, -3e-3), size=(20e-3, 1e-3)),
)
SLAB = RefractionSpec("slab", 1.41, 0.5e-3)
SPECS = {
    "strips": sensor(STRIPS),
    "points": sensor(lit_from_three_sides()),
    "domed": sensor(STRIPS, dome=(30e-3, 25e-3)),
    "over the pad": sensor([led("one", (1e-3, -2e-3, -7e-3), (0.0, 0.0, 0.0), size=(5e-3, SMALL[1]))]),
    "behind glass": replace(sensor(STRIPS), refraction=SLAB),
}


def pressed(spec: SensorSpec, shape: str) -> np.ndarray:
    """Heights (Ny, Nx) [m] of one pillar or of several on the gel at rest, or of several on one with a dent and a bulge."""
    grid, rng = grid_of(spec), np.random.default_rng(5)
    x, y = grid.x[None, :], grid.y[:, None]
    if shape == "one pillar":
        return grid.rest - np.where((np.abs(x - 6e-3) < 0.7e-3) & (np.abs(y) < 0.7e-3), 1e-3, 0.0)
    depth = np.zeros(grid.shape)
    for _ in range(6):
        at, half = rng.uniform(-7e-3, 7e-3, 2), rng.uniform(0.4e-3, 0.9e-3)
        depth[(np.abs(x - at[0]) < half) & (np.abs(y - at[1]) < half)] = rng.uniform(0.8e-3, 1.4e-3)
    if shape == "pillars":
        return grid.rest - depth
    dent, bulge = (np.exp(-((x - at) ** 2 + y**2) / (3e-3) ** 2) for at in (-3e-3, 4e-3))
    return grid.rest - depth - 0.5e-3 * dent + 0.2e-3 * bulge


@pytest.fixture
def spans(monkeypatch: pytest.MonkeyPatch) -> list[list[np.ndarray]]:
    """Spans (blocks, 4) of every LED, of each call of ``Occluders.spans``."""
    real, kept = Occluders.spans, []

    def spans(self: Occluders, mi: Any, depths: Any, lamps: Any) -> list[Any]:
        result = real(self, mi, depths, lamps)
        kept.append([np.array(span).reshape(-1, 4) for span in result])
        return result

    monkeypatch.setattr(Occluders, "spans", spans)
    return kept


def shares(mode: Any, height: np.ndarray) -> np.ndarray:
    """Shares (nodes, LEDs) that the nodes of the shadow grid see."""
    mi, own = mode.mi, mode._inputs.own
    field = CoatField(mi, mode.layout, mode._inputs.rest, mi.Float(height.astype(np.float32).ravel()))
    packets = own.shadow.shares(mi, field, own.occluders, own.lamps, 1, mode.slab)
    return np.concatenate([np.array(p).reshape(-1, 4) for p in packets], axis=1)[:, : len(own.lamps)]


def prepared(tracer: Build, name: str) -> Any:
    mode = tracer(SPECS[name], bounce=False)
    mode.prepare(grid_of(SPECS[name]))
    return mode


@pytest.mark.parametrize("shape", ["one pillar", "pillars", "bulge"])
@pytest.mark.parametrize("name", SPECS)
def test_what_is_left_out_sees_all_of_its_led(
    tracer: Build, monkeypatch: pytest.MonkeyPatch, spans: list[list[np.ndarray]], name: str, shape: str
) -> None:
    mode, height = prepared(tracer, name), pressed(SPECS[name], shape)
    found, spans = shares(mode, height), spans[-1:]  # not those of the image at rest, if the tracer rendered one for its warning

    def all_of_them(self: Occluders, mi: Any, depths: Any, lamps: Any) -> list[Any]:
        blocks = dr.zeros(mi.Float, dr.width(depths.blocks) // 2)
        every = dr.ravel(mi.Vector4f(0, 1, depths.deepest, 0) + mi.Vector4f(blocks, 0, 0, 0))
        dr.eval(every)
        return [every for _ in lamps]

    monkeypatch.setattr(Occluders, "spans", all_of_them)
    expected = shares(mode, height)
    assert expected.min() < 0.5, "no shadow"
    np.testing.assert_allclose(found, expected, atol=1e-6)
    # What bulges may shade anything, and so may gel that is touched in many places of a dome that falls off as steeply as light arrives.
    if shape == "one pillar" or (shape == "pillars" and name != "domed"):
        skipped = np.mean([span[:, 0] > span[:, 1] for span in spans[0]])
        assert skipped > 0.05, f"only {skipped:.1%} of the blocks are left out"


@pytest.mark.parametrize("name", SPECS)
def test_at_rest_nothing_is_walked(tracer: Build, spans: list[list[np.ndarray]], name: str) -> None:
    found = shares(prepared(tracer, name), grid_of(SPECS[name]).rest)
    assert (found == 1).all() and all((span[:, 0] > span[:, 1]).all() for span in spans[0])


@pytest.mark.parametrize("name", SPECS)
def test_no_ray_is_lower_over_the_gel_than_its_block_says(tracer: Build, name: str) -> None:
    """Least clearance along rays from random places, to 2 mm deep, to every place of an LED that is looked at."""
    mode, spec = prepared(tracer, name), SPECS[name]
    mi, own, grid, rng = mode.mi, mode._inputs.own, grid_of(spec), np.random.default_rng(7)
    cover, tiling = concave_cover(grid), own.occluders.tiling
    x, y = (rng.uniform(t[0], t[-1], 4000) for t in (grid.x, grid.y))

    def rest(at_x: np.ndarray, at_y: np.ndarray) -> np.ndarray:
        return cover[tuple(np.abs(t[:, None] - np.clip(v, t[0], t[-1])).argmin(0) for t, v in ((grid.y, at_y), (grid.x, at_x)))]

    depth = rng.uniform(0.0, 2e-3, len(x))
    p = mi.Point3f(*(mi.Float(v.astype(np.float32)) for v in (x, y, rest(x, y) - depth)))
    block = np.array(tiling.block(mi, mi.UInt32(0), p.x, p.y))
    seen = PixelSample(mi.UInt32(0), p, mi.Normal3f(0, 0, -1), mi.Vector3f(0, 0, -1))
    for lamp, count, slopes in zip(own.lamps, own.shadow.counts, own.occluders.slopes, strict=True):
        slope, fall, reach, _ = np.array(slopes).reshape(-1, 4)[block].T
        counted, steps = np.minimum(depth, 1e-3), count * own.shadow.block**2
        for k in range(steps):
            u, density = lamp.sight(mi, p).at((k + 0.5) / steps)
            light = arrival(mi, seen, lamp, lamp.point(u, 0), mode.slab)
            to = [np.resize(np.array(v, float), x.shape) for v in light.target]
            distance = np.hypot(to[0] - x, to[1] - y)
            assert (distance <= 1.001 * reach).all()
            ray = (rest(to[0], to[1]) - to[2] - depth) / distance - np.array(light.tangent(lamp, density / steps))
            for s in np.linspace(0.02, 1.0, 9)[:, None] * distance:
                assert (depth + ray * s >= counted + (slope - counted * fall) * s - 1e-7).all()


def test_a_wedge_has_what_lies_towards_its_led() -> None:
    """Every point between a place of a disc and a place of the LED lies in the wedge from the disc's middle, and in its box."""
    mi = load_mitsuba("cpu")[0]
    rng = np.random.default_rng(3)
    for _ in range(40):
        position, radius = rng.uniform(-12e-3, 12e-3, 2), 0.6e-3
        lamp = Lamp.from_spec(mi, led("one", (*position.tolist(), -6e-3), size=(rng.uniform(1e-4, 20e-3), SMALL[1])))
        middle = rng.uniform(-9e-3, 9e-3, 2)
        wedge = Wedge.of(mi, lamp, mi.Float(middle[0]), mi.Float(middle[1]), radius)
        turn, u, t = rng.uniform(0, 2 * np.pi, 200), rng.uniform(-1, 1, 200), rng.uniform(0, 1, 200)
        p = middle[:, None] + radius * np.stack([np.cos(turn), np.sin(turn)])
        centre, half = (np.array(v).ravel()[:2, None] for v in (lamp.centre, lamp.half_u))
        at = (1 - t) * p + t * (centre + u * half)
        dx, dy = (mi.Float(v.astype(np.float32)) for v in at - middle[:, None])
        assert np.array(wedge.has(dx, dy, 1.001 * radius, 1.001 * radius)).all()
        reach = float(np.linalg.norm(centre + u * half - middle[:, None], axis=0).max())
        box = [float(np.array(side)[0]) for side in wedge.box(mi.Float(reach), 1.001 * radius, 1e-3, 1e-3, 99, 99)]
        columns, rows = (v / 1e-3 for v in at - middle[:, None])
        assert box[0] <= columns.min() and columns.max() <= box[1] and box[2] <= rows.min() and rows.max() <= box[3]
        away = middle - 3 * (centre[:, 0] - middle)
        if not bool(np.array(wedge.is_all)[0]) and np.linalg.norm(away - middle) > 0.1:
            dx, dy = (mi.Float(v) for v in away - middle)
            assert not np.array(wedge.has(dx, dy, radius, radius)).any()
