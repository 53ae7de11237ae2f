"""Rules that need more than one value of a sensor."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from raytac.errors import SpecError
from raytac.specs.height_map import HeightMap
from raytac.specs.lens import Lens
from raytac.specs.sensor import CameraSpec, LedSpec, SensorSpec, Vec3, shading_degree
from raytac.specs.toml import in_mm
from raytac.specs.tone import LEAST_SLOPE, MOST_COEFFICIENTS

_COEFFICIENT = 5.0
"""Most that a coefficient of a colour shading may be, as in the file."""
_LOG_GAIN = 20.0
"""Most that the logarithm of a colour shading's gain may be."""
_STEEPEST = 1.2
"""Largest slope to the pad's z of a ray in the view of a tilted camera: 50 degrees."""
_LENS_ERROR = 1e-3
"""Most [px] that a pixel may be off after its distortion is taken off and put on again."""
_HIGHEST = 0.1
"""Most that a pad's surface may rise above its middle, in the thickness of the pad."""
_SLACK = 1e-9
"""Tolerance of geometric comparisons [m]: a part may touch the case or the gel."""


def validate_sensor(sensor: SensorSpec) -> None:
    """Check a sensor as a whole.

    Files and every specification of a ``TactileSensor`` or a world go through it.

    Raises:
        SpecError: the dome is deeper than the pad, or a map of its surface does not cover the pad, rises above the case, or falls below
            the bonded face; the camera lies in the gel, beyond the case's walls, or sees past the pad; its
            distortion has no inverse, or its tilt is too large; the vignette leaves no light; the tone curve falls; colour shading has a
            wrong number of coefficients or might overflow; markers lie off the pad; an LED lies in the gel, above the dome, or outside the
            case, a virtual one above the dome, in the camera's view or where light refracts; with ``refraction.model = "slab"``, camera or
            LED do not lie below the slab's face to the air. The message names the file that the sensor or its lights came from, the key,
            and the value in the unit of the file.
    """
    _check_dome(sensor)
    check_slab(sensor)
    _check_camera(sensor)
    _check_vignetting(sensor)
    _check_tone(sensor)
    _check_shading(sensor)
    _check_markers(sensor)
    for index, led in enumerate(sensor.lights.leds):
        _check_led(sensor, index, led)


def check_slab(sensor: SensorSpec) -> None:
    """Check that camera and LEDs lie below a slab that refracts. Raises as ``validate_sensor``."""
    if sensor.refraction.model != "slab":
        return
    _check_camera_behind(sensor)
    back = _back_face(sensor)
    for index, led in enumerate(sensor.lights.leds):  # beside the pad too: the slab fills the case's cross-section
        highest = max(corner[2] for corner in led_corners(led))
        if highest >= -back:
            rule = (
                f"LED {led.name!r} reaches up to z = {highest * 1e3:.4g} mm: with refraction.model = 'slab' "
                f"all of it must lie below the slab's air face, z < {-back * 1e3:.4g} mm (thickness plus plate)"
            )
            raise SpecError(rule, file=sensor.lights.source, key=f"led[{index}].position_mm", value=in_mm(led.position))


def _check_dome(sensor: SensorSpec) -> None:
    pad = sensor.gelpad
    half = (pad.size[0] / 2, pad.size[1] / 2)
    if pad.surface is not None:
        _check_surface(sensor, pad.surface)
        return
    if any(radius <= extent for radius, extent in zip(pad.dome_radius, half, strict=True)):
        rule = f"must be more than half the pad, {in_mm(half)} mm; inf is flat"
        raise _error(sensor, "gelpad.dome_radius_mm", in_mm(pad.dome_radius), rule)
    depth = pad.sag(*half)
    if depth >= pad.thickness:
        rule = f"the dome falls {depth * 1e3:.4g} mm at the corner: must be less than the thickness {pad.thickness * 1e3:.4g} mm"
        raise _error(sensor, "gelpad.dome_radius_mm", in_mm(pad.dome_radius), rule)


