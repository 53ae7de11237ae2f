"""Writes lights as the TOML that ``load_lights`` reads."""

from __future__ import annotations

from raytac.specs.sensor import LightsSpec

__all__ = ["lights_text"]


def lights_text(lights: LightsSpec, comment: str) -> str:
    """A light file: ``comment``, its lines marked with #, then one table an LED. Millimetres to 10 µm, powers to four digits."""

    def row(values: tuple[float, ...], scale: float, digits: str) -> str:
        return ", ".join(f"{scale * value:{digits}}" for value in values)

    tables = [
        f'[[led]]\nname = "{led.name}"\nlayer = "{led.layer}"\nposition_mm = [{row(led.position, 1e3, ".2f")}]\n'
        f"axis = [{row(led.axis, 1, '.4f')}]\nsize_mm = [{row(led.size, 1e3, '.2f')}]\nlobe = {led.lobe:.2f}\n"
        f"power_w_per_sr = [{row(led.power, 1, '.3e')}]\n" + (f"glow_per_m2 = {led.glow:.4g}\n" if led.glow else "")
        for led in lights.leds
    ]
    return "\n".join([*(f"# {line}" for line in comment.splitlines()), "", "\n".join(tables)])
