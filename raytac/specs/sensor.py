"""Sensors: gelpad, coat, case, camera, response, markers and lights, in SI units.

Frames. Everything is given in the **pad frame**: origin at the centre of the undeformed outer gel surface, +z out of the
sensor towards the object, +x image right, +y image down. The camera and the LEDs therefore lie at z < 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from raytac.errors import SpecError
from raytac.specs.height_map import HeightMap
from raytac.specs.lens import Lens
from raytac.specs.marker_motion import MarkerMotionSpec
from raytac.specs.toml import ANY, Flag, Integer, Number, Schema, Text, check_fields
from raytac.specs.tone import ToneCurve

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]

UNMIXED: Final = (0.0,) * 6
AUTO: Final = "auto"
"""In place of an exposure: that which makes the image at rest mid-grey."""
BONDED = ("back", "back_and_sides")
"""Faces of a gelpad that the case can hold."""


_NAME = Text(pattern=r"[a-z][a-z0-9_]*", described="a name of lower-case letters, digits and underscores")

SENSOR_SCHEMA: Final[dict[str, Schema]] = {
    "": {"lights": Text(), "base": Text(default=""), "marker_motion": Text(default="")},
    "gelpad": {
        "size_mm": Number("[2, 200]", length=2),
        "thickness_mm": Number("[0.2, 50]"),
        "dome_radius_mm": Number("[1, inf]", length=2),
        "youngs_modulus_kpa": Number("[1, 100000]"),
        "poisson_ratio": Number("[0, 0.5)"),
        "density_kg_m3": Number("[100, 10000]"),
        "friction": Number("[0, 10]"),
        "bonded": Text(choices=BONDED, default="back"),
        "hysteresis": Number("[0, 1]", default=0.1),
        "relaxation_time_s": Number("[0, 1]", default=0.002),
    },
    "coat": {
        "reflectance": Number("[0, 1]", length=3),
        "specular": Number("[0, 1)"),
        "roughness": Number("[0.05, 1]"),
    },
    "case": {
        "size_mm": Number("[2, 300]", length=2),
        "floor_z_mm": Number("[-500, 0)"),
        "reflectance": Number("[0, 1)"),
        "wall_mm": Number("[0.1, 50]", default=0.8e-3),
        "density_kg_m3": Number("[10, 30000]", default=1000.0),
    },
    "camera": {
        "resolution_px": Integer("[8, 8192]", length=2),
        "pixel_pitch_mm": Number("[0.0005, 5]", length=2),
        "position_mm": Number("[-500, 500]", length=3),
        "principal_point_px": Number("[-8192, 16384]", length=2),
        "distortion": Number("[-2, 2]", length=4, default=(0.0, 0.0, 0.0, 0.0)),
        "tilt_deg": Number("[-60, 60]", length=3, default=(0.0, 0.0, 0.0)),
        "monochrome": Flag(default=False),
    },
    "response": {
        "exposure": Number("(0, 1e9]", word=AUTO),
        "white_balance": Number("(0, 100]", length=3),
        "gamma": Number("[0.5, 5]"),
        "black_level": Number("[-0.5, 0.5]", length=3, default=(0.0, 0.0, 0.0)),
        "vignetting": Number("[-10, 10]", length=3, default=(0.0, 0.0, 0.0)),
        "colour_mix": Number("[-1, 1]", length=6, default=UNMIXED),
        "tone": Number("[-1, 1]", length=ANY, default=()),
        "shading_red": Number("[-5, 5]", length=ANY, default=()),
        "shading_green": Number("[-5, 5]", length=ANY, default=()),
        "shading_blue": Number("[-5, 5]", length=ANY, default=()),
    },
    "markers": {
        "rows": Integer("[0, 200]"),
        "columns": Integer("[0, 200]"),
        "pitch_mm": Number("[0, 50]", length=2, default=(0.0, 0.0)),
        "offset_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
        "radius_mm": Number("[0, 10]", default=0.0),
        "reflectance": Number("[0, 1]", default=0.0),
    },
    "refraction": {
        "model": Text(choices=("none", "slab")),
        "ior": Number("[1, 3]"),
        "plate_thickness_mm": Number("[0, 50]"),
    },
    "optics": {"shadows": Flag(default=True)},
    "noise": {
        "dark_variance": Number("[0, 10000]", length=3, default=(0.0, 0.0, 0.0)),
        "bright_variance": Number("[0, 10000]", length=3, default=(0.0, 0.0, 0.0)),
    },
}
"""Table (``""``: the top of the file) to its keys."""

SURFACE_SCHEMA: Final[Schema] = {
    "surface": Text(),
    "surface_unit_mm": Number("(0, 1000]", default=1e-3),
    "surface_pitch_mm": Number("(0, 5]", length=2, default=()),
}
"""Further keys of ``[gelpad]``: a file of the surface, in place of a dome."""

LED_SCHEMA: Final[Schema] = {
    "name": _NAME,
    "layer": _NAME,
    "position_mm": Number("[-500, 500]", length=3),
    "axis": Number("[-1000, 1000]", length=3),
    "size_mm": Number("(0, 50]", length=2),
    "lobe": Number("[1, 1000]"),
    "power_w_per_sr": Number("[0, 1e6]", length=3),
    "glow_per_m2": Number("[0, 1e6]", default=0.0),
    "virtual": Flag(default=False),
}
"""Keys of one ``[[led]]`` table."""


@dataclass(frozen=True)
class GelpadSpec:
    """The elastomer block under the coat."""

    size: Vec2
    """Extent along x (image right) and y (image down) [m]."""
    thickness: float
    """Distance from the bonded face to the outer surface at the pad centre [m]."""
    dome_radius: Vec2
    """Radii of curvature along x and y of the outer surface at rest [m]; ``inf`` is flat."""
    youngs_modulus: float
    """Young's modulus E [Pa]."""
    poisson_ratio: float
    """Poisson's ratio ν, 0 <= ν < 0.5."""
    density: float
    """Mass density ρ [kg/m³]."""
    friction: float
    """Coulomb friction coefficient μ against the object."""
    bonded: str = "back"
    """Faces that are bonded to the case, one of ``BONDED``; used by the soft pad alone."""
    hysteresis: float = 0.1
    """α, share of energy that the gel loses in a cycle of rolling; for rigid pads in worlds.
    0.1 is a guess: silicone elastomers lose some per cent to some tens of per cent."""
    relaxation_time: float = 0.002
    """τ [s] of damping along a contact's normal, E (ε + τ dε/dt); for rigid pads in worlds.
    Kelvin and Voigt's model. Not measured: with 2 ms the loss tangent is 0.13 at 10 Hz."""
    surface: HeightMap | None = None
    """Outer surface at rest in place of a dome, z = 0 in its middle; ``dome_radius`` is inf."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["gelpad"], "gelpad")
        if not isinstance(self.surface, (HeightMap, type(None))):
            raise SpecError("must be a HeightMap or None", key="gelpad.surface", value=self.surface)

    def sag(self, x: Any, y: Any) -> Any:
        """Depth [m] of the surface at rest below the pad centre at ``x``, ``y`` [m] on the pad.

        That of ``surface``, or s(x; Rx) + s(y; Ry) with the sagitta s(u; R) = R − √(R² − u²) = u² / (R + √(R² − u²)): a circular arc
        of radius Rx carried along one of radius Ry.
        """
        if self.surface is not None:
            return -self.surface.height(x, y)
        if self.is_plane:
            return 0.0 * (x + y)
        sags = [
            u * u / (radius + (radius * radius - u * u) ** 0.5) if math.isfinite(radius) else 0.0 * u
            for u, radius in zip((x, y), self.dome_radius, strict=True)
        ]
        return sags[0] + sags[1]

    @property
    def is_plane(self) -> bool:
        """True if the surface at rest is z = 0."""
        return self.surface is None and self.dome_radius == (math.inf, math.inf)

    def slope(self, x: Any, y: Any) -> tuple[Any, Any]:
        """∂z/∂x and ∂z/∂y of the surface at rest at ``x``, ``y`` [m] on the pad."""
        if self.surface is not None:
            return self.surface.slope(x, y)
        rx, ry = self.dome_radius
        return tuple(  # type: ignore[return-value]
            -u / (radius * radius - u * u) ** 0.5 if math.isfinite(radius) else 0.0 * u for u, radius in ((x, rx), (y, ry))
        )


@dataclass(frozen=True)
class CoatSpec:
    """Pigmented skin that the camera sees: a diffuse base and a rough (GGX) specular lobe."""

    reflectance: Vec3
    """Diffuse albedo per camera channel (linear R, G, B), each in [0, 1]."""
    specular: float
    """Share of the rough specular lobe in the blend, in [0, 1); 0 is Lambertian."""
    roughness: float
    """GGX roughness α of the specular lobe, in [0.05, 1]."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["coat"], "coat")


