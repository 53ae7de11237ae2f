"""The gel around a contact: an elastic layer's Gaussians, or Taxim's pyramid."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import warp as wp

from raytac.checks import check_known, check_number
from raytac.gel import surround_kernels as kernels
from raytac.gel.components import boxes
from raytac.gel.gaussian import CONTACT_SCALE, FINAL_SIGMA, LAYER_STEPS, PYRAMID_SIGMAS, gaussian_matrix
from raytac.gel.surface import GelSurface, PadGrid
from raytac.warp_runtime import HostArrays, Recorded, start_warp

CONTACT_RULES = ("unilateral", "threshold")
_UNILATERAL = -1.0
"""In place of a threshold's share, for the kernels."""
_FINEST = 0.2
"""Share of the pitch below which Gaussians are skipped: the grid cannot resolve them."""
_ROUNDING = 1e-5
"""Excess of w over u in contact over the deepest overlap: above the rounding in float32."""
_FACE = 1e-8
"""Rounding of a height in float32, and some [m]."""
_REACH = 5.3
"""Standard deviations at which a Gaussian is 10⁻⁶ of its peak."""
_CPU_LANES, _CUDA_LANES = 16, 4
"""Nodes in a packet: a processor's vector register, or what a CUDA thread reads at once."""
_STACK = 1 << 17
"""Nodes of all environments that a CPU processes at once: they stay in a core's cache."""