def _check_surface(sensor: SensorSpec, surface: HeightMap) -> None:
    """A map covers the pad and stays between the bonded face and the case's rim."""
    pad = sensor.gelpad
    if any(math.isfinite(radius) for radius in pad.dome_radius):
        raise _error(sensor, "gelpad.dome_radius_mm", in_mm(pad.dome_radius), "must be left out where surface gives the shape")
    if any(half < side / 2 - _SLACK for half, side in zip(surface.half, pad.size, strict=True)):
        extent = in_mm(tuple(2.0 * half for half in surface.half))
        rule = f"the map covers {extent} mm: must cover the pad of {in_mm(pad.size)} mm"
        raise _error(sensor, "gelpad.surface_pitch_mm", in_mm(surface.spacing), rule)
    x, y, z = _at_rest(pad.size, surface)
    middle = float(surface.height(0.0, 0.0))
    if abs(middle) > _SLACK:
        rule = f"must be 0 in the middle of the pad, not {middle * 1e3:.4g} mm: HeightMap.centred makes it so"
        raise _error(sensor, "gelpad.surface", surface, rule)
    for value, bad, rule in (
        (z.min(), z.min() <= -pad.thickness, f"must stay above the bonded face, z > {-pad.thickness * 1e3:.4g} mm"),
        (z.max(), z.max() > _HIGHEST * pad.thickness, f"the case ends there: z <= {_HIGHEST * pad.thickness * 1e3:.4g} mm"),
    ):
        if bad:
            row, column = np.argwhere(z == value)[0]
            place = f"at x = {x[column] * 1e3:.4g}, y = {y[row] * 1e3:.4g} mm the surface is at z = {value * 1e3:.4g} mm"
            raise _error(sensor, "gelpad.surface", surface, f"{place}, with 0 in the middle: {rule}")