@dataclass(frozen=True)
class CaseSpec:
    """The housing: four walls around the light and a floor behind the camera."""

    size: Vec2
    """Inner extent along x and y [m]."""
    floor_z: float
    """Pad-frame z of the floor (the camera board) [m], below the camera."""
    reflectance: float
    """Diffuse albedo of walls and floor, in [0, 1)."""
    wall: float = 0.8e-3
    """Thickness of walls and back [m]. 0.8 mm is a guess, from the Mini's outside of 32 × 28 mm."""
    density: float = 1000.0
    """Mean density of case and camera [kg/m³], a guess; the Mini without gel weighs 22 g."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["case"], "case")


@dataclass(frozen=True)
class CameraSpec:
    """A camera looking along +z unless tilted, given by the pixel pitch on the gel plane z = 0."""

    resolution: tuple[int, int]
    """Native (width, height) [px] of the image that the specification describes."""
    pixel_pitch: Vec2
    """Size of one native pixel on the plane z = 0 along x and y [m].
    It holds where the optical axis meets the plane; of a tilted camera, across that axis."""
    position: Vec3
    """Pinhole (centre of projection), pad frame [m]; z < 0. The image centre looks along +z.
    It may lie behind the case's floor: behind gel and plate a camera seems farther away."""
    principal_point: Vec2
    """Pixel, in native pixels from the top-left image corner, that the optical axis meets [px]."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of Brown and Conrady's model, as OpenCV has them (``Lens``)."""
    tilt: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector [rad], pad frame, that turns the camera from looking along +z."""
    monochrome: bool = False
    """True for a camera without colours: all channels show the mean of their linear signals."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["camera"], "camera")
        for name, value in vars(self).items():
            if isinstance(value, list):  # so that cameras can be compared, and results kept by camera
                object.__setattr__(self, name, tuple(value))

    @property
    def lens(self) -> Lens:
        """Distortion and tilt."""
        return Lens(self.distortion, self.tilt)

    @property
    def centre(self) -> Vec2:
        """x, y [m] where the optical axis meets the plane z = 0."""
        x, y, z = self.position
        if not self.lens.tilts:
            return x, y
        a, b, c = self.lens.axis
        return x - z * a / c, y - z * b / c

    @property
    def focal(self) -> Vec2:
        """Focal lengths along x and y [px]: distance to z = 0 on the axis over the pitch."""
        distance = -self.position[2] / self.lens.axis[2]
        return distance / self.pixel_pitch[0], distance / self.pixel_pitch[1]

    def border(self, count: int = 33) -> tuple[Any, Any]:
        """Slopes (dx/dz, dy/dz) of ``count`` rays along each side of the image, (4·count,) each."""
        (width, height), (cx, cy), (fx, fy) = self.resolution, self.principal_point, self.focal
        along = np.linspace(0, 1, count)
        u = width * np.concatenate([along, along, 0 * along, 0 * along + 1])
        v = height * np.concatenate([0 * along, 0 * along + 1, along, along])
        return self.lens.slope((u - cx) / fx, (v - cy) / fy)

    def pitch_at(self, resolution: tuple[int, int]) -> Vec2:
        """Size along x and y [m] of a pixel on z = 0 at a ``resolution`` (width, height) [px]."""
        (px, py), (nx, ny), (width, height) = self.pixel_pitch, self.resolution, resolution
        return px * nx / width, py * ny / height


