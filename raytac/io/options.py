"""The options that every experiment and every command that computes shares."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from raytac.errors import InputError

DeviceName = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Base of ``@dataclass(frozen=True, kw_only=True) class Args(CommonOptions)``."""

    out: Path | None = None
    """Folder to write to, created if need be; one under runs/ for the job if not given."""
    device: DeviceName = "auto"
    """Device to compute on; auto is CUDA if it works, else the CPU."""
    seed: int = 0
    """Seed of every random number; the same seed gives the same result. In [0, 2^32)."""

    def folder(self, *parts: str) -> Path:
        """``out``, else the folder of these ``parts`` under runs/."""
        return self.out if self.out is not None else Path("runs", *parts)


def parse_resolution(text: str) -> tuple[int, int]:
    """``"320x240"`` to (width, height) [px]. Raises ``InputError`` for anything else."""
    sides = re.fullmatch(r"\s*0*([1-9]\d{0,8})\s*x\s*0*([1-9]\d{0,8})\s*", text, re.ASCII | re.IGNORECASE)
    if sides is None:
        raise InputError("resolution", value=text, rule="must be WIDTHxHEIGHT in pixels, as in 320x240")
    return int(sides[1]), int(sides[2])


def parse_names(text: str, option: str, choices: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Names joined by commas, each once; ``InputError`` for none, or if not in ``choices``."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names:
        if choices is not None and name not in choices:
            raise InputError(option, value=name, rule="must be known names joined by commas", choices=choices)
    if not names:
        raise InputError(option, value=text, rule="must name at least one", choices=choices or ())
    return names


def parse_seeds(text: str) -> list[int]:
    """Whole numbers joined by commas. Raises ``InputError`` for others."""
    names = parse_names(text, "seeds")
    for name in names:
        if not name.isdecimal():
            raise InputError("seeds", value=name, rule="must be whole numbers >= 0 joined by commas")
    return [int(name) for name in names]


def parse_outputs(text: str, choices: tuple[str, ...]) -> tuple[str, ...]:
    """Names joined by commas, in the order of ``choices``. Raises as ``parse_names``."""
    names = parse_names(text, "outputs", choices)
    return tuple(name for name in choices if name in names)
