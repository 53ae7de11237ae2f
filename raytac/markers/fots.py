"""FOTS: markers pushed apart by the indentation, dragged by shear and turned by twist; computed on the device for all at once.

Zhao, Qian, Duan and Luo, FOTS, RA-L 2024 (arXiv 2404.19217), in the form of the thesis behind TacEx, eq. 4.1 to 4.3. With a marker at M,
contact points C_i of depth Δh_i and contacts c that the object has dragged by Δs_c and turned by Δθ_c:

    dilate   Δd_d = g Σ_i a Δh_i (M' − C_i) exp(−λ_d ‖M' − C_i‖²)    M' = M + Δd_s + Δd_t
    shear    Δd_s = Σ_c w_c min(Δs_c, Δs_max)                        e_c = exp(−λ_s ‖M − G_c‖²)
    twist    Δd_t = Σ_c w_c (R(min(Δθ_c, Δθ_max)) − 1)(M − G_c)      e_c = exp(−λ_t ‖M − G_c‖²)

Both sides of a difference are taken on the same skin. G_c is where the skin under the contact's centre was at rest: that centre less the
drag. The dilation, whose contact points are where they are now, takes the marker as it was dragged. w_c = e_c / max(1, Σ e_c) is the
published factor for one contact, and no more than one motion in all where contacts are close. a is the area of a sample, and g [1/m³] the
gain that the published sum over pixels hides in its unit of length.

With ``MarkerMotionSpec.punch`` shear and twist are those around a disc that sticks to a half-space (Johnson, Contact Mechanics, 1985, §3.6
and 3.9; Reissner and Sagoci 1944), which fade with the pad's finite thickness. With x = M − G_c, x̂ its direction, A the disc's radius,
r ≥ A its distance from G_c (``_beyond_ellipse`` has both for an ellipse), t = A / r and g(t) = t √(1 − t²):

    shear    Δd_s = (2/π) [(F asin t − κ g) Δs + 2 κ g x̂ (x̂ · Δs)]      e_c = (2/π) F asin t      F = exp(−(r − A) / ℓ)
    twist    Δd_t = (2/π) (asin t − g) (R(Δθ) − 1) x                   e_c = (2/π) (asin t − g)

On a half-space of Poisson's ratio ν: κ = ν / (2 − ν) and ℓ = ∞. A base near by ends the motion that is alike in all directions, F, but not
the rest, by which the skin ahead of the contact goes with it and that beside it comes back. t = 1 under the contact, where both are the
object's own motion. A contact of mean indentation h̄ sticks up to Δs_max = c h̄ A, or up to Δθ_max = ``TWIST_SLIP`` c h̄. This is Coulomb's
law: the force 8 G A Δs / (2 − ν) reaches μ P, with P = K h̄ π A² of a layer of foundation modulus K, so c = π μ K (2 − ν) / (8 G). Force F
and couple M together stay on or within an ellipsoid, (F / F_max)² + (M / M_max)² = 1 (Howe and Cutkosky, Practical force-motion models for
sliding manipulation, IJRR 15(6), 1996). Beyond it the contact slips along the ellipsoid's normal. F and M are linear in Δs and Δθ, so
after slip these are

    Δs / (1 + γ), Δθ / (1 + b γ)      the least γ ≥ 0 that puts both within the ellipsoid      b = 1 / ``TWIST_SLIP``²

(closest point, in elastic energy, as of ideal plasticity; b is the ratio of F_max Δs_max to M_max Δθ_max on incompressible rubber).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import GelSurface
from raytac.markers.contacts import TWIST_SLIP, ContactCells, Contacts, ContactSamples, kept_shares
from raytac.markers.sources import SourceLine, anterpolated, coarsening
from raytac.optics.runtime import load_mitsuba, no_collection
from raytac.specs.marker_motion import MarkerMotionSpec

_NEGLIGIBLE = 16.0
"""Exponent of a Gaussian beyond which it is neglected: float32 cannot add e⁻¹⁶ to 1."""
_ROW = 12
"""Floats a contact, in three packet gathers: active, G, Δs, Δθ, T_xx, T_xy, T_yy, h̄ and two that are not read here."""
_PACKET = 4
"""Samples a gather."""
_LIMIT_STEPS = 3
"""Newton steps of ``_limited``: to float32's rounding at any shear and twist (a test compares with bisection)."""