@dataclass(frozen=True)
class ResponseSpec:
    """u8 = 255 S(clip(wb · exposure · vignette · shading · M L + black)^(1/γ)) of radiance L."""

    exposure: float | Literal["auto"]
    """Gain from radiance [W/(m² sr), relative] to full scale 1; ``AUTO``: rest is mid-grey.
    Whoever renders finds that one (``raytac.optics.response``)."""
    white_balance: Vec3
    """Gain of each channel after the exposure."""
    gamma: float
    """Encoding exponent γ (1 is linear)."""
    black_level: Vec3
    """Offset per channel in linear full scale."""
    vignetting: Vec3
    """Coefficients (a1, a2, a3) of 1 + a1 r² + a2 r⁴ + a3 r⁶; all 0 is none.
    r: distance from the principal point over half the image's diagonal. The pinhole's cos⁴ fall-off is not added."""
    colour_mix: tuple[float, ...] = UNMIXED
    """Numbers off the diagonal of M, the colour matrix, row by row; those on it are 1.
    Red of the image takes the first two of green's and blue's light. They are negative where a camera makes colours more saturated."""
    tone: tuple[float, ...] = ()
    """Coefficients t_k of S, the tone curve (``ToneCurve``); none is S(u) = u."""
    shading_red: tuple[float, ...] = ()
    """Colour shading, a smooth gain of red over the image: exp Σ c_ij T_i(x) T_j(y), i + j ≤ n.
    T: Chebyshev's polynomials; x, y: −1 to 1 over the image's width and height; in the order c_00, c_01 … c_0n, c_10 …:
    (n + 1)(n + 2)/2 of them for the degree n, or none for a gain of 1."""
    shading_green: tuple[float, ...] = ()
    shading_blue: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["response"], "response")

    @property
    def gain(self) -> float:
        """The exposure as a number; ``SpecError`` for ``AUTO``, which ``with_exposure`` replaces."""
        if self.exposure == AUTO:
            raise SpecError("must be a number here: with_exposure finds it", key="response.exposure", value=AUTO)
        return self.exposure

    @property
    def colour_matrix(self) -> tuple[Vec3, Vec3, Vec3]:
        """M, row by row."""
        rg, rb, gr, gb, br, bg = self.colour_mix
        return (1.0, rg, rb), (gr, 1.0, gb), (br, bg, 1.0)

    @property
    def curve(self) -> ToneCurve:
        """S."""
        return ToneCurve(self.tone)

    @property
    def shading(self) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
        """Coefficients by channel."""
        return self.shading_red, self.shading_green, self.shading_blue

    @property
    def unshaded(self) -> ResponseSpec:
        """The same without colour shading."""
        return replace(self, shading_red=(), shading_green=(), shading_blue=())


