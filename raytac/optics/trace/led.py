"""LEDs: how they emit (``lobe_gain``), on the device (``Lamp``), and as Mitsuba's emitter.

A die behind a lens does not emit like a Lambertian patch. The usual lobe is an intensity I(θ) = I₀ cosⁿ θ about the axis; spread over
a rectangle of area A this is the radiance L(θ) = (I₀ / A) cosⁿ⁻¹ θ, because a patch shrinks with cos θ. n = 1 is Mitsuba's ``area``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.optics.power import power
from raytac.optics.trace.quadrature import quadrature
from raytac.specs.sensor import LedSpec

PLUGIN = "raytac_led"
"""Name of the emitter in Mitsuba's scenes."""
LEAST_COSINE = 1e-6
"""Cosine that stands for all smaller ones, so that a power of it is defined for every angle."""


def lobe_gain(ops: Any, cos_theta: Any, exponent: Any, least: float = LEAST_COSINE) -> Any:
    """cosⁿ θ of a lobe in front, by ``ops``; n is ``lobe``, for the radiance ``lobe`` − 1."""
    return ops.power(ops.maximum(cos_theta, least), exponent)


def lobe_slopes(cos_theta: np.ndarray, exponent: float, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of log ``lobe_gain`` by cos θ and by n."""
    cosine = np.maximum(cos_theta, least)
    return np.where(cos_theta > least, exponent / cosine, 0), np.log(cosine)


@dataclass(frozen=True)
class Sight:
    """A segment of half length ``half`` that spans ``span`` [rad] from ``start``, seen from p.

    Angles count from the perpendicular on its line, which is ``distance`` long and meets it ``foot`` short of the segment's middle.
    """

    half: Any
    foot: Any
    distance: Any
    start: Any
    span: Any

    def at(self, share: Any) -> tuple[Any, Any]:
        """Place u in [−1, 1] at ``share`` in [0, 1] of the angle, and length over 2 half by share."""
        tangent = dr.tan(self.start + share * self.span)
        u = dr.clip((self.distance * tangent - self.foot) / self.half, -1, 1)
        return u, 0.5 * self.span * self.distance * (1 + tangent * tangent) / self.half


@dataclass(frozen=True)
class Fan:
    """Directions from p to a segment, which spans the angle ``span`` [rad].

    At the angle δ from the middle of it the direction is ``middle`` cos δ + ``beside`` sin δ. A stretch dδ of the segment at the distance r
    is dδ r² / h long, with the distance h of its line. So light that falls off as 1 / r² depends on the direction alone.
    """

    middle: Any
    beside: Any
    """Unit vectors."""
    span: Any
    density: Any
    """Share of the segment's length over r² by δ [1/m² per rad]."""


@dataclass(frozen=True)
class Lamp:
    """Dr.Jit arrays of one LED, and the even radiance of the case that goes with it.

    Centre [m], unit axis, half edges [m], lobe exponent n, on-axis intensity (linear RGB) [W/sr]; radiance (linear RGB) [W/(m² sr)],
    None if there is none. Intensity is I(θ) = power · cosⁿ θ for the whole rectangle, so a small one is a point light.
    """

    centre: Any
    axis: Any
    half_u: Any
    """Half of the edge that is longer as the pad's camera sees it, by its extent in x and y."""
    half_v: Any
    lobe: Any
    power: Any
    glow: Any = None

    @classmethod
    def from_spec(cls, mi: Any, led: LedSpec, unit: float = 1.0) -> Lamp:
        """The LED in ``unit`` length units per metre; power grows with unit², so that I / r² stays."""
        halves = [0.5 * unit * length * edge for length, edge in zip(led.size, np.array(led.edges), strict=True)]
        if quadrature(led).upright:
            halves.reverse()
        lamp = cls(
            centre=mi.Point3f([unit * c for c in led.position]),
            axis=mi.Vector3f(*led.axis),
            half_u=mi.Vector3f(halves[0].tolist()),
            half_v=mi.Vector3f(halves[1].tolist()),
            lobe=mi.Float(led.lobe),
            power=mi.Color3f([unit**2 * p for p in led.power]),
            glow=mi.Color3f([led.glow * p for p in led.power]) if led.glow else None,
        )
        # Opaque values keep one kernel for every LED file and let a fit change them without recompiling.
        dr.make_opaque(lamp.centre, lamp.axis, lamp.half_u, lamp.half_v, lamp.lobe, lamp.power, lamp.glow)
        return lamp

    def sample(self, square: Any) -> Any:
        """Point on the rectangle for ``square`` in [0, 1)²."""
        return self.point(2 * square.x - 1, 2 * square.y - 1)

    def point(self, u: Any, v: Any) -> Any:
        """Point on the rectangle for ``u`` and ``v`` in [−1, 1]."""
        return self.centre + u * self.half_u + v * self.half_v

    def sight(self, mi: Any, p: Any) -> Sight:
        """The longer edge's middle line as ``p`` sees it."""
        half = dr.norm(self.half_u)
        along, q = self.half_u / half, self.centre - p
        foot = dr.dot(q, along)
        distance = dr.maximum(dr.norm(q - foot * along), 1e-6)
        start = dr.atan2(foot - half, distance)
        return Sight(half, foot, distance, start, dr.atan2(foot + half, distance) - start)

    def fan(self, p: Any) -> Fan:
        """Directions from ``p`` to the longer edge's middle line."""
        length = dr.squared_norm(self.half_u)
        per_half = dr.rsqrt(length)  # roots and divisions take as long as ten products
        half, along, q = length * per_half, self.half_u * per_half, self.centre - p
        foot = dr.dot(q, along)
        across = q - foot * along
        square = dr.maximum(dr.squared_norm(across), 1e-12)
        inverse = dr.rsqrt(square)
        distance, across = square * inverse, across * inverse
        first, last = foot - half, foot + half
        near, far = dr.rsqrt(square + first * first), dr.rsqrt(square + last * last)
        # Unit vectors to both ends add up to one in the middle of their angle.
        cosine, sine = distance * (near + far), first * near + last * far
        unit = dr.rsqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine * unit, sine * unit
        span = dr.atan2(2 * half * distance, square + first * last)
        return Fan(cosine * across + sine * along, cosine * along - sine * across, span, 0.5 * inverse * per_half)

    def lobe_gain(self, direction: Any) -> Any:
        """cosⁿ θ for light leaving along the unit ``direction``; 0 behind."""
        return self.lobe_at(dr.dot(direction, self.axis))

    def lobe_at(self, cos_theta: Any) -> Any:
        """The same by the cosine."""
        return dr.select(cos_theta > 0, power(dr.maximum(cos_theta, LEAST_COSINE), self.lobe), 0)


_PICKED = ("centre", "axis", "half_u", "half_v", "lobe", "power")
"""Fields of ``Lamp`` that a path needs of an LED that it picks."""


@dataclass(frozen=True)
class LampTable:
    """All LEDs of a sensor in one array a quantity, so that a path can pick one by index."""

    lamps: Lamp
    """Each field has one entry an LED."""
    group: Any
    """Layer index of each LED."""

    @classmethod
    def of(cls, mi: Any, lamps: list[Lamp], groups: list[int]) -> LampTable:
        columns = {}
        for name in _PICKED:
            values = np.concatenate([np.array(getattr(lamp, name)).reshape(-1, 1) for lamp in lamps], axis=1)
            columns[name] = type(getattr(lamps[0], name))(values if len(values) > 1 else values[0])
        return cls(Lamp(**columns), mi.UInt32(np.asarray(groups, dtype=np.uint32)))

    def pick(self, mi: Any, u: Any) -> tuple[Lamp, Any]:
        """One LED chosen uniformly by ``u`` in [0, 1), and its group."""
        count = dr.width(self.group)
        index = dr.minimum(mi.UInt32(u * count), count - 1)
        columns = {name: getattr(self.lamps, name) for name in _PICKED}
        lamp = Lamp(**{name: dr.gather(type(column), column, index) for name, column in columns.items()})
        return lamp, dr.gather(mi.UInt32, self.group, index)


def register(mi: Any) -> None:
    """Register ``raytac_led`` (``radiance``, ``lobe``) for the variant active in ``mi``, once."""
    if getattr(mi, "raytac_led_variant", None) == mi.variant():
        return

    class LobeEmitter(mi.Emitter):
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.radiance = mi.Color3f(list(props["radiance"]))
            self.exponent = mi.Float(float(props["lobe"]) - 1.0)
            dr.make_opaque(self.radiance, self.exponent)
            self.m_flags = mi.EmitterFlags.Surface

        def traverse(self, cb: Any) -> None:
            cb.put("radiance", self.radiance, mi.ParamFlags.Differentiable)
            cb.put("exponent", self.exponent, mi.ParamFlags.Differentiable)

        def _lobe(self, cos_theta: Any) -> Any:
            # cos⁰ is 1 for every angle in front, so a Lambertian patch needs no branch.
            return self.radiance * lobe_gain(dr, cos_theta, self.exponent)

        def eval(self, si: Any, active: Any = True) -> Any:
            cos_theta = mi.Frame3f.cos_theta(si.wi)
            return self._lobe(cos_theta) & (active & (cos_theta > 0))

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            ds = self.get_shape().sample_direction(it, sample, active)
            cos_theta = -dr.dot(ds.d, ds.n)
            active = active & (cos_theta > 0) & (ds.pdf > 0)
            ds.emitter = mi.EmitterPtr(self)
            return ds, (self._lobe(cos_theta) / ds.pdf) & active

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            active = active & (dr.dot(ds.d, ds.n) < 0)
            return dr.select(active, self.get_shape().pdf_direction(it, ds, active), 0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            cos_theta = -dr.dot(ds.d, ds.n)
            return self._lobe(cos_theta) & (active & (cos_theta > 0))

        def bbox(self) -> Any:
            return self.get_shape().bbox()

        def to_string(self) -> str:
            return f"RaytacLed[radiance={self.radiance}, exponent={self.exponent}]"

    mi.register_emitter(PLUGIN, LobeEmitter)
    mi.raytac_led_variant = mi.variant()