def _at_rest(size: tuple[float, float], surface: HeightMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and heights (Ny, Nx) of a map over a pad, at most as far apart as its nodes."""
    x, y = (
        np.linspace(-side / 2, side / 2, math.ceil(side / step) + 1) for side, step in zip(size, surface.spacing, strict=True)
    )
    return x, y, surface.height(x[None, :], y[:, None])


def _check_camera_behind(sensor: SensorSpec) -> None:
    camera, back = sensor.camera, _back_face(sensor)
    if camera.position[2] >= -back:
        rule = f"the camera must lie behind the gel, z < {-back * 1e3:.4g} mm, and look along +z"
        raise _error(sensor, "camera.position_mm", in_mm(camera.position), rule)


def _check_camera(sensor: SensorSpec) -> None:
    pad, case, camera = sensor.gelpad, sensor.case, sensor.camera
    x, y, _ = camera.position
    _check_camera_behind(sensor)
    if any(abs(c) > size / 2 + _SLACK for c, size in zip((x, y), case.size, strict=True)):  # behind its floor it may lie
        rule = f"the camera must lie between the case's walls, |x| <= {case.size[0] * 500:.4g} mm, |y| <= {case.size[1] * 500:.4g} mm"
        raise _error(sensor, "camera.position_mm", in_mm(camera.position), rule)
    _check_lens(sensor)
    edges = view_edges(sensor)
    if camera.lens.is_plain:
        view = tuple(n * pitch for n, pitch in zip(camera.resolution, camera.pixel_pitch, strict=True))
        centre = tuple(
            at + (n / 2 - principal) * pitch
            for at, n, principal, pitch in zip((x, y), camera.resolution, camera.principal_point, camera.pixel_pitch, strict=True)
        )
    else:
        _check_view(sensor, edges)
        view, centre = tuple(high - low for low, high in edges), tuple(0.5 * (low + high) for low, high in edges)
    if any(abs(c) > size / 2 for c, size in zip(centre, pad.size, strict=True)):
        rule = f"the camera does not see the pad: its view is centred at {in_mm(centre)} mm, off the pad of {in_mm(pad.size)} mm"
        raise _error(sensor, "camera.position_mm", in_mm(camera.position), rule)
    for outer, name in ((pad.size, "pad"), (case.size, "case")):
        if any(v > size + _SLACK for v, size in zip(view, outer, strict=True)):
            rule = f"the view of {in_mm(view)} mm (resolution times pitch) must not be larger than the {name}, {in_mm(outer)} mm"
            raise _error(sensor, "camera.pixel_pitch_mm", in_mm(camera.pixel_pitch), rule)
    if camera.lens.is_plain:
        _check_view(sensor, edges)


def _check_lens(sensor: SensorSpec) -> None:
    """Check that distortion has an inverse over the image, and that tilt is not too large."""
    camera, lens = sensor.camera, sensor.camera.lens
    tilt = [math.degrees(angle) for angle in camera.tilt]
    if not lens.is_plain and sensor.refraction.model == "slab":
        key, value = ("tilt_deg", tilt) if lens.tilts else ("distortion", list(camera.distortion))
        rule = "must be 0 with refraction.model = 'slab': what a pixel is on the gel is not defined for both"
        raise _error(sensor, f"camera.{key}", value, rule)
    if lens.tilts and lens.axis[2] < 0.5:
        rule = f"turns the camera by {math.degrees(math.acos(lens.axis[2])):.4g} degrees from +z: must be at most 60"
        raise _error(sensor, "camera.tilt_deg", tilt, rule)
    if lens.distorts:
        (width, height), (cx, cy), (fx, fy) = camera.resolution, camera.principal_point, camera.focal
        x, y = np.meshgrid((np.linspace(0, width, 33) - cx) / fx, (np.linspace(0, height, 33) - cy) / fy)
        flat = Lens(camera.distortion)
        with np.errstate(all="ignore"):
            ideal = flat.slope(x, y)
            back, area = flat.image(*ideal), flat.determinant(*ideal)
            off = np.hypot(fx * (back[0] - x), fy * (back[1] - y))
        if not (off.max() <= _LENS_ERROR and area.min() > 0):
            rule = "must have an inverse over the whole image: these coefficients fold it"
            raise _error(sensor, "camera.distortion", list(camera.distortion), rule)
    if lens.tilts and (steepest := float(np.hypot(*camera.border()).max())) > _STEEPEST:
        rule = f"the steepest ray has a slope of {steepest:.3g} to the pad's z: must be at most {_STEEPEST:g}"
        raise _error(sensor, "camera.tilt_deg", tilt, rule)


def _check_view(sensor: SensorSpec, view: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """The outermost pixels see the pad: x = position_x + (u − cx) · pitch at z = 0, y alike.

    ``view``: ``view_edges``. A map may rise above z = 0, where the view is wider.
    """
    pad, camera = sensor.gelpad, sensor.camera
    top = 0.0 if pad.surface is None else max(0.0, float(_at_rest(pad.size, pad.surface)[2].max()))
    wider = 1.0 - top / camera.position[2]
    for axis, (name, edges) in enumerate(zip("xy", view, strict=True)):
        low, high = (camera.position[axis] + wider * (edge - camera.position[axis]) for edge in edges)
        at, principal = camera.position[axis], camera.principal_point[axis]
        pixels, pitch = camera.resolution[axis], camera.pixel_pitch[axis]
        half = pad.size[axis] / 2
        if low < -half - _SLACK or high > half + _SLACK:
            rule = (
                f"the view runs off the pad: at z = {top * 1e3:.3g} it covers {name} = {low * 1e3:.4g} to {high * 1e3:.4g} mm, "
                f"must stay within {-half * 1e3:.4g} to {half * 1e3:.4g} mm"
            )
            if camera.lens.tilts:
                raise _error(sensor, "camera.tilt_deg", [math.degrees(angle) for angle in camera.tilt], rule)
            if camera.lens.distorts:
                raise _error(sensor, "camera.distortion", list(camera.distortion), rule)
            if abs((pixels / 2 - principal) * pitch) > abs(at):
                raise _error(sensor, "camera.principal_point_px", list(camera.principal_point), rule)
            raise _error(sensor, "camera.position_mm", in_mm(camera.position), rule)


def _check_vignetting(sensor: SensorSpec) -> None:
    camera, (a1, a2, a3) = sensor.camera, sensor.response.vignetting
    (width, height), (px, py) = camera.resolution, camera.principal_point
    farthest = max(math.hypot(u - px, v - py) for u in (0, width) for v in (0, height)) / (math.hypot(width, height) / 2)
    # A cubic in s = r² is least at an end or where its slope a1 + 2 a2 s + 3 a3 s² is 0. It may rise again: some lenses do.
    lowest = [s for s in _real_roots(3 * a3, 2 * a2, a1) if 0 < s < farthest**2]
    if min(1 + s * (a1 + s * (a2 + s * a3)) for s in (farthest**2, *lowest)) <= 0:
        rule = "1 + a1 r² + a2 r⁴ + a3 r⁶ must stay above 0 over the whole image"
        raise _error(sensor, "response.vignetting", list(sensor.response.vignetting), rule)


def _check_tone(sensor: SensorSpec) -> None:
    if len(sensor.response.tone) > MOST_COEFFICIENTS:
        raise _error(sensor, "response.tone", list(sensor.response.tone), f"must have at most {MOST_COEFFICIENTS} coefficients")
    if (least := sensor.response.curve.least_slope) < LEAST_SLOPE:
        rule = f"the tone curve's least slope between black and white is {least:.3g}: must be at least {LEAST_SLOPE:g}"
        raise _error(sensor, "response.tone", list(sensor.response.tone), rule)


def _check_shading(sensor: SensorSpec) -> None:
    for channel, coefficients in zip(("red", "green", "blue"), sensor.response.shading, strict=True):
        degree = shading_degree(len(coefficients))
        if (degree + 1) * (degree + 2) // 2 != len(coefficients):
            rule = f"must have (n + 1)(n + 2)/2 coefficients for a degree n (1, 3, 6, 10, 15, …), not {len(coefficients)}"
            raise _error(sensor, f"response.shading_{channel}", list(coefficients), rule)
        if max(map(abs, coefficients), default=0.0) > _COEFFICIENT:
            rule = f"must be numbers in [-{_COEFFICIENT:g}, {_COEFFICIENT:g}]"
            raise _error(sensor, f"response.shading_{channel}", list(coefficients), rule)
        if sum(map(abs, coefficients)) > _LOG_GAIN:
            rule = f"absolute values must not sum to more than {_LOG_GAIN:g}: the gain is the exponential of the polynomial"
            raise _error(sensor, f"response.shading_{channel}", list(coefficients), rule)


def _real_roots(a: float, b: float, c: float) -> tuple[float, ...]:
    """Real roots of a s² + b s + c; none where it is constant."""
    if a == 0:
        return () if b == 0 else (-c / b,)
    square = b * b - 4 * a * c
    if square < 0:
        return ()
    # The stable form: no difference of two nearly equal numbers, also for a tiny a.
    q = -0.5 * (b + math.copysign(math.sqrt(square), b))
    return (q / a,) if q == 0 else (q / a, c / q)


def _check_markers(sensor: SensorSpec) -> None:
    markers, size = sensor.markers, sensor.gelpad.size
    if (markers.rows == 0) != (markers.columns == 0):
        rule = f"rows and columns must both be 0 or both be positive; columns = {markers.columns}"
        raise _error(sensor, "markers.rows", markers.rows, rule)
    if markers.rows == 0:
        return
    if markers.radius <= 0:
        raise _error(sensor, "markers.radius_mm", markers.radius * 1e3, "must be > 0 where there are markers")
    counts = (markers.columns, markers.rows)
    if any(n > 1 and pitch < 2 * markers.radius for n, pitch in zip(counts, markers.pitch, strict=True)):
        rule = f"dots must not overlap: each pitch at least {2e3 * markers.radius:.4g} mm"
        raise _error(sensor, "markers.pitch_mm", in_mm(markers.pitch), rule)
    reach = [abs(o) + (n - 1) / 2 * p + markers.radius for o, n, p in zip(markers.offset, counts, markers.pitch, strict=True)]
    if any(r > s / 2 + _SLACK for r, s in zip(reach, size, strict=True)):
        rule = f"the grid reaches {in_mm(reach)} mm from the centre: must stay on the pad of {in_mm(size)} mm"
        raise _error(sensor, "markers.pitch_mm", in_mm(markers.pitch), rule)


def _check_led(sensor: SensorSpec, index: int, led: LedSpec) -> None:
    pad, back = sensor.gelpad, _back_face(sensor)
    half_x, half_y = pad.size[0] / 2, pad.size[1] / 2
    if led.virtual:
        _check_virtual(sensor, index, led)
    for x, y, z in (led.position, *led_corners(led)):
        rest = -float(pad.sag(min(max(x, -half_x), half_x), min(max(y, -half_y), half_y)))
        if not led.virtual and abs(x) <= half_x and abs(y) <= half_y and z > -back + _SLACK:
            rule = f" lies inside the gel: under the pad all of it must have z <= {-back * 1e3:.4g} mm"
        elif z > rest + _SLACK:
            rule = (
                f" lies above the gel: {'all' if led.virtual else 'beside the pad all'} of it must have z <= {rest * 1e3:.4g} mm"
            )
        elif not _in_case(sensor, (x, y, z)):
            rule = f", {in_mm(led.size)} mm large, must lie inside the case, {_case_rule(sensor)}"
        else:
            continue
        key = f"led[{index}].position_mm"
        raise SpecError(f"LED {led.name!r}{rule}", file=sensor.lights.source, key=key, value=in_mm(led.position))


def view_edges(sensor: SensorSpec) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest x, then y, of the camera's view of z = 0 [m]; below it is narrower."""
    return camera_edges(sensor.camera)


@lru_cache(1024)  # a check asks several times, a fit for the same views again and again
def camera_edges(camera: CameraSpec) -> tuple[tuple[float, float], tuple[float, float]]:
    """``view_edges`` of a camera."""
    if not camera.lens.is_plain:
        slopes, depth = camera.border(), -camera.position[2]
        x, y = (
            (at + depth * float(s.min()), at + depth * float(s.max())) for at, s in zip(camera.position, slopes, strict=False)
        )
        return x, y
    x, y = (
        (at - principal * pitch, at + (count - principal) * pitch)
        for at, principal, pitch, count in zip(
            camera.position[:2], camera.principal_point, camera.pixel_pitch, camera.resolution, strict=True
        )
    )
    return x, y


def _check_virtual(sensor: SensorSpec, index: int, led: LedSpec) -> None:
    key = f"led[{index}].virtual"
    if sensor.refraction.model != "none":
        rule = f"LED {led.name!r} is virtual: refraction.model must be 'none', since its light is in the gel already"
        raise SpecError(rule, file=sensor.lights.source, key=key, value=True)
    corners = led_corners(led)
    beside = any(
        max(corner[axis] for corner in corners) <= low + _SLACK or min(corner[axis] for corner in corners) >= high - _SLACK
        for axis, (low, high) in enumerate(view_edges(sensor))
    )
    if not beside:
        edges = ", ".join(
            f"{name} = {low * 1e3:.4g} to {high * 1e3:.4g}" for name, (low, high) in zip("xy", view_edges(sensor), strict=True)
        )
        rule = f"LED {led.name!r} is virtual: all of it must lie beside the camera's view, {edges} mm"
        raise SpecError(rule, file=sensor.lights.source, key=f"led[{index}].position_mm", value=in_mm(led.position))


def led_corners(led: LedSpec) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Corners of the emitting rectangle, pad frame [m], by the convention of ``LedSpec.size``."""
    a, b = led.size[0] / 2, led.size[1] / 2

    def corner(s: float, t: float) -> Vec3:
        x, y, z = (p + s * u + t * v for p, u, v in zip(led.position, *led.edges, strict=True))
        return x, y, z

    return corner(-a, -b), corner(a, -b), corner(a, b), corner(-a, b)


def _back_face(sensor: SensorSpec) -> float:
    """Distance of the face towards the camera from z = 0 [m]: gel, or a refracting plate."""
    slab = sensor.refraction.plate_thickness if sensor.refraction.model == "slab" else 0.0
    return sensor.gelpad.thickness + slab


def _in_case(sensor: SensorSpec, point: Vec3) -> bool:
    (sx, sy), (x, y, z) = sensor.case.size, point
    return abs(x) <= sx / 2 + _SLACK and abs(y) <= sy / 2 + _SLACK and z >= sensor.case.floor_z - _SLACK


def _case_rule(sensor: SensorSpec) -> str:
    (sx, sy), floor = sensor.case.size, sensor.case.floor_z
    return f"|x| <= {sx * 500:.4g} mm, |y| <= {sy * 500:.4g} mm, z >= {floor * 1e3:.4g} mm"


def _error(sensor: SensorSpec, key: str, value: object, rule: str) -> SpecError:
    return SpecError(rule, file=sensor.source, key=key, value=value)
