"""FOTS: markers pushed apart by indentation, dragged by shear and turned by twist.

Zhao, Qian, Duan and Luo, FOTS, RA-L 2024 (arXiv 2404.19217), in the form of the thesis behind TacEx, eq. 4.1 to 4.3. With a marker at M,
contact points C_i of depth Δh_i and contacts c that the object has dragged by Δs_c and turned by Δθ_c:

    dilate   Δd_d = g Σ_i a Δh_i (M' − C_i) exp(−λ_d ‖M' − C_i‖²)    M' = M + Δd_s + Δd_t
    shear    Δd_s = Σ_c w_c min(Δs_c, Δs_max)                        e_c = exp(−λ_s ‖M − G_c‖²)
    twist    Δd_t = Σ_c w_c (R(min(Δθ_c, Δθ_max)) − 1)(M − G_c)      e_c = exp(−λ_t ‖M − G_c‖²)

Both sides of a difference are taken on the same skin. G_c is where the skin under the contact's centre was at rest: that centre less the
drag. The dilation, whose contact points are where they are now, takes the marker as it was dragged. w_c = e_c / max(1, Σ e_c) is the
published factor for one contact, and no more than one motion in all where contacts are close. a is the area of a sample, and g [1/m³] the
gain that the published sum over pixels hides in its unit of length.

With ``MarkerMotionSpec.punch`` shear and twist are those around a disc that sticks to a half-space (Johnson, Contact Mechanics, 1985,
§3.6 and 3.9; Reissner and Sagoci 1944), which fade with the pad's finite thickness. With x = M − G_c, x̂ its direction, A the disc's
radius, r ≥ A its distance from G_c (``beyond_ellipse`` has both for an ellipse), t = A / r and g(t) = t √(1 − t²):

    shear    Δd_s = (2/π) [(F asin t − κ g) Δs + 2 κ g x̂ (x̂ · Δs)]      e_c = (2/π) F asin t      F = exp(−(r − A) / ℓ)
    twist    Δd_t = (2/π) (asin t − g) (R(Δθ) − 1) x                   e_c = (2/π) (asin t − g)

On a half-space of Poisson's ratio ν: κ = ν / (2 − ν) and ℓ = ∞. A base near by ends the motion that is alike in all directions, F, but
not the rest, by which the skin ahead of the contact goes with it and that beside it comes back. t = 1 under the contact, where both are
the object's own motion. A contact of mean indentation h̄ sticks up to Δs_max = c h̄ A, or up to Δθ_max = ``TWIST_SLIP`` c h̄. This is
Coulomb's law: the force 8 G A Δs / (2 − ν) reaches μ P, with P = K h̄ π A² of a layer of foundation modulus K, so c = π μ K (2 − ν) / (8
G). Force F and couple M together stay on or within an ellipsoid, (F / F_max)² + (M / M_max)² = 1 (Howe and Cutkosky, Practical
force-motion models for sliding manipulation, IJRR 15(6), 1996). Beyond it the contact slips along the ellipsoid's normal. F and M are
linear in Δs and Δθ, so after slip these are

    Δs / (1 + γ), Δθ / (1 + b γ)      the least γ ≥ 0 that puts both within the ellipsoid      b = 1 / ``TWIST_SLIP``²

(closest point, in elastic energy, as of ideal plasticity; b is the ratio of F_max Δs_max to M_max Δθ_max on incompressible rubber).

A contact that sticks cannot spread. With a punch the dilation, which has constants of its own, is

    dilate   max(0, 1 − Σ_c e_c) Δd_d                                    e_c = (2/π) (asin t − g)

Pushed-apart skin is stretched by nearly the same, ε, all over a contact: Δd_d = ε x there. The disc holds it, and so adds the field of a
disc that shrinks by ε. On a half-space radial tractions move the surface radially by the same integral as tangential ones move it around,
up to a factor: û_r = (1 − ν) τ̂_r / (G k) and û_θ = τ̂_θ / (G k) in Hankel's transform of order 1. So the field of a stretched disc is
Reissner and Sagoci's with x in place of ẑ × x: ε (2/π) (asin t − g) x. For ν → 1/2 these tractions move nothing along z, and pressure
alone stretches nothing on a half-space: all of the dilation is the layer's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.device import resolve_device
from raytac.gel.surface import GelSurface
from raytac.markers.contacts import COLUMNS, ContactCells, Contacts, ContactSamples
from raytac.markers.fots_kernels import Cells, Constants, Drag, limit
from raytac.markers.packet_kernels import PACKET, displace, packet
from raytac.specs.marker_motion import MarkerMotionSpec
from raytac.warp_runtime import LAUNCH, start_warp


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
    """Marker displacements from contact samples and contacts; recorded once a size."""

    def __init__(self, x: np.ndarray, y: np.ndarray, *, device: str = "auto") -> None:
        """For samples at ``x`` (nx,), ``y`` (ny,) [m], even; errors as of ``resolve_device``."""
        self.device = resolve_device(device, ray_tracing=False)
        start_warp()
        self._samples = len(y), len(x)
        cells: Any = Cells()
        cells.origin, cells.pitch = wp.vec2f(x[0], y[0]), wp.vec2f(x[1] - x[0], y[1] - y[0])
        self._cells = cells
        self._arrays: dict[tuple[int, int, int], FotsArrays] = {}

    def displacement(
        self, markers: np.ndarray, depth: np.ndarray, boxes: np.ndarray, contacts: np.ndarray, motion: MarkerMotionSpec
    ) -> np.ndarray:
        """Displacement [m] of markers at rest, shape (B, M, 2), float32.

        Args:
            markers: positions at rest [m], (B, M, 2) or (B, M, 3), of which x and y are read.
            depth: indentation of the samples [m], (B, ny, nx), 0 outside the contact.
            boxes, contacts: as ``ContactSamples.boxes`` and ``Contacts.table``, whose last two columns are not read.
        """
        (batch, count), rows = markers.shape[:2], contacts.shape[1]
        size = batch, count, 1 << (rows - 1).bit_length()
        if size not in self._arrays:
            self._arrays[size] = FotsArrays(size, self._samples, self._cells, self.device)
        arrays = self._arrays[size]
        arrays.fill(markers, depth, boxes, contacts)
        arrays.launch(motion)
        return arrays.moved.numpy().copy()


class FotsArrays:
    """Device arrays of B pads, M markers, K contacts; ``moved`` (B, M): displacements [m]."""

    def __init__(self, size: tuple[int, int, int], samples: tuple[int, int], cells: Any, device: str) -> None:
        """For ``size`` (B, M, K) and ``samples`` (ny, nx) on a pad."""
        (batch, count, most), (ny, nx) = size, samples
        self._markers = wp.zeros((batch, count), dtype=wp.vec2f, device=device)
        self._table = wp.zeros((batch, most, COLUMNS), dtype=wp.float64, device=device)
        self._boxes = wp.zeros(batch, dtype=wp.vec4i, device=device)
        self._depth = wp.zeros((batch, ny, -(-nx // PACKET)), dtype=packet, device=device)
        self.moved = wp.zeros((batch, count), dtype=wp.vec2f, device=device)
        drag: Any = Drag
        drags = wp.zeros((batch, most), dtype=drag, device=device)
        weights = wp.zeros((batch, count, ny), dtype=wp.vec2f, device=device)
        kernels = (
            (limit, drags.shape, [self._table, Constants(), drags]),
            (
                displace,
                self.moved.shape,
                [self._markers, drags, self._boxes, self._depth, cells, Constants(), weights, self.moved],
            ),
        )
        # Launches are recorded, so that repeating them costs a fifth.
        self._launches: list[Any] = [
            wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True) for kernel, dim, inputs in kernels
        ]
        # On the CPU these are views, on CUDA copies that are uploaded.
        self._host = tuple(array.numpy() for array in (self._markers, self._table, self._boxes, self._depth))
        self._motion: MarkerMotionSpec | None = None
        self._columns, self._on_cpu = nx, wp.get_device(device).is_cpu

    def fill(self, markers: np.ndarray, depth: np.ndarray, boxes: np.ndarray, contacts: np.ndarray) -> None:
        """Copy arrays of the host, as of ``FotsKernel.displacement``, to the device."""
        xy, table, edges, samples = self._host
        xy[:] = markers[..., :2]
        table[:, : contacts.shape[1], : contacts.shape[2]] = contacts
        table[:, contacts.shape[1] :] = 0.0
        edges[:] = boxes
        samples.reshape(*samples.shape[:2], -1)[..., : self._columns] = depth
        if not self._on_cpu:
            for array, values in zip((self._markers, self._table, self._boxes, self._depth), self._host, strict=True):
                array.assign(values)

    def launch(self, motion: MarkerMotionSpec) -> None:
        """Compute ``moved`` with the constants of ``motion``."""
        if self._motion is not motion:
            constants = constants_of(motion)
            for recorded in self._launches:
                recorded.set_param_by_name("motion", constants)
            self._motion = motion
        with LAUNCH:
            for recorded in self._launches:
                recorded.launch()


def constants_of(motion: MarkerMotionSpec) -> Any:
    """Constants of a marker motion, for kernels."""
    result: Any = Constants()
    for name in ("dilate_gain", "dilate_lambda", "shear_lambda", "shear_max", "twist_lambda", "twist_max"):
        setattr(result, name, getattr(motion, name))
    result.is_punch = int(motion.punch is not None)
    for name in ("dilate_gain", "dilate_lambda", "anisotropy", "reach", "slip") if motion.punch else ():
        setattr(result, name, getattr(motion.punch, name))
    return result
