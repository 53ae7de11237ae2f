"""The LED as a Mitsuba emitter: a rectangle whose radiance falls with a power of the cosine to its axis.

A die behind a lens does not emit like a Lambertian patch. The usual lobe is an intensity I(θ) = I₀ cosⁿ θ about the axis; spread over
a rectangle of area A this is the radiance L(θ) = (I₀ / A) cosⁿ⁻¹ θ, because a patch shrinks with cos θ. n = 1 is Mitsuba's ``area``.
"""

from __future__ import annotations

from typing import Any

__all__ = ["PLUGIN", "register"]

PLUGIN = "raytac_led"


def register(mi: Any) -> None:
    """Register the plugin ``raytac_led`` for the variant that is active in ``mi``, once; parameters ``radiance`` (RGB) and ``lobe``."""
    if getattr(mi, "raytac_led_variant", None) == mi.variant():
        return
    import drjit as dr

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
            return self.radiance * dr.power(dr.maximum(cos_theta, 1e-6), self.exponent)

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