class FotsModel:
    """Model of ``Fots`` and ``FotsPublished``: the kernel with one marker motion."""

    needs_contacts = True

    def __init__(self, motion: MarkerMotionSpec, cells: ContactCells, *, device: str = "auto") -> None:
        self.motion, self._kernel = motion, FotsKernel(cells.x, cells.y, device=device)
        self.device = self._kernel.device

    def displacement(
        self, rest: np.ndarray, surface: GelSurface, samples: ContactSamples | None, contacts: Contacts | None
    ) -> np.ndarray:
        """Displacement along x, y [m], shape (B, M, 2), of markers at ``rest`` (B, M, 3)."""
        assert samples is not None and contacts is not None
        if samples.box[0] == samples.box[1]:  # no pad is touched
            return np.zeros((*rest.shape[:2], 2), np.float32)
        return self._kernel.displacement(rest, samples.depth, samples.boxes, contacts.table, self.motion)


class FotsKernel:
    """Marker displacements from contact samples and contacts; recorded once for each number of environments, markers and contacts."""

    def __init__(self, x: np.ndarray, y: np.ndarray, *, device: str = "auto") -> None:
        """Prepare for samples at ``x`` (nx,), ``y`` (ny,) [m], evenly spaced; errors as of ``load_mitsuba``."""
        self.mi, self.device = load_mitsuba(device)
        self._lines = x, y
        self._area = float(x[1] - x[0]) * float(y[1] - y[0])
        self._sources: dict[tuple[int, int], tuple[SourceLine, SourceLine]] = {}
        self._frozen: dict[tuple[Any, ...], Any] = {}
        self._markers: tuple[np.ndarray, np.ndarray, Any] | None = None
        self._numbers: tuple[MarkerMotionSpec, Any] | None = None

    def displacement(
        self, markers: np.ndarray, depth: np.ndarray, boxes: np.ndarray, contacts: np.ndarray, motion: MarkerMotionSpec
    ) -> np.ndarray:
        """Displacement [m] of markers at rest, shape (B, M, 2), float32.

        Args:
            markers: positions at rest [m], (B, M, 2) or (B, M, 3), of which x and y are read.
            depth: indentation of the samples [m], (B, ny, nx), 0 outside the contact.
            boxes, contacts: as ``ContactSamples.boxes`` and ``Contacts.table``, whose last two columns are not read.
            motion: constants of the pad.
        """
        (batch, count), rows = markers.shape[:2], contacts.shape[1]
        k = 1 << (rows - 1).bit_length()
        x, y = sources = self._sources_for(motion.dilate_lambda)
        packets = -(-x.count // _PACKET)
        # Contacts, boxes and depths in one array need one upload, of whole packets. A grid's whole numbers are exact in float32.
        box, sample = batch * k * _ROW, batch * (k * _ROW + _PACKET)
        frame = np.zeros(sample + batch * y.count * packets * _PACKET, dtype=np.float32)
        frame[:box].reshape(batch, k, _ROW)[:, :rows] = contacts
        nodes = frame[sample:].reshape(batch, y.count, -1)[..., : x.count]
        frame[box:sample].reshape(batch, _PACKET)[:] = anterpolated(depth, boxes, x, y, nodes)
        inputs = self._on_device(markers), self.mi.Float(frame), self._constants(motion)
        is_punch = motion.punch is not None
        key = batch, count, k, is_punch, x.factor, y.factor
        if key not in self._frozen:
            # All inputs are arrays in memory, so nothing has to be made opaque.
            self._frozen[key] = dr.freeze(
                lambda *arrays: self._sums(batch, count, k, is_punch, sources, *arrays), auto_opaque=False
            )
        with no_collection():
            moved = self._frozen[key](*inputs)
        return moved.numpy().reshape(batch, count, 2).copy()

    def _sources_for(self, decay: float) -> tuple[SourceLine, SourceLine]:
        """Nodes along x and y that stand for the samples."""
        x, y = self._lines
        key = coarsening(x, decay), coarsening(y, decay)
        if key not in self._sources:
            self._sources[key] = SourceLine.of(x, decay), SourceLine.of(y, decay)
        return self._sources[key]

    def _on_device(self, markers: np.ndarray) -> Any:
        """x and y on the device. They hardly ever change, so the upload is kept; a read-only array needs no comparison."""
        last = self._markers
        if last is not None and markers is last[0] and not markers.flags.writeable:
            return last[2]
        if last is None or last[1].shape != markers.shape or not np.array_equal(last[1], markers):
            uploaded = self.mi.Float(np.ascontiguousarray(markers[..., :2], dtype=np.float32).ravel())
            self._markers = markers, np.array(markers), uploaded
        else:
            self._markers = markers, last[1], last[2]
        return self._markers[2]

    def _constants(self, motion: MarkerMotionSpec) -> Any:
        if self._numbers is None or self._numbers[0] != motion:
            m, p = motion, motion.punch
            drag = [p.anisotropy, p.reach, p.slip] if p else [m.shear_lambda, m.shear_max, m.twist_lambda, m.twist_max]
            values = [m.dilate_gain, m.dilate_lambda, *drag]
            self._numbers = motion, self.mi.Float(np.array(values, dtype=np.float32))
        return self._numbers[1]

    def _sums(
        self,
        batch: int,
        count: int,
        k: int,
        is_punch: bool,
        sources: tuple[SourceLine, SourceLine],
        xy: Any,
        frame: Any,
        constants: Any,
    ) -> Any:
        """Displacements (B·M·2); ``frame``: contacts (B, k, ``_ROW``), boxes (B, 4) and depths (B, ny, packets, 4) in turn."""
        mi = self.mi
        i = dr.arange(mi.UInt32, batch * count)
        env = i // count
        place = dr.gather(mi.Point2f, xy, i)
        gain, ld, *others = (dr.gather(mi.Float, constants, n) for n in range(dr.width(constants)))
        drag = _drag(mi, env, place, frame, k, others, _sticking if is_punch else _gaussian)
        box = dr.gather(mi.Vector4f, frame, batch * k * _ROW // _PACKET + env)
        packets = -(-sources[0].count // _PACKET)
        first = mi.Int32(env) * (sources[1].count * packets) + batch * (k * _ROW // _PACKET + 1)
        dilate = self._dilate(place + drag, frame, box, first, packets, sources, ld) * (gain * self._area)
        return dr.ravel(dilate + drag)

    def _dilate(
        self, place: Any, frame: Any, box: Any, first: Any, packets: int, sources: tuple[SourceLine, SourceLine], ld: Any
    ) -> Any:
        """Σ Δh (M − C) exp(−λ ‖M − C‖²) over the nodes of the contact's box that lie within reach of the marker.

        The nodes of ``sources`` are the samples, or stand for them; those beyond the box are 0, so whole packets are read.
        ``first``: first packet of ``frame`` with nodes of the marker's pad, ``packets`` a row.
        """
        mi, (x0, y0), (dx, dy) = self.mi, (line.first for line in sources), (line.pitch for line in sources)
        reach = dr.sqrt(_NEGLIGIBLE / ld)
        c0, c1, r0, r1 = (mi.Int32(edge) for edge in box)
        c0, c1 = (
            dr.maximum(c0, mi.Int32(dr.ceil((place.x - reach - x0) / dx))),
            dr.minimum(c1, mi.Int32((place.x + reach - x0) / dx) + 1),
        )
        r0, r1 = (
            dr.maximum(r0, mi.Int32(dr.ceil((place.y - reach - y0) / dy))),
            dr.minimum(r1, mi.Int32((place.y + reach - y0) / dy) + 1),
        )
        r1 = dr.select(c0 < c1, r1, r0)
        p0, p1, shrink = c0 // _PACKET, (c1 - 1) // _PACKET, dr.exp(-2 * ld * dx * dx)

        def inside(p: Any, r: Any, sx: Any, sy: Any) -> Any:
            return r < r1

        def add(p: Any, r: Any, sx: Any, sy: Any) -> tuple[Any, ...]:
            depths = dr.gather(mi.Vector4f, frame, first + r * packets + p)
            ex, ey = place.x - (x0 + mi.Float(p * _PACKET) * dx), place.y - (y0 + mi.Float(r) * dy)
            total, along = mi.Float(0), mi.Float(0)
            # From one sample to the next the Gaussian changes by a factor, and that by a constant one: two exponentials a packet.
            gaussian, factor = dr.exp(-ld * (ex * ex + ey * ey)), dr.exp(ld * dx * (2 * ex - dx))
            for h in depths:
                w = h * gaussian
                total, along, ex = total + w, along + w * ex, ex - dx
                gaussian, factor = gaussian * factor, factor * shrink
            wrap = p >= p1
            return dr.select(wrap, p0, p + 1), dr.select(wrap, r + 1, r), sx + along, sy + total * ey

        start = (mi.Int32(p0), mi.Int32(r0), mi.Float(0), mi.Float(0))
        _, _, sx, sy = dr.while_loop(start, inside, add, label="dilate")
        return mi.Vector2f(sx, sy)


def _drag(mi: Any, env: Any, place: Any, contacts: Any, k: int, constants: list[Any], one: Callable[..., Any]) -> Any:
    """Shear and twist of all contacts of a marker's pad; ``one`` gives those of one contact."""

    def more(n: Any, *sums: Any) -> Any:
        return n < k

    def add(n: Any, es: Any, shear: Any, et: Any, twist: Any) -> tuple[Any, ...]:
        row = [dr.gather(mi.Vector4f, contacts, _ROW // 4 * (env * k + n) + part) for part in range(_ROW // 4)]
        ws, sheared, wt, turned = one(mi, place, row, *constants)
        return n + 1, es + ws, shear + sheared, et + wt, twist + turned

    start = (mi.UInt32(0), mi.Float(0), mi.Vector2f(0), mi.Float(0), mi.Vector2f(0))
    _, es, shear, et, twist = dr.while_loop(start, more, add, label="drag")
    return shear / dr.maximum(1, es) + twist / dr.maximum(1, et)


def _gaussian(mi: Any, place: Any, row: list[Any], ls: Any, smax: Any, lt: Any, tmax: Any) -> tuple[Any, Any, Any, Any]:
    """(e, Δd) of the shear and of the twist of one contact, as published."""
    a, b, _ = row
    shear = _capped(mi.Vector2f(a.w, b.x), smax)
    x = place - (mi.Point2f(a.y, a.z) - shear)
    r2 = dr.squared_norm(x)
    ws, wt = a.x * dr.exp(-ls * r2), a.x * dr.exp(-lt * r2)
    return ws, ws * shear, wt, wt * _turned(mi, x, dr.clip(b.y, -tmax, tmax))


def _sticking(mi: Any, place: Any, row: list[Any], kappa: Any, reach: Any, slip: Any) -> tuple[Any, Any, Any, Any]:
    """(e, Δd) of the shear and of the twist of one contact, of a disc that sticks."""
    a, b, c = row
    radius = dr.sqrt(dr.sqrt(dr.maximum(b.z * c.x - b.w * b.w, 1e-24)))
    shear_max = slip * c.y * radius
    shear, twist = _limited(mi.Vector2f(a.w, b.x), b.y, shear_max, TWIST_SLIP * slip * c.y)
    x = place - (mi.Point2f(a.y, a.z) - shear)
    beyond = _beyond_ellipse(x, b.z, b.w, c.x)
    r2 = radius * radius + beyond
    root = dr.sqrt(beyond)
    asin, g = dr.atan2(radius, root), radius * root / r2
    weight = 2 / math.pi * a.x
    fade = dr.exp(-beyond / ((dr.sqrt(r2) + radius) * reach))
    along = dr.dot(x, shear) / dr.maximum(dr.squared_norm(x), 1e-18) * x
    sheared = weight * ((fade * asin - kappa * g) * shear + 2 * kappa * g * along)
    wt = weight * (asin - g)
    return weight * fade * asin, sheared, wt, wt * _turned(mi, x, twist)


def _limited(shear: Any, twist: Any, shear_max: Any, twist_max: Any) -> tuple[Any, Any]:
    """Shear and twist of the skin where the contact slips, from those of the object."""
    x, y = dr.norm(shear) / dr.maximum(shear_max, 1e-12), dr.abs(twist) / dr.maximum(twist_max, 1e-12)
    sheared, turned = kept_shares(x, y, _LIMIT_STEPS, dr.sqrt, dr.maximum)
    return sheared * shear, turned * twist


def _beyond_ellipse(x: Any, xx: Any, xy: Any, yy: Any) -> Any:
    """r² − A² of a point ``x`` from the centre of the ellipse xᵀ T⁻¹ x = 1 with A² = √det T; 0 inside.

    The λ > 0 of the confocal ellipse xᵀ (T + λ)⁻¹ x = 1 through the point; these are the equipotentials of an elliptic disc, and
    λ = ‖x‖² − A² for a disc. λ² − b λ + c = 0 with b = ‖x‖² − tr T, c = det T − xᵀ adj(T) x.
    """
    b = dr.squared_norm(x) - xx - yy
    c = xx * yy - xy * xy - (yy * x.x * x.x - 2 * xy * x.x * x.y + xx * x.y * x.y)
    root = dr.sqrt(dr.maximum(b * b - 4 * c, 0))
    # The same root twice, without cancellation on either side of b = 0.
    beyond = dr.select(b > 0, 0.5 * (b + root), -2 * c / dr.maximum(root - b, 1e-18))
    return dr.select(c < 0, beyond, 0)


def _capped(vector: Any, longest: Any) -> Any:
    return vector * dr.minimum(1, longest / dr.maximum(dr.norm(vector), 1e-12))


def _turned(mi: Any, x: Any, angle: Any) -> Any:
    """(R − 1) ``x``."""
    s, half = dr.sin(angle), dr.sin(0.5 * angle)
    cos_less_1 = -2 * half * half  # without cancellation
    return mi.Vector2f(cos_less_1 * x.x - s * x.y, s * x.x + cos_less_1 * x.y)