def shading_degree(count: int) -> int:
    """Degree n of a shading with (n + 1)(n + 2)/2 coefficients, at most ``count``; −1 for none."""
    return (math.isqrt(8 * count + 1) - 3) // 2


@dataclass(frozen=True)
class MarkerSpec:
    """A regular grid of dots printed on the coat; rows = columns = 0 means none."""

    rows: int
    """Number of dots along y."""
    columns: int
    """Number of dots along x."""
    pitch: Vec2
    """Spacing along x (columns) and y (rows) [m]."""
    offset: Vec2
    """Position of the grid's centre in the pad frame [m]."""
    radius: float
    """Dot radius [m]."""
    reflectance: float
    """Diffuse albedo of a dot, in [0, 1]."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["markers"], "markers")


@dataclass(frozen=True)
class RefractionSpec:
    """Planar layers between the coat and the air around camera and LEDs.

    ``model`` is ``"none"`` or ``"slab"``. ``"slab"``: the gel and its support plate, index-matched, with a flat air interface at z =
    −(thickness + plate).
    """

    model: str
    ior: float
    """Refractive index of gel and plate (one medium)."""
    plate_thickness: float
    """Thickness of the support plate behind the gelpad [m]."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["refraction"], "refraction")


@dataclass(frozen=True)
class OpticsSpec:
    """Choices of rendering that the geometry leaves open, as the lights were fitted."""

    shadows: bool = True
    """True casts shadows on the coat, in modes that can and are not given another value."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["optics"], "optics")


@dataclass(frozen=True)
class NoiseSpec:
    """Grain of the camera: white noise of 8-bit values, whose variance is linear in the level.

    σ²(u) = dark + (bright − dark) u / 255 for a pixel of the camera's own resolution at level u. Images have it on request alone.
    """

    dark_variance: Vec3 = (0.0, 0.0, 0.0)
    """σ² by channel at level 0 [levels²]."""
    bright_variance: Vec3 = (0.0, 0.0, 0.0)
    """σ² by channel at level 255 [levels²]."""

    def __post_init__(self) -> None:
        check_fields(vars(self), SENSOR_SCHEMA["noise"], "noise")

    @property
    def is_none(self) -> bool:
        """True if no pixel has noise."""
        return not any((*self.dark_variance, *self.bright_variance))


@dataclass(frozen=True)
class LedSpec:
    """One LED: a rectangle that emits from its front side with radiance ∝ cos^(n−1) θ."""

    name: str
    layer: str
    """Name of the layer (colour group, e.g. ``"red"``) that it is rendered into."""
    position: Vec3
    """Centre of the emitting rectangle, pad frame [m]."""
    axis: Vec3
    """Unit emission axis (front normal of the rectangle), pad frame."""
    size: Vec2
    """Edge lengths of the rectangle [m]; the first lies along z × axis (or x if parallel)."""
    lobe: float
    """Lobe exponent n >= 1; 1 is a Lambertian emitter."""
    power: Vec3
    """On-axis intensity by channel (linear RGB) [W/sr, relative], as of a point light."""
    glow: float = 0.0
    """Even radiance of walls and floor over ``power`` [1/m²]: light scattered many times."""
    virtual: bool = False
    """True declares a source that stands for light which entered gel and plate at their sides.

    It may lie beside the camera's view up to the coat at rest, where no LED fits."""

    def __post_init__(self) -> None:
        check_fields(vars(self), LED_SCHEMA, "led")
        length = math.hypot(*self.axis)
        if abs(length - 1.0) > 1e-6:
            raise SpecError(f"must be a unit vector; its length is {length:.6g}", key="led.axis", value=self.axis)

    @property
    def edges(self) -> tuple[Vec3, Vec3]:
        """Unit vectors u along z × axis and v = axis × u of the edges, pad frame; right-handed."""
        ax, ay, az = self.axis
        flat = math.hypot(ax, ay)
        ux, uy = (-ay / flat, ax / flat) if flat > 1e-9 else (1.0, 0.0)
        return (ux, uy, 0.0), (-az * uy, az * ux, ax * uy - ay * ux)


