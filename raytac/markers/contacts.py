"""Contacts of every pad, and the object's drag and turn at each since first touch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np

from raytac.checks import is_number
from raytac.errors import InputError
from raytac.gel.components import find_edges, join_runs
from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, PadGrid, chosen_envs

TWIST_SLIP = 3 * math.pi / 16
"""Displacement at a contact's edge when it spins over that when it slides, at the limits.

Of a ball on incompressible rubber. Sliding, μ P = 8 G A Δs / (2 − ν); spinning, 3π/16 μ P A = 16/3 G A³ Δθ (Johnson, §3.6, 3.9); so
9π/32 / (2 − ν)."""
_LIMIT_STEPS = 6


@dataclass(frozen=True)
class ContactSettings:
    """Sampling of contacts, and tracking from one surface to the next."""

    cell: float = 0.4e-3
    """Largest side of a cell that a contact is averaged over [m], unless the grid is coarser.

    Gaps narrower than a cell do not separate two contacts. Marker motion is fitted with this size."""
    reach: float = 1e-3
    """Distance [m] beyond a carried contact's radius within which a contact is that one.

    It covers what a contact's centre moves by itself, as of a ball that rolls or an edge that comes down."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (is_number(value) and 0.0 < value < math.inf):
                raise InputError(name, value=value, rule="must be finite and > 0 [m]")


