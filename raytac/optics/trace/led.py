"""One LED on the device: where its rectangle lies, how it emits, and points on it. Every integrator of ours lights by these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.specs.sensor import LedSpec

__all__ = ["Lamp", "LampTable"]


@dataclass(frozen=True)
class Lamp:
    """Dr.Jit arrays of one LED: centre [m], unit axis, half edges [m], lobe exponent n, on-axis intensity (linear RGB) [W/sr], and the
    even radiance of the case that goes with it (linear RGB) [W/(m² sr)], None if there is none.

    Intensity is I(θ) = power · cosⁿ θ for the whole rectangle, so a small one is a point light of that intensity.
    """

    centre: Any
    axis: Any
    half_u: Any
    half_v: Any
    lobe: Any
    power: Any
    glow: Any = None

    @classmethod
    def from_spec(cls, mi: Any, led: LedSpec, unit: float = 1.0) -> Lamp:
        """The LED in a world of ``unit`` length units per metre; its power grows with unit², so that I / r² stays."""
        u, v = np.array(led.edges)
        lamp = cls(
            centre=mi.Point3f([unit * c for c in led.position]),
            axis=mi.Vector3f(*led.axis),
            half_u=mi.Vector3f((0.5 * unit * led.size[0] * u).tolist()),
            half_v=mi.Vector3f((0.5 * unit * led.size[1] * v).tolist()),
            lobe=mi.Float(led.lobe),
            power=mi.Color3f([unit**2 * p for p in led.power]),
            glow=mi.Color3f([led.glow * p for p in led.power]) if led.glow else None,
        )
        # Opaque values keep one kernel for every LED file and let a fit change them without recompiling.
        dr.make_opaque(lamp.centre, lamp.axis, lamp.half_u, lamp.half_v, lamp.lobe, lamp.power, lamp.glow)
        return lamp

    def sample(self, square: Any) -> Any:
        """Point on the rectangle for ``square`` in [0, 1)²."""
        return self.centre + (2 * square.x - 1) * self.half_u + (2 * square.y - 1) * self.half_v

    def lobe_gain(self, direction: Any) -> Any:
        """cosⁿ θ for light leaving along the unit ``direction``; 0 behind."""
        cos_theta = dr.dot(direction, self.axis)
        return dr.select(cos_theta > 0, dr.power(dr.maximum(cos_theta, 1e-6), self.lobe), 0)

    def extent(self, direction: Any) -> Any:
        """Half the rectangle's length [m] along the unit ``direction``."""
        return dr.abs(dr.dot(direction, self.half_u)) + dr.abs(dr.dot(direction, self.half_v))


@dataclass(frozen=True)
class LampTable:
    """All LEDs of a sensor in one array a quantity, so that a path can pick one by index."""

    lamps: Lamp
    """Each field has one entry an LED."""
    group: Any
    """Layer index of each LED."""

    @classmethod
    def of(cls, mi: Any, lamps: list[Lamp], groups: list[int]) -> LampTable:
        def column(kind: Any, name: str) -> Any:
            return kind(np.concatenate([np.array(getattr(lamp, name)).reshape(-1, 1) for lamp in lamps], axis=1))

        table = Lamp(
            centre=column(mi.Point3f, "centre"),
            axis=column(mi.Vector3f, "axis"),
            half_u=column(mi.Vector3f, "half_u"),
            half_v=column(mi.Vector3f, "half_v"),
            lobe=mi.Float(np.array([np.array(lamp.lobe).item() for lamp in lamps], dtype=np.float32)),
            power=column(mi.Color3f, "power"),
        )
        return cls(table, mi.UInt32(np.asarray(groups, dtype=np.uint32)))

    def pick(self, mi: Any, u: Any) -> tuple[Lamp, Any]:
        """One LED chosen uniformly by ``u`` in [0, 1), and its group."""
        t, count = self.lamps, dr.width(self.group)
        index = dr.minimum(mi.UInt32(u * count), count - 1)
        lamp = Lamp(
            centre=dr.gather(mi.Point3f, t.centre, index),
            axis=dr.gather(mi.Vector3f, t.axis, index),
            half_u=dr.gather(mi.Vector3f, t.half_u, index),
            half_v=dr.gather(mi.Vector3f, t.half_v, index),
            lobe=dr.gather(mi.Float, t.lobe, index),
            power=dr.gather(mi.Color3f, t.power, index),
        )
        return lamp, dr.gather(mi.UInt32, self.group, index)