class ElasticSurround:
    """Deformed surfaces from the overlap of objects and resting gel.

    With u = rest − underside of the object (its overlap with the gel at rest) and u⁺ = max(u, 0): start from w = u⁺; for every step of a
    pyramid, w ← gain · Gaussian(w), then the contact is re-imposed; last, one narrow Gaussian everywhere. The surface is rest − w. The
    ``contact_rule`` says what the steps are and how the contact is re-imposed:

    - ``"unilateral"`` (default): ``LAYER_STEPS`` in units of the gel's thickness, w ← max(w, u⁺). The gel never reaches into the object and
      leaves it where the Gaussians keep it deeper; the contact is where w = u, up to 10⁻⁵ of the deepest overlap (float32). Rim and skirt
      are about those of a linear elastic layer that is bonded at its back and touches without friction (docs/concepts/rigid-pad.md).
    - ``"threshold"``: Taxim's own (Si & Yuan, RA-L 2022, III), ``PYRAMID_SIGMAS``, gains of 1, w = u⁺ on the full contact
      C = {u > 0.4 max u}, nothing elsewhere. It keeps every detail of a relief, tears the surface along the border of C on steep walls
      (dots in the image) and lets the gel reach into the object outside C.

    Taxim does this to absolute heights in pixels; here it is done to the displacement w and with widths in metres, so that the dome is
    not smoothed, an untouched pad is exactly at rest, and the result does not depend on the grid. Borders are mirrored. No gain exceeds 1:
    the gel moves by no more than the deepest overlap.

    ``surface`` takes and gives NumPy arrays. ``launch`` works on Warp arrays of the CPU or of CUDA, so that it can be recorded. An
    environment's result does not depend on the others, to the last bit.

    Attributes:
        overlap: u⁺ [m], (B, Ny, Nx), float32, which ``launch`` reads, and with it
        window: columns from, to and rows from, to of the nodes where it is not 0, (B,), vec4i; zeros for none;
        deepest: its greatest value [m], (B,), float32.
        height: [m], (B, Ny, Nx), float32; at rest where nothing touches, and where ``lost``.
        contact: 1 where an object touches, (B, Ny, Nx), uint8.
        centre: overlap-weighted centre of the contact (x, y) [m], (B,), vectors of float64; NaN without contact.
        lost: 1 in environments whose gel would lie below its bonded face, (B,), int32.
    """

    def __init__(
        self,
        grid: PadGrid,
        *,
        thickness: float,
        num_envs: int = 1,
        device: str = "cpu",
        steps: tuple[tuple[float, float], ...] | None = None,
        final_sigma: float = FINAL_SIGMA,
        contact_rule: str = "unilateral",
        contact_scale: float = CONTACT_SCALE,
    ) -> None:
        """Make the arrays.

        Args:
            grid: nodes of the pad.
            thickness: of its gel [m], by which the layer's Gaussians are wide, and beyond which it cannot be pressed.
            num_envs: environments B that are computed together; ``surface`` takes any number, so many at a time.
            steps: standard deviation [m] and gain of every Gaussian; None takes those of the rule.
            final_sigma: [m], 0 for none.
            contact_rule: one of ``CONTACT_RULES``; ``contact_scale``: of the threshold, [0, 1).

        Raises ``InputError`` for an unknown rule, or a thickness that is not positive and finite.
        """
        check_known("contact_rule", contact_rule, CONTACT_RULES)
        check_number("thickness", thickness, "(0, inf)", "m")
        start_warp()
        self.grid, self.device = grid, wp.get_device(device)
        self._lanes = _CPU_LANES if self.device.is_cpu else _CUDA_LANES
        self._scale = contact_scale if contact_rule == "threshold" else _UNILATERAL
        self._lowest, self._shallow = float(-thickness - _FACE), float(thickness + grid.rest.min())
        finest = _FINEST * min(grid.pitch)
        if steps is None and contact_rule == "threshold":
            steps = tuple((sigma, 1.0) for sigma in PYRAMID_SIGMAS)
        elif steps is None:
            steps = tuple((share * thickness, gain) for share, gain in LAYER_STEPS)
        resolved = _resolved(steps or (), finest)
        places = grid.shape, grid.pitch, self._lanes, self.device.alias
        self._pyramid = [_gaussian(sigma, gain, *places) for sigma, gain in resolved]
        self._final = _gaussian(final_sigma, 1.0, *places) if final_sigma > finest else None
        spread = np.cumsum(np.square([*(sigma for sigma, _ in resolved), final_sigma]))
        self._reaches = [np.ceil(_REACH * np.sqrt(one) / grid.pitch).astype(int) + 2 for one in spread]
        """Nodes along x and y that each Gaussian, with those before, reaches."""
        self._allocate(num_envs)

    def _allocate(self, num_envs: int) -> None:
        """Make the arrays, rows of which are whole packets."""
        (ny, nx), lanes = self.grid.shape, self._lanes
        count, (packet, mask) = -(-nx // lanes), kernels.packet_types(lanes)
        lines = kernels.ROWS * -(-ny // kernels.ROWS)
        rows = min(num_envs, max(_STACK // (ny * nx), 1)) if self.device.is_cpu else num_envs
        padded = np.zeros((ny, count * lanes), np.float32)
        padded[:, :nx] = self.grid.rest
        self._rest = wp.array(padded.reshape(ny, count, lanes), dtype=packet, device=self.device)
        self._x, self._y = (wp.array(line, dtype=wp.float64, device=self.device) for line in (self.grid.x, self.grid.y))
        self._firsts = range(0, num_envs, rows)
        self._overlaps = self._zeros((num_envs, lines, count), packet)
        self._field, self._spare = (self._zeros((rows, lines, count), packet) for _ in range(2))
        self._moments = self._zeros((rows, ny), wp.vec2d)
        self.window, self.deepest = self._zeros((num_envs,), wp.vec4i), self._zeros((num_envs,), wp.float32)
        self._heights = self._zeros((num_envs, ny, count), packet)
        self._contacts = self._zeros((num_envs, ny, count), mask)
        self.overlap, self.height, self.contact = (
            _nodes(packets, ny, nx) for packets in (self._overlaps, self._heights, self._contacts)
        )
        self._spare_nodes = _nodes(self._spare)
        self.centre, self.lost = self._zeros((num_envs,), wp.vec2d), self._zeros((num_envs,), wp.int32)

    def surface(self, object_height: np.ndarray, pad_from_object: np.ndarray | None = None) -> GelSurface:
        """Deformed surface under an object.

        ``object_height`` [m]: underside in the pad frame, shape (B, Ny, Nx), ``inf`` where nothing is above (see
        ``raytac.shapes.underside``); ``pad_from_object`` (B, 4, 4) is passed on. An environment with NaN in it, or whose gel would lie
        below its bonded face, gets a surface of NaN without contact.
        """
        count, starts = len(self.lost), range(0, max(len(object_height), 1), len(self.lost))
        parts = [self._surface(object_height[start : start + count]) for start in starts]
        height, contact, centre = (
            values[0] if len(parts) == 1 else np.concatenate(values) for values in zip(*parts, strict=True)
        )
        return GelSurface(self.grid, height, contact, centre, pad_from_object)

    def _surface(self, object_height: np.ndarray) -> tuple[np.ndarray, ...]:
        """Height, contact and its centre of at most ``num_envs`` environments."""
        inputs, launch = self._host
        (overlap, window, deepest), count = inputs.values, len(object_height)
        u = overlap[:count]
        np.subtract(self.grid.rest, object_height, out=u, casting="same_kind")
        deepest[:count] = u.max(axis=(1, 2))
        failed = np.isnan(deepest[:count])
        np.maximum(u, np.float32(0.0), out=u)
        window[count:], window[:count] = 0, boxes(u > 0.0)
        window[:count][failed] = 0
        inputs.write()
        launch()
        height, contact, centre, lost = self.results(count)
        height[lost | failed] = np.nan
        return height, contact, centre

    @cached_property
    def _host(self) -> tuple[HostArrays, Recorded]:
        """Arrays that ``launch`` reads, and ``launch`` recorded."""
        return HostArrays(self.overlap, self.window, self.deepest), Recorded(self.launch, device=self.device)

    @cached_property
    def _results(self) -> HostArrays:
        return HostArrays(self.height, self.contact, self.centre, self.lost)

    def results(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Copies of height, contact, centre and ``lost`` of the first environments."""
        height, contact, centre, lost = (values[:count].copy() for values in self._results.read())
        return height, contact.view(bool), centre, lost != 0

    def clear(self) -> None:
        """Launch that nothing overlaps the gel."""
        self._overlaps.zero_()

    def launch(self) -> None:
        """Launch the kernels for ``overlap``, ``window`` and ``deepest``.

        Nothing waits for the device.
        """
        ny = self.grid.shape[0]
        is_unilateral = self._scale == _UNILATERAL
        for first in self._firsts:
            envs = min(len(self._field), len(self.lost) - first)
            lines, overlap, reach = (envs, ny), (self._overlaps, self.deepest, self._scale), np.zeros(2, int)
            for k, gaussian in enumerate(self._pyramid):
                reach = self._smooth(first, envs, reach, gaussian, k, imposes=is_unilateral)
                if not is_unilateral:
                    self._launch(kernels.impose, lines, [first, self.window, *overlap, self._field])
            touched = [self._overlaps, self._field, self.deepest, self._scale, _ROUNDING, self._x, self._contacts, self._moments]
            self._launch(kernels.touch, lines, [first, self.window, *touched])
            self._launch(kernels.find_centre, envs, [first, self.window, self._moments, self._y, self.centre, self.lost])
            if self._final:
                reach = self._smooth(first, envs, reach, self._final, len(self._pyramid), imposes=False)
            lifted = [self._rest, self._field, self.deepest, self._shallow, self._lowest, self._heights, self.lost]
            self._launch(kernels.lift_off, lines, [first, self.window, wp.vec2i(*reach), *lifted])
            shown = [self._rest, self._heights, self._contacts, self.centre]
            self._launch(kernels.without_lost, lines, [first, self.lost, *shown])

    def _smooth(self, first: int, envs: int, before: np.ndarray, gaussian: _Gaussian, k: int, *, imposes: bool) -> np.ndarray:
        """Launch the ``k``-th Gaussian of the field, for ``envs`` environments from ``first`` on.

        The field reaches ``before`` (x, y) nodes around the overlap; returns how far it does afterwards. ``imposes``: the contact is
        re-imposed too, by the rule ``unilateral``.
        """
        _, lines, count = self._field.shape
        after = np.minimum(before + gaussian.reach, self._reaches[k])
        threads = 1 if self.device.is_cpu else count
        dim, reaches = (envs, lines // kernels.ROWS, threads), [first, self.window, wp.vec2i(*before), wp.vec2i(*after)]
        source = [0, self._field] if k else [first, self._overlaps]
        down, across = [gaussian.down, gaussian.down_band, threads], [gaussian.across, gaussian.across_band, threads]
        self._launch(kernels.along_columns, dim, [*reaches, *down, *source, self._spare])
        self._launch(kernels.along_rows, dim, [*reaches, *across, self._spare_nodes, self._overlaps, int(imposes), self._field])
        return after

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def _zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)


def _resolved(steps: tuple[tuple[float, float], ...], finest: float) -> list[tuple[float, float]]:
    """Steps whose Gaussians are wider than ``finest`` [m], at least one.

    Of the others the gains count, in the step before: max(g max(w, u), u) = max(g w, u) for g <= 1.
    """
    wide: list[tuple[float, float]] = []
    for sigma, gain in steps:
        if sigma > finest:
            wide.append((sigma, gain))
        elif wide:
            wide[-1] = wide[-1][0], wide[-1][1] * gain
    return wide or [(0.0, 1.0)]


class _Gaussian:
    """One Gaussian as products with matrices along both axes, on the device."""

    def __init__(
        self, sigma: float, gain: float, shape: tuple[int, int], pitch: tuple[float, float], lanes: int, device: Any
    ) -> None:
        """``sigma`` [m]; ``gain``: sum of its weights; ``lanes``: nodes in a packet."""
        (ny, nx), (dx, dy) = shape, pitch
        (along_y, reach_y), (along_x, reach_x) = gaussian_matrix(ny, sigma / dy), gaussian_matrix(nx, sigma / dx)
        self.reach = np.array([reach_x, reach_y])
        """Nodes along x and y."""
        down, self.down_band = _blocks(gain * along_y, kernels.ROWS, device)
        self.down = wp.array(np.ascontiguousarray(down.transpose(1, 0, 2)), dtype=wp.vec4f, device=device)
        """Weights of ``ROWS`` rows in a vector, (blocks, Ny)."""
        across, self.across_band = _blocks(along_x, lanes, device)
        self.across = wp.array(across, dtype=kernels.packet_types(lanes)[0], device=device)
        """Weights of a packet of columns in a vector, (Nx, packets)."""


_gaussian = lru_cache(32)(_Gaussian)
"""Gaussians that pads of one grid share; nothing writes to them.

A pad has up to eight, of a megabyte or less."""


def _blocks(matrix: np.ndarray, size: int, device: Any) -> tuple[np.ndarray, wp.array]:
    """Rows of a matrix (n, n) in blocks, and the columns of each that are not 0.

    Shapes (n, blocks, size), float32; columns from and to.
    """
    count = -(-len(matrix) // size)
    padded = np.zeros((count * size, len(matrix)), np.float32)
    padded[: len(matrix)] = matrix
    used = (padded != 0.0).reshape(count, size, -1).any(axis=1)
    band = np.stack([used.argmax(axis=1), len(matrix) - used[:, ::-1].argmax(axis=1)], axis=1)
    return np.ascontiguousarray(padded.T).reshape(-1, count, size), wp.array(band, dtype=wp.vec2i, device=device)


def _nodes(packets: wp.array, rows: int | None = None, columns: int | None = None) -> wp.array:
    """The first rows and columns of an array of packets (B, n, m), node by node.

    They are in the same memory; None is all.
    """
    *shape, count = packets.shape
    kind: Any = packets.dtype
    nodes: Any = wp.array(
        ptr=packets.ptr, shape=(*shape, count * kind._length_), dtype=kind._wp_scalar_type_, device=packets.device
    )
    nodes._packets = packets  # whose memory it is
    return nodes[:, :rows, :columns]