@dataclass(frozen=True)
class ContactCells:
    """Cells of whole grid nodes that cover the pad's face."""

    grid: PadGrid
    nodes: tuple[int, int]
    """Nodes of a cell along x and y."""
    x: np.ndarray
    """Centres of the columns [m], shape (nx,); the last cell may reach beyond the pad."""
    y: np.ndarray
    """Centres of the rows [m], shape (ny,)."""

    @classmethod
    def over(cls, grid: PadGrid, settings: ContactSettings | None = None) -> ContactCells:
        """Cells of a grid; ``settings``: None is the default ones."""
        size = (settings or ContactSettings()).cell
        nodes = tuple(max(1, int(size / pitch + 1e-9)) for pitch in grid.pitch)
        x, y = (
            first + pitch * (count * np.arange(-(-len(line) // count)) + 0.5 * (count - 1))
            for first, pitch, count, line in zip((grid.x[0], grid.y[0]), grid.pitch, nodes, (grid.x, grid.y), strict=True)
        )
        return cls(grid, (nodes[0], nodes[1]), x, y)

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """Width and height of a cell [m]."""
        (dx, dy), (kx, ky) = self.grid.pitch, self.nodes
        return dx * kx, dy * ky

    @property
    def area(self) -> float:
        """Area of a cell [m²]."""
        return self.pitch[0] * self.pitch[1]

    @cached_property
    def _rest(self) -> np.ndarray:
        """The grid's rest surface as heights are stored."""
        return self.grid.rest.astype(np.float32)

    def rest_at(self, x: float, y: float) -> float:
        """Height of the resting gel at the node nearest to a place on the pad [m]."""
        (x0, y0), (dx, dy), (ny, nx) = self.grid.origin, self.grid.pitch, self.grid.shape
        return self.grid.rest.item(min(round((y - y0) / dy), ny - 1), min(round((x - x0) / dx), nx - 1))

    def sample(self, surface: GelSurface) -> ContactSamples:
        """Average the indentation over the cells; none where heights are not finite."""
        if surface.grid is not self.grid and surface.grid.shape != self.grid.shape:
            rule = f"must be that of the first surface, {self.grid.shape}"
            raise InputError("surface.grid", value=surface.grid.shape, rule=rule)
        (kx, ky), batch = self.nodes, surface.batch
        depth = np.zeros((batch, len(self.y), len(self.x)), dtype=np.float32)
        contact = np.zeros(depth.shape, bool)
        mask = np.asarray(surface.contact)
        r0, r1, c0, c1 = _box_of(mask[0] if batch == 1 else np.logical_or.reduce(mask))
        if r0 == r1:
            return ContactSamples(self, depth, contact, (0, 0, 0, 0))
        r0, r1, c0, c1 = r0 // ky, -(-r1 // ky), c0 // kx, -(-c1 // kx)
        part = np.s_[:, r0 * ky : r1 * ky, c0 * kx : c1 * kx]
        touched = mask[part]
        indentation = self._rest[part[1:]] - surface.height[part]
        np.maximum(indentation, 0, out=indentation)
        if not math.isfinite(indentation.sum()):
            touched = touched & np.all(np.isfinite(indentation), axis=(1, 2))[:, None, None]
            indentation = np.where(touched, indentation, np.float32(0))
        np.multiply(indentation, touched, out=indentation)
        cells = np.s_[:, r0:r1, c0:c1]
        depth[cells] = self._pooled(np.add, indentation, r1 - r0, c1 - c0)
        if kx * ky > 1:
            depth[cells] /= np.float32(kx * ky)
        contact[cells] = self._pooled(np.logical_or, touched, r1 - r0, c1 - c0)
        return ContactSamples(self, depth, contact, (r0, r1, c0, c1))

    def _pooled(self, join: np.ufunc, values: np.ndarray, ny: int, nx: int) -> np.ndarray:
        """Node values (B, Ny, Nx) joined over ``ny`` × ``nx`` cells; the last may pass the edge."""
        kx, ky = self.nodes
        if kx == ky == 1:
            return values
        missing = ny * ky - values.shape[1], nx * kx - values.shape[2]
        if any(missing):
            values = np.pad(values, ((0, 0), (0, missing[0]), (0, missing[1])))
        lines = join.reduce(values.reshape(len(values), ny, ky, nx * kx), axis=2)
        return reduce(join, [lines[..., k::kx] for k in range(kx)])


@dataclass(frozen=True)
class ContactSamples:
    """Contact of B pads by cell."""

    cells: ContactCells
    depth: np.ndarray
    """Mean of max(rest − height, 0) in contact, else 0 [m], (B, ny, nx), float32."""
    contact: np.ndarray
    """True where the object touches the cell at all, (B, ny, nx), bool."""
    box: tuple[int, int, int, int]
    """Rows [r0, r1) and columns [c0, c1) outside of which no environment has contact."""

    @property
    def boxes(self) -> np.ndarray:
        """Columns [c0, c1) and rows [r0, r1) of each contact, (B, 4), uint32; 0 without contact."""
        if len(self.contact) > 1:
            return contact_boxes(self.contact)
        r0, r1, c0, c1 = self.box
        return np.array([[c0, c1, r0, r1]], dtype=np.uint32)


def _box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Rows [r0, r1) and columns [c0, c1) of the True values of a mask (Ny, Nx); 0 if none."""
    # A search in bytes, from either end, is several times faster than a reduction of the array.
    flat, width = mask.tobytes(), mask.shape[1]
    first = flat.find(1)
    if first < 0:
        return 0, 0, 0, 0
    r0, r1 = first // width, flat.rfind(1) // width + 1
    line = mask[r0:r1].any(axis=0).tobytes()
    return r0, r1, line.find(1), line.rfind(1) + 1


def contact_boxes(contact: np.ndarray) -> np.ndarray:
    """As ``ContactSamples.boxes``, of masks (B, ny, nx)."""
    lines = np.any(contact, axis=1), np.any(contact, axis=2)
    edges = [edge for line in lines for edge in (line.argmax(axis=1), line.shape[1] - line[:, ::-1].argmax(axis=1))]
    return np.where(np.any(lines[1], axis=1)[:, None], np.stack(edges, axis=1), 0).astype(np.uint32)


@dataclass(frozen=True)
class Contacts:
    """Up to K contacts of each of B pads; rows that are not ``active`` are zero.

    ``table`` (B, K, 12) has the columns ``active``, ``centre`` (2), ``shear`` (2), ``twist``, ``ellipse`` (3), ``depth``, ``radius`` and
    the height z of the pressed gel.
    """

    table: np.ndarray

    @property
    def active(self) -> np.ndarray:
        """True for rows that are contacts, (B, K), bool."""
        return self.table[..., 0] > 0

    @property
    def centre(self) -> np.ndarray:
        """Indentation-weighted centre [m], (B, K, 2)."""
        return self.table[..., 1:3]

    @property
    def shear(self) -> np.ndarray:
        """Tangential displacement of the object since first touch, less known slip [m], (B, K, 2)."""
        return self.table[..., 3:5]

    @property
    def twist(self) -> np.ndarray:
        """Rotation of the object about +z since first touch, less known slip [rad], (B, K)."""
        return self.table[..., 5]

    @property
    def ellipse(self) -> np.ndarray:
        """T_xx, T_xy, T_yy of the ellipse xᵀ T⁻¹ x = 1 [m²], (B, K, 3).

        It has the contact's area, and its axes have the directions and the ratio of the cells' second moments. A disc has T = radius² 1.
        """
        return self.table[..., 6:9]

    @property
    def depth(self) -> np.ndarray:
        """Mean indentation over the cells that the contact touches [m], (B, K)."""
        return self.table[..., 9]

    @property
    def radius(self) -> np.ndarray:
        """Radius of a disc with the area of all cells that the contact touches [m], (B, K).

        It is larger than the contact's own: for a disc of radius R and cells whose nodes span a × b, on average
        π radius² = π R² + 2 R (a + b) + a b (Steiner), about R + (a + b)/π; 0.2 mm more for cells of 0.4 mm.
        """
        return self.table[..., 10]


class _Contact(NamedTuple):
    """One contact, as a row of ``Contacts.table`` after its first column."""

    x: float
    y: float
    shear_x: float
    shear_y: float
    twist: float
    xx: float
    xy: float
    yy: float
    depth: float
    radius: float
    z: float


_Pose = list[list[float]]
"""Rows of ``pad_from_object``."""
_NO_CONTACT = (0.0,) * 12


class ContactTracker:
    """Contacts of each surface in turn, with the object's motion summed at each.

    A contact is a connected component of the contact mask. From one surface to the next the object moves by D = T_now T_before⁻¹ (pad
    frame). A contact at G, on the pressed gel, adds (D G − G)_xy to its shear and D's rotation about z to its twist. This is the motion
    of the object's material where it touches, which is zero in rolling. A contact is an earlier one if it lies where D carries that one,
    to within its radius and ``ContactSettings.reach``; otherwise it is new and starts from zero. Without contact the history is dropped.

    With ``slip`` c, what exceeds Δs_max = c h̄ A and Δθ_max = ``TWIST_SLIP`` c h̄ slips and is forgotten, so a reversal unloads first.
    The shear that the physics knows takes the place of the history of the contact that it belongs to.
    """

    def __init__(self, batch: int, settings: ContactSettings | None = None, *, slip: float | None = None) -> None:
        """``settings``: None is the default; ``slip`` [1/m]: None never slips."""
        self.batch, self._reach, self._slip = batch, (settings or ContactSettings()).reach, slip
        self._contacts: list[list[_Contact]] = [[] for _ in range(batch)]
        self._pose: list[_Pose | None] = [None] * batch

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Drop the history of environments; ``envs`` as in ``chosen_envs``."""
        for b in chosen_envs(envs, self.batch):
            self._contacts[b] = []
            self._pose[b] = None

    def update(
        self, surface: GelSurface, samples: ContactSamples, envs: Sequence[int] | None = None, shear: ContactShear | None = None
    ) -> Contacts:
        """Contacts of ``surface``; arguments and errors as of ``MarkerTracker.update``."""
        chosen = range(self.batch) if envs is None else envs
        if surface.batch != len(chosen):
            raise InputError("surface", value=surface.batch, rule=f"must have {len(chosen)} environments, as this tracker")
        matrices = surface.pad_from_object
        poses: list[_Pose | None] = [None] * len(chosen) if matrices is None else np.asarray(matrices).tolist()
        history = [(self._contacts[b], self._pose[b]) for b in chosen]
        contacts = [
            self._continued(now, before, _motion(last, pose)) if now and before else now
            for now, (before, last), pose in zip(_detect(samples), history, poses, strict=True)
        ]
        if shear is not None:
            for now, place, stretch, spin in zip(
                contacts, shear.centre.tolist(), shear.stretch.tolist(), shear.spin.tolist(), strict=True
            ):
                self._set_shear(now, place, stretch, spin)
        for b, now, pose in zip(chosen, contacts, poses, strict=True):
            self._contacts[b], self._pose[b] = now, pose
        count = max(1, max(map(len, contacts)))
        return Contacts(np.array([[(1.0, *c) for c in now] + [_NO_CONTACT] * (count - len(now)) for now in contacts]))

    def _continued(self, contacts: list[_Contact], before: list[_Contact], motion: tuple[float, ...]) -> list[_Contact]:
        """Contacts with the histories of those ``before`` that the motion carries to them."""
        xx, xy, xz, x, yx, yy, yz, y, angle = motion
        carried = [(c, xx * c.x + xy * c.y + xz * c.z + x, yx * c.x + yy * c.y + yz * c.z + y) for c in before]
        result = []
        for now in contacts:
            at = now.x, now.y
            c, cx, cy = min(carried, key=lambda one: math.dist(at, one[1:]))
            if math.dist(at, (cx, cy)) <= max(now.radius, c.radius) + self._reach:
                moved = c.shear_x + cx - c.x, c.shear_y + cy - c.y, c.twist + angle
                result.append(_Contact(*at, *(moved if self._slip is None else _slipped(moved, now, self._slip)), *now[5:]))
            else:
                result.append(now)
        return result

    def _set_shear(self, contacts: list[_Contact], place: list[float], stretch: list[float], spin: float) -> None:
        """Give the physics' shear to the contact at its ``place``; zeros or NaN are no contact."""
        if not contacts or not any(place) or not math.isfinite(sum((*place, *stretch, spin))):
            return
        distances = [math.dist((c.x, c.y), place[:2]) for c in contacts]
        k = distances.index(min(distances))
        if distances[k] <= contacts[k].radius + self._reach:
            contacts[k] = contacts[k]._replace(shear_x=stretch[0], shear_y=stretch[1], twist=spin)


def _slipped(moved: tuple[float, float, float], contact: _Contact, slip: float) -> tuple[float, float, float]:
    """Shear and twist that a contact keeps: the energy's closest point of the ellipsoid."""
    radius = max(contact.xx * contact.yy - contact.xy**2, 1e-24) ** 0.25
    shear_max, twist_max = slip * contact.depth * radius, TWIST_SLIP * slip * contact.depth
    x, y = math.hypot(*moved[:2]) / max(shear_max, 1e-12), abs(moved[2]) / max(twist_max, 1e-12)
    if x * x + y * y <= 1.0:
        return moved
    sheared, turned = kept_shares(x, y, _LIMIT_STEPS, math.sqrt, max)
    return sheared * moved[0], sheared * moved[1], turned * moved[2]


def kept_shares(x: Any, y: Any, steps: int, sqrt: Callable[[Any], Any], larger: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """Shares of a shear and of a twist that stick, by both over their limits.

    They are those of the closest point of the ellipsoid, in energy.
    Newton's method on 1 / √(x² + y²) = 1, which is a straight line in γ for b = 1, from where the larger of the two alone would be; b as
    in ``fots``. ``sqrt`` and ``larger``: of the numbers, which may be arrays.
    """
    b = 1 / TWIST_SLIP**2
    gamma = larger(larger(x - 1, (y - 1) / b), 0)
    for _ in range(steps):
        p, q = 1 + gamma, 1 + b * gamma
        xp, yq = x / p, y / q
        n = sqrt(xp * xp + yq * yq)
        gamma = gamma + n * n * larger(n - 1, 0) / larger(xp * xp / p + b * yq * yq / q, 1e-12)
    return 1 / (1 + gamma), 1 / (1 + b * gamma)


def _motion(before: _Pose | None, now: _Pose | None) -> tuple[float, ...]:
    """Rows of x and y of D = T_now T_before⁻¹, and its rotation about z.

    (xx, xy, xz, x, yx, yy, yz, y); the identity if a pose is unknown.
    """
    if before is not None and now is not None:
        xx, xy, xz = (_dot(now[0], row) for row in before[:3])
        yx, yy, yz = (_dot(now[1], row) for row in before[:3])
        origin = [row[3] for row in before[:3]]
        x, y = now[0][3] - _dot((xx, xy, xz), origin), now[1][3] - _dot((yx, yy, yz), origin)
        motion = xx, xy, xz, x, yx, yy, yz, y, math.atan2(yx - xy, xx + yy)
        if math.isfinite(sum(motion)):
            return motion
    return 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _detect(samples: ContactSamples) -> list[list[_Contact]]:
    """Contacts of every environment, in order of their first row, without history."""
    cells, (r0, r1, c0, c1) = samples.cells, samples.box
    contacts: list[list[_Contact]] = [[] for _ in range(len(samples.contact))]
    if r1 == r0:
        return contacts
    edges = find_edges(samples.contact[:, r0:r1, c0:c1])
    if len(edges) == 0:
        return contacts
    ny, nx = r1 - r0, c1 - c0
    # Indentation and its moment along x, summed over each run at once. The floor keeps the weights of a touch of no depth from all
    # being zero.
    weights = np.zeros((2, len(contacts) * ny, nx + 1))
    np.maximum(samples.depth[:, r0:r1, c0:c1].reshape(-1, nx), 1e-9, out=weights[0, :, :nx])
    np.multiply(weights[0, :, :nx], cells.x[c0:c1], out=weights[1, :, :nx])
    total, along = np.add.reduceat(weights.reshape(2, -1), edges, axis=1)[:, ::2]
    row, column = np.divmod(edges, nx + 1)
    row, start, stop = row[::2], column[::2], column[1::2]
    number = join_runs(row, start, stop, ny)
    # Second moments are taken about the box's corner in cells: of whole numbers, nothing cancels.
    line, length, y = row % ny, (stop - start).astype(float), cells.y[r0:r1]
    middle = 0.5 * (start + stop)
    mx, my = length * middle, length * line
    mxx = middle * mx + length * length * length / 12.0
    runs = np.stack([total, along, total * y[line], length, mx, my, mxx, mx * line, my * line])
    order = np.argsort(number, kind="stable")
    roots = np.flatnonzero(number == np.arange(len(number)))
    sums = np.add.reduceat(runs[:, order], np.searchsorted(number[order], roots), axis=1)
    dx, dy = cells.pitch
    for env, (w, wx, wy, count, mx, my, mxx, mxy, myy) in zip((row[roots] // ny).tolist(), sums.T.tolist(), strict=True):
        area = count * dx * dy / math.pi
        mx, my = mx / count, my / count
        xx, xy, yy = mxx / count - mx * mx, mxy / count - mx * my, myy / count - my * my + 1.0 / 12.0
        xx, xy, yy = xx * dx * dx, xy * dx * dy, yy * dy * dy
        scale = area / math.sqrt(xx * yy - xy * xy)
        at, depth = (wx / w, wy / w), w / count
        z = cells.rest_at(*at) - depth
        one = _Contact(*at, 0.0, 0.0, 0.0, scale * xx, scale * xy, scale * yy, depth, math.sqrt(area), z)
        contacts[env].append(one)
    return contacts
