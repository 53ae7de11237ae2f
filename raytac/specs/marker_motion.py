"""Motion of a pad's markers under load (``scenes/markers/``), which a calibration fits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from raytac.specs.files import find_file
from raytac.specs.toml import Number, Schema, Text, check_fields, read_toml, split_unit


@dataclass(frozen=True)
class PunchSpec:
    """Motion of the skin around a contact that sticks: a rigid punch (docs/concepts/markers.md)."""

    anisotropy: float
    """κ: excess of following along the shear over across it [-]; ν / (2 − ν) on a half-space."""
    reach: float
    """ℓ: length over which what a half-space would do fades in a pad of finite thickness [m]."""
    slip: float
    """c: contact sticks up to a shear of c times mean indentation times radius [1/m]."""
    dilate_gain: float
    """Gain of the dilation, of which a contact that sticks takes its share away [1/m³]."""
    dilate_lambda: float
    """λ_d of that dilation [1/m²]."""


@dataclass(frozen=True)
class MarkerMotionSpec:
    """Constants of the fitted marker models of one gelpad, whatever its pattern of dots."""

    dilate_gain: float
    """Gain of FOTS' dilation as published, taken as an integral over the contact [1/m³]."""
    dilate_lambda: float
    """λ_d of FOTS: how fast the dilation falls off around every contact point [1/m²]."""
    shear_lambda: float
    """λ_s of FOTS: how fast the shear falls off around the contact centre [1/m²]."""
    shear_max: float
    """Δs_max of FOTS: the most that markers follow a shear [m]."""
    twist_lambda: float
    """λ_t of FOTS: how fast the rotation falls off around the contact centre [1/m²]."""
    twist_max: float
    """Δθ_max of FOTS: the most that markers follow a twist [rad]."""
    field_gain: float
    """Scale of the force field: displacement by penetration along a wall's normal [-]."""
    field_shear: float
    """Tangential over normal stiffness k_t / k_n of the force field [-]."""
    field_friction: float
    """Friction coefficient of the force field [-]."""
    provenance: str
    """Data, date and errors of the fit, as text."""
    punch: PunchSpec | None = None
    """In place of FOTS' Gaussians, caps and dilation; None: those, as published."""
    source: Path | None = None
    """File that it was read from."""

    def check(self) -> None:
        """Raise ``SpecError`` for a constant that no file could give."""
        check_fields(vars(self), MARKER_MOTION_SCHEMA["fots"], "fots", self.source)
        field = {name.removeprefix("field_"): value for name, value in vars(self).items() if name.startswith("field_")}
        check_fields(field, MARKER_MOTION_SCHEMA["force_field"], "force_field", self.source)
        if self.punch is not None:
            check_fields(vars(self.punch), MARKER_MOTION_SCHEMA["punch"], "punch", self.source)


MARKER_MOTION_SCHEMA: Final[dict[str, Schema]] = {
    "": {"provenance": Text()},
    "fots": {
        "dilate_gain_per_mm3": Number("[0, 1000]"),
        "dilate_lambda_per_mm2": Number("(0, 100]"),
        "shear_lambda_per_mm2": Number("(0, 100]"),
        "shear_max_mm": Number("(0, 10]"),
        "twist_lambda_per_mm2": Number("(0, 100]"),
        "twist_max_deg": Number("(0, 180]"),
    },
    "punch": {
        "anisotropy": Number("[0, 1]"),
        "reach_mm": Number("(0, 1000]"),
        "slip_per_mm": Number("[0, 1000]"),
        "dilate_gain_per_mm3": Number("[0, 1000]"),
        "dilate_lambda_per_mm2": Number("(0, 100]"),
    },
    "force_field": {
        "gain": Number("[0, 100]"),
        "shear": Number("[0, 100]"),
        "friction": Number("[0, 10]"),
    },
}
"""Table (``""``: the top of the file) to its keys."""


def load_marker_motion(name_or_path: str | Path, *, base: Path | None = None) -> MarkerMotionSpec:
    """Read and check a file of ``scenes/markers/``.

    A shipped name such as ``"gelsight_mini"``, or a path, relative to ``base`` if given.

    Raises ``SpecError``: unknown name, unreadable file, unknown or missing key, wrong type, value out of range.
    """
    path = find_file("marker motion", name_or_path, base=base)
    top = read_toml(path)
    head = top.read(MARKER_MOTION_SCHEMA[""], sections=("fots", "punch", "force_field"))
    fots = top.section("fots").read(MARKER_MOTION_SCHEMA["fots"])
    field = top.section("force_field").read(MARKER_MOTION_SCHEMA["force_field"])
    punch = PunchSpec(**top.section("punch").read(MARKER_MOTION_SCHEMA["punch"])) if "punch" in top.data else None
    forces = {f"field_{key}": value for key, value in field.items()}
    return MarkerMotionSpec(**fots, **forces, **head, punch=punch, source=path)


def marker_motion_text(motion: MarkerMotionSpec) -> str:
    """The file of ``motion``; ``load_marker_motion`` reads it back, to six digits."""
    lines = ["# Marker motion of a gelpad, written by `raytac calibrate markers`. Lengths in mm.", ""]
    lines += ['provenance = """', *motion.provenance.strip().splitlines(), '"""']
    for table, owner, prefix in (("fots", motion, ""), ("punch", motion.punch, ""), ("force_field", motion, "field_")):
        if owner is None:
            continue
        lines += ["", f"[{table}]"]
        for key in MARKER_MOTION_SCHEMA[table]:
            name, unit = split_unit(key)
            value = getattr(owner, prefix + name) * unit.denominator / unit.numerator
            lines.append(f"{key} = {value:.6g}".ljust(40) + f"# {_NOTES[key]}")
    return "\n".join(lines) + "\n"


_NOTES = {
    "dilate_gain_per_mm3": "integral form of the published sum; see docs/concepts/markers.md",
    "dilate_lambda_per_mm2": "lambda_d",
    "shear_lambda_per_mm2": "lambda_s",
    "shear_max_mm": "cap of the shear that markers follow",
    "twist_lambda_per_mm2": "lambda_t",
    "twist_max_deg": "cap of the twist that markers follow",
    "anisotropy": "kappa: nu / (2 - nu) on a half-space",
    "reach_mm": "length over which the half-space's motion fades in the pad",
    "slip_per_mm": "shear that sticks, by mean indentation times radius",
    "gain": "displacement by penetration along a wall's normal",
    "shear": "k_t / k_n",
    "friction": "Coulomb's cap",
}
