"""Writes a camera's response as the TOML table that ``load_sensor`` reads."""

from __future__ import annotations

import math

from raytac.specs.sensor import ResponseSpec

__all__ = ["response_text"]


def response_text(response: ResponseSpec) -> str:
    """The table ``[response]`` to six digits, colour shading to four decimals with one line for each order in x."""

    def row(values: tuple[float, ...]) -> str:
        return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"

    lines = [
        "[response]",
        f"exposure = {response.exposure:.6g}",
        f"white_balance = {row(response.white_balance)}",
        f"gamma = {response.gamma:.6g}",
        f"black_level = {row(response.black_level)}",
        f"vignetting = {row(response.vignetting)}",
    ]
    for channel, found in zip(("red", "green", "blue"), response.shading, strict=True):
        if not found:
            continue
        lines.append(f"shading_{channel} = [")
        rest = [f"{value:.4f}" for value in found]
        while rest:
            # (n + 1)(n + 2)/2 are left for the degree n: n + 1 of one order in x, then those of the degree n − 1.
            count = (math.isqrt(8 * len(rest) + 1) - 1) // 2
            lines.append("    " + ", ".join(rest[:count]) + ",")
            rest = rest[count:]
        lines.append("]")
    return "\n".join(lines) + "\n"
