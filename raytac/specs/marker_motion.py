"""How the markers of a pad move under a load: what ``raytac calibrate markers`` fits, as a file of ``scenes/markers/``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from raytac.specs.files import find_file
from raytac.specs.toml import Number, Schema, Text, read_toml

__all__ = ["MARKER_MOTION_SCHEMA", "MarkerMotionSpec", "load_marker_motion", "marker_motion_text"]


@dataclass(frozen=True)
class MarkerMotionSpec:
    """Constants of the fitted marker models of one gelpad; they do not depend on the pattern of dots."""

    dilate_gain: float
    """Gain of FOTS' dilation, taken as an integral over the contact [1/m³]."""
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
    contact_radius: float
    """Radius of the contact that λ_s and λ_t hold for [m]; they scale with 1 / radius² for others. 0: they hold for all, as published."""
    field_gain: float
    """Scale of the normalised force field: marker displacement by penetration along a wall's normal [-]."""
    field_shear: float
    """Tangential over normal stiffness k_t / k_n of the force field [-]."""
    field_friction: float
    """Friction coefficient of the force field [-]: tangential force is at most this share of the normal one."""
    provenance: str
    """Data, date and errors of the fit, as text."""
    source: Path | None = None
    """File that it was read from."""


MARKER_MOTION_SCHEMA: Final[dict[str, Schema]] = {
    "": {"provenance": Text()},
    "fots": {
        "dilate_gain_per_mm3": Number("[0, 1000]"),
        "dilate_lambda_per_mm2": Number("(0, 100]"),
        "shear_lambda_per_mm2": Number("(0, 100]"),
        "shear_max_mm": Number("(0, 10]"),
        "twist_lambda_per_mm2": Number("(0, 100]"),
        "twist_max_deg": Number("(0, 180]"),
        "contact_radius_mm": Number("[0, 50]", default=0.0),
    },
    "force_field": {
        "gain": Number("[0, 100]"),
        "shear": Number("[0, 100]"),
        "friction": Number("[0, 10]"),
    },
}
"""Table (``""``: the top of the file) to its keys."""


def load_marker_motion(name_or_path: str | Path, *, base: Path | None = None) -> MarkerMotionSpec:
    """Read and check a file of ``scenes/markers/``: a shipped name such as ``"gelsight_mini"`` or a path, relative to ``base`` if given.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range.
    """
    path = find_file("marker motion", name_or_path, base=base)
    top = read_toml(path)
    head = top.read(MARKER_MOTION_SCHEMA[""], sections=("fots", "force_field"))
    fots = top.section("fots").read(MARKER_MOTION_SCHEMA["fots"])
    field = top.section("force_field").read(MARKER_MOTION_SCHEMA["force_field"])
    return MarkerMotionSpec(**fots, **{f"field_{key}": value for key, value in field.items()}, **head, source=path)


def marker_motion_text(motion: MarkerMotionSpec) -> str:
    """The file of ``motion``; ``load_marker_motion`` reads it back, to six digits."""
    degrees = 180.0 / 3.141592653589793
    rows = {
        "fots": {
            "dilate_gain_per_mm3": (motion.dilate_gain * 1e-9, "integral form of the published sum; see docs/markers.md"),
            "dilate_lambda_per_mm2": (motion.dilate_lambda * 1e-6, "lambda_d"),
            "shear_lambda_per_mm2": (motion.shear_lambda * 1e-6, "lambda_s"),
            "shear_max_mm": (motion.shear_max * 1e3, "cap of the shear that markers follow"),
            "twist_lambda_per_mm2": (motion.twist_lambda * 1e-6, "lambda_t"),
            "twist_max_deg": (motion.twist_max * degrees, "cap of the twist that markers follow"),
            "contact_radius_mm": (motion.contact_radius * 1e3, "radius that lambda_s and lambda_t hold for; 0: as published"),
        },
        "force_field": {
            "gain": (motion.field_gain, "displacement by penetration along a wall's normal"),
            "shear": (motion.field_shear, "k_t / k_n"),
            "friction": (motion.field_friction, "Coulomb's cap"),
        },
    }
    lines = ["# Marker motion of a gelpad, written by `raytac calibrate markers`. Lengths in mm.", ""]
    lines += ['provenance = """', *motion.provenance.strip().splitlines(), '"""']
    for table, values in rows.items():
        lines += ["", f"[{table}]"]
        lines += [f"{key} = {value:.6g}".ljust(40) + f"# {note}" for key, (value, note) in values.items()]
    return "\n".join(lines) + "\n"
