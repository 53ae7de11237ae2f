"""The coat's reflectance: energy, reciprocity, and one function for Mitsuba and for the fast integrator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.direct import ggx
from raytac.optics.trace.scene import coat_bsdf
from raytac.specs.sensor import CoatSpec

COATS = [CoatSpec((0.5, 0.4, 0.3), s, a) for s, a in ((0.0, 0.4), (0.05, 0.4), (0.3, 0.1), (0.8, 0.9))]
WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def mi() -> Any:
    return load_mitsuba("cpu")[0]


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit vectors (3, n) above the surface, uniform over the hemisphere but for the last degrees."""
    z = rng.uniform(0.05, 1.0, n)
    phi = rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z]).astype(np.float32)


def microfacet(alpha: float, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """D G / (4 cos cos) of GGX in NumPy, written from Walter et al. 2007, eq. 33 (D) and 34 (G1), in terms of tangents."""
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=0)

    def tan2(c: np.ndarray) -> np.ndarray:
        return (1 - c**2) / c**2

    d = alpha**2 / (np.pi * h[2] ** 4 * (alpha**2 + tan2(h[2])) ** 2)
    g = 4 / ((1 + np.sqrt(1 + alpha**2 * tan2(wi[2]))) * (1 + np.sqrt(1 + alpha**2 * tan2(wo[2]))))
    return d * g / (4 * wi[2] * wo[2])


def lobe_alone(mi: Any, alpha: float, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f (n,) of the lobe: that of a black coat which sends half of the light into it, doubled."""
    return 2 * reflectance(mi, CoatSpec((0.0, 0.0, 0.0), 0.5, alpha), wi, wo)[0]


def reflectance(mi: Any, coat: CoatSpec, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f (3, n) of the fast integrator's formula."""
    normal = dr.zeros(mi.Normal3f, wi.shape[1]) + mi.Normal3f(0, 0, 1)
    lobe = np.array(ggx(coat.roughness, normal, mi.Vector3f(wi), mi.Vector3f(wo)))
    base = (1 - coat.specular) / np.pi * np.asarray(coat.reflectance)
    return base[:, None] + coat.specular * lobe[None]


def mitsuba_eval(mi: Any, coat: CoatSpec, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f cos θ_o (3, n) of the BSDF that the scene uses."""
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = mi.Vector3f(wi)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return np.array(mi.load_dict(coat_bsdf(coat)).eval(mi.BSDFContext(), si, mi.Vector3f(wo)))


@pytest.mark.parametrize("coat", COATS, ids=str)
def test_fast_and_mitsuba_have_one_reflectance(mi: Any, coat: CoatSpec) -> None:
    rng = np.random.default_rng(1)
    wi, wo = directions(rng, 4000), directions(rng, 4000)
    fast = reflectance(mi, coat, wi, wo) * wo[2]
    assert np.abs(fast / mitsuba_eval(mi, coat, wi, wo) - 1).max() < 2e-4


@pytest.mark.parametrize("alpha", [0.05, 0.4, 1.0])
def test_the_lobe_is_the_published_one_and_reciprocal(mi: Any, alpha: float) -> None:
    rng = np.random.default_rng(2)
    wi, wo = directions(rng, 4000), directions(rng, 4000)
    there, back = lobe_alone(mi, alpha, wi, wo), lobe_alone(mi, alpha, wo, wi)
    np.testing.assert_allclose(there, back, rtol=1e-5)
    # The peak of a narrow lobe amplifies float32 rounding of the half vector.
    assert np.abs(there / microfacet(alpha, wi.astype(float), wo.astype(float)) - 1).max() < 2e-3


def albedo(alpha: float, cos_o: float, n: int = 800) -> float:
    """∫ f cos dω of the lobe in float64 over the half vector's hemisphere, where its integrand is smooth."""
    # cos² of the half vector's angle, distributed as D(h) cos: D and the Jacobian cancel (Walter et al. 2007, eq. 35 and 38).
    u, phi = (np.arange(n) + 0.5) / n, 2 * np.pi * (np.arange(n) + 0.5) / n
    u, phi = np.meshgrid(u, phi)
    tan2 = alpha**2 * u / (1 - u)
    cos_h = 1 / np.sqrt(1 + tan2)
    sin_h = np.sqrt(1 - cos_h**2)
    h = np.stack([sin_h * np.cos(phi), sin_h * np.sin(phi), cos_h])
    o = np.array([np.sqrt(1 - cos_o**2), 0, cos_o])[:, None, None]
    o_h = (o * h).sum(0)
    i = 2 * o_h * h - o
    ok = (i[2] > 1e-9) & (o_h > 0)

    def g1(c: np.ndarray | float) -> np.ndarray:
        c = np.maximum(c, 1e-9)
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 - c**2) / c**2))

    weight = np.where(ok, g1(np.maximum(i[2], 1e-9)) * g1(cos_o) * o_h / (cos_o * cos_h), 0)
    return float(weight.mean())


@pytest.mark.parametrize(("alpha", "least"), [(0.1, 0.97), (0.4, 0.74), (0.9, 0.35)])
@pytest.mark.parametrize("cos_o", [0.99, 0.6])
def test_the_lobe_returns_no_more_than_it_got(mi: Any, alpha: float, least: float, cos_o: float) -> None:
    n = 1200
    cos_i, phi = np.meshgrid((np.arange(n) + 0.5) / n, 2 * np.pi * (np.arange(n) + 0.5) / n)
    r = np.sqrt(1 - cos_i**2)
    wi = np.stack([r * np.cos(phi), r * np.sin(phi), cos_i]).reshape(3, -1).astype(np.float32)
    wo = np.repeat(np.array([[np.sqrt(1 - cos_o**2)], [0], [cos_o]], np.float32), wi.shape[1], axis=1)
    integral = float((lobe_alone(mi, alpha, wi, wo) * wi[2]).mean() * 2 * np.pi)
    assert integral == pytest.approx(albedo(alpha, cos_o), rel=3e-3)
    # Light that meets two facets is lost: the more so, the rougher.
    assert least < integral < 1.0


def furnace(mi: Any, coat: CoatSpec, cos_o: float, n: int = 1 << 18) -> float:
    """Radiance that leaves a plane of ``coat`` at this angle under light 1 from everywhere: the mean weight of samples."""
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cos_o**2)), 0, cos_o) + dr.zeros(mi.Vector3f, n)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, n)
    _, weight = mi.load_dict(coat_bsdf(coat)).sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return float(np.array(weight, dtype=np.float64).mean())


@pytest.mark.parametrize("cos_o", [1.0, 0.5, 0.2])
def test_white_furnace(mi: Any, cos_o: float) -> None:
    coat = CoatSpec(WHITE, 0.0, 0.4)
    assert furnace(mi, coat, cos_o) == pytest.approx(1.0, abs=1e-6)
    for specular, alpha, least in ((0.05, 0.4, 0.985), (0.5, 0.9, 0.65)):
        blend = furnace(mi, replace(coat, specular=specular, roughness=alpha), cos_o)
        # The only loss is what one reflection on a rough mirror loses to shadowing between its facets.
        lost = specular * (1 - albedo(alpha, cos_o))
        assert blend == pytest.approx(1 - lost, abs=2e-3 * specular)
        assert least < blend < 1