@dataclass(frozen=True)
class LightsSpec:
    leds: tuple[LedSpec, ...]
    source: Path | None = None
    """File that it was read from."""

    def __post_init__(self) -> None:
        if not isinstance(self.leds, tuple) or not all(isinstance(led, LedSpec) for led in self.leds):
            raise SpecError("must be a tuple of LedSpec", file=self.source, key="led", value=self.leds)

    @property
    def layers(self) -> tuple[str, ...]:
        """Layer names in order of first appearance."""
        return tuple(dict.fromkeys(led.layer for led in self.leds))


SENSOR_PARTS: Final = {
    "gelpad": GelpadSpec,
    "coat": CoatSpec,
    "case": CaseSpec,
    "camera": CameraSpec,
    "response": ResponseSpec,
    "markers": MarkerSpec,
    "refraction": RefractionSpec,
    "optics": OpticsSpec,
    "noise": NoiseSpec,
}
"""Table of a sensor file to the dataclass that holds it."""


@dataclass(frozen=True)
class SensorSpec:
    """A sensor: parts check their own ranges, ``validate_sensor`` checks them together.

    The latter is done for a file and for every sensor that is used, not here, so that a fit may move lights through each other.
    """

    name: str
    gelpad: GelpadSpec
    coat: CoatSpec
    case: CaseSpec
    camera: CameraSpec
    response: ResponseSpec
    markers: MarkerSpec
    refraction: RefractionSpec
    lights: LightsSpec
    optics: OpticsSpec = OpticsSpec()
    noise: NoiseSpec = NoiseSpec()
    marker_motion: MarkerMotionSpec | None = None
    """Motion of the pad's markers under a load, for fitted models; None if not fitted."""
    source: Path | None = None
    """File that it was read from."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise SpecError("must be a text", file=self.source, key="name", value=self.name)
        for name, kind in SENSOR_PARTS.items():
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise SpecError(f"must be a {kind.__name__}", file=self.source, key=name, value=value)
        if not isinstance(self.lights, LightsSpec):
            raise SpecError("must be a LightsSpec", file=self.source, key="lights", value=self.lights)
        if not isinstance(self.marker_motion, (MarkerMotionSpec, type(None))):
            raise SpecError("must be a MarkerMotionSpec or None", file=self.source, key="marker_motion", value=self.marker_motion)
        if self.marker_motion is not None:  # while one is fitted, it may leave its ranges
            self.marker_motion.check()
