"""Writes a camera's response as the TOML table that ``load_sensor`` reads."""

from __future__ import annotations

from itertools import islice

from raytac.specs.sensor import ResponseSpec, shading_degree

__all__ = ["response_text"]


def response_text(response: ResponseSpec) -> str:
    """The table ``[response]`` to six digits, colour shading to four decimals with one line for each order in x."""

    def row(values: tuple[float, ...]) -> str:
        return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"

    lines = [
        "[response]",
        f"exposure = {response.gain:.6g}",
        f"white_balance = {row(response.white_balance)}",
        f"gamma = {response.gamma:.6g}",
        f"black_level = {row(response.black_level)}",
        f"vignetting = {row(response.vignetting)}",
    ]
    for channel, found in zip(("red", "green", "blue"), response.shading, strict=True):
        if not found:
            continue
        lines.append(f"shading_{channel} = [")
        rest = iter(found)
        for order in range(shading_degree(len(found)), -1, -1):
            lines.append("    " + ", ".join(f"{value:.4f}" for value in islice(rest, order + 1)) + ",")
        lines.append("]")
    return "\n".join(lines) + "\n"
