"""Separate contacts of every pad, and how far the object has dragged and turned each since it first touched."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.components import find_runs, join_runs

__all__ = ["CELL", "ContactCells", "ContactSamples", "ContactTracker", "Contacts", "chosen_envs", "contact_boxes"]

CELL = 0.4e-3
"""Largest cell over which a contact is averaged [m], unless the pad's grid is coarser; narrower gaps do not part two contacts."""
_REACH = 1e-3
"""How far a contact may be from where the object's motion would have carried it, beyond its own radius, and still be the same [m]."""


@dataclass(frozen=True)
class ContactCells:
    """The pad's face in cells of whole grid nodes."""

    grid: PadGrid
    nodes: tuple[int, int]
    """Nodes of a cell along x and y."""
    x: np.ndarray
    """Centres of the columns [m], shape (nx,); the last cell may reach beyond the pad."""
    y: np.ndarray
    """Centres of the rows [m], shape (ny,)."""

    @classmethod
    def over(cls, grid: PadGrid) -> ContactCells:
        nodes = tuple(max(1, int(CELL / pitch + 1e-9)) for pitch in grid.pitch)
        x, y = (
            first + pitch * (count * np.arange(-(-len(line) // count)) + 0.5 * (count - 1))
            for first, pitch, count, line in zip((grid.x[0], grid.y[0]), grid.pitch, nodes, (grid.x, grid.y), strict=True)
        )
        return cls(grid, (nodes[0], nodes[1]), x, y)

    @property
    def area(self) -> float:
        """Area of a cell [m²]."""
        (dx, dy), (kx, ky) = self.grid.pitch, self.nodes
        return dx * kx * dy * ky

    def sample(self, surface: GelSurface) -> ContactSamples:
        """Average the indentation over the cells; an environment whose heights are not finite has no contact there.

        Raises:
            InputError: a surface on another grid.
        """
        if surface.grid is not self.grid and surface.grid.shape != self.grid.shape:
            raise InputError(
                "surface.grid", value=surface.grid.shape, rule=f"must be that of the first surface, {self.grid.shape}"
            )
        (kx, ky), batch = self.nodes, surface.batch
        depth = np.zeros((batch, len(self.y), len(self.x)), dtype=np.float32)
        contact = np.zeros(depth.shape, bool)
        anywhere = np.asarray(surface.contact[0] if batch == 1 else surface.contact.any(axis=0))
        rows = np.flatnonzero(anywhere.any(axis=1))
        if len(rows) == 0:
            return ContactSamples(self, depth, contact, (0, 0, 0, 0))
        r0, r1 = int(rows[0]), int(rows[-1])
        columns = np.flatnonzero(anywhere[r0 : r1 + 1].any(axis=0))
        c0, c1 = int(columns[0]), int(columns[-1])
        r0, r1, c0, c1 = r0 // ky, r1 // ky + 1, c0 // kx, c1 // kx + 1
        part = np.s_[:, r0 * ky : r1 * ky, c0 * kx : c1 * kx]
        touched = np.asarray(surface.contact)[part]
        found = self.grid.rest[part[1:]].astype(np.float32) - surface.height[part]
        if not math.isfinite(found.sum()):
            touched = touched & np.all(np.isfinite(found), axis=(1, 2))[:, None, None]
            found = np.where(touched, found, np.float32(0))
        found = np.maximum(found, 0) * touched
        ny, nx = r1 - r0, c1 - c0
        # Whole cells, also at the pad's far edges.
        missing = ny * ky - found.shape[1], nx * kx - found.shape[2]
        if any(missing):
            widths = ((0, 0), (0, missing[0]), (0, missing[1]))
            found, touched = np.pad(found, widths), np.pad(touched, widths)
        cells = np.s_[:, r0:r1, c0:c1]
        depth[cells] = found.reshape(batch, ny, ky, nx, kx).sum(axis=2).sum(axis=-1) / (kx * ky)
        contact[cells] = touched.reshape(batch, ny, ky, nx, kx).any(axis=2).any(axis=-1)
        return ContactSamples(self, depth, contact, (r0, r1, c0, c1))


@dataclass(frozen=True)
class ContactSamples:
    """Contact of B pads by cell: ``depth`` [m], (B, ny, nx), float32: mean of max(rest − height, 0) where the object touches, 0 where it
    does not; ``contact`` (B, ny, nx), bool: whether it touches the cell at all; ``box``: rows [r0, r1) and columns [c0, c1) outside of
    which no environment has contact.
    """

    cells: ContactCells
    depth: np.ndarray
    contact: np.ndarray
    box: tuple[int, int, int, int]

    @property
    def boxes(self) -> np.ndarray:
        """Columns [c0, c1) and rows [r0, r1) that hold the contact of each environment, (B, 4), uint32; all 0 without contact."""
        if len(self.contact) > 1:
            return contact_boxes(self.contact)
        r0, r1, c0, c1 = self.box
        return np.array([[c0, c1, r0, r1]], dtype=np.uint32)


def contact_boxes(contact: np.ndarray) -> np.ndarray:
    """As ``ContactSamples.boxes``, of masks (B, ny, nx)."""
    columns, rows = np.any(contact, axis=1), np.any(contact, axis=2)
    edges = [columns.argmax(axis=1), columns.shape[1] - columns[:, ::-1].argmax(axis=1)]
    edges += [rows.argmax(axis=1), rows.shape[1] - rows[:, ::-1].argmax(axis=1)]
    return np.where(np.any(rows, axis=1)[:, None], np.stack(edges, axis=1), 0).astype(np.uint32)


@dataclass(frozen=True)
class Contacts:
    """Up to K contacts of each of B pads; rows that are not ``active`` hold zeros.

    ``active`` (B, K); ``centre`` [m], (B, K, 2): indentation-weighted; ``shear`` [m], (B, K, 2): tangential way of the object at the
    contact since first touch; ``twist`` [rad], (B, K): its turn about +z since then; ``radius`` [m], (B, K): of a disc with the area of all
    cells that the contact touches. That is more than the contact's own: for a disc of radius R by cells whose nodes span a × b, on
    average π radius² = π R² + 2 R (a + b) + a b (Steiner), about R + (a + b)/π, so 0.2 mm for cells of 0.4 mm.
    ``ellipse`` [m²], (B, K, 3): T_xx, T_xy, T_yy of xᵀ T⁻¹ x = 1, the ellipse of that area whose axes have the directions and the ratio
    of the cells' second moments; a disc of that radius has T = radius² 1. ``depth`` [m], (B, K): mean indentation over those cells.
    """

    active: np.ndarray
    centre: np.ndarray
    shear: np.ndarray
    twist: np.ndarray
    radius: np.ndarray
    ellipse: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True)
class _Contact:
    """One contact, as in ``Contacts``: centre, radius, ellipse and depth, height z of the pressed gel, then what the object did to it."""

    x: float
    y: float
    radius: float
    ellipse: tuple[float, float, float]
    depth: float
    z: float
    shear_x: float = 0.0
    shear_y: float = 0.0
    twist: float = 0.0


class ContactTracker:
    """Finds the contacts of each surface in turn and sums up the object's motion at each of them.

    A contact is a connected piece of the contact. From one surface to the next the object moves by D = T_now T_before⁻¹ (pad
    frame); a contact at G, on the pressed gel, adds (D G − G)_xy to its shear and D's turn about z to its twist: the way of the
    object's material where it touches, so that rolling, in which that stands still, adds none. A contact is the same as one before if it
    lies where D carries that one, to within its radius and 1 mm; otherwise it is new and starts from zero. Without contact the
    history is gone.
    """

    def __init__(self, batch: int) -> None:
        self.batch = batch
        self.reset()

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Forget the history of environments: a mask (B,), a list, or None for all.

        Raises:
            InputError: an environment that does not exist, or a mask of the wrong length.
        """
        if envs is None:
            self._contacts: list[list[_Contact]] = [[] for _ in range(self.batch)]
            self._pose = np.full((self.batch, 4, 4), np.nan)
            return
        for b in chosen_envs(envs, self.batch):
            self._contacts[b] = []
            self._pose[b] = np.nan

    def update(self, surface: GelSurface, samples: ContactSamples) -> Contacts:
        """Contacts of ``surface``, whose ``samples`` are given; call once for every surface, in order.

        Raises:
            InputError: a surface of another number of environments.
        """
        if surface.batch != self.batch:
            raise InputError("surface", value=surface.batch, rule=f"must have {self.batch} environments, as this tracker")
        motion = self._motion(surface.pad_from_object)
        found = _find(samples)
        self._contacts = [
            [_followed(one, before, move) for one in now] for now, before, move in zip(found, self._contacts, motion, strict=True)
        ]
        count = max(1, max(len(one) for one in self._contacts))
        table = np.zeros((self.batch, count, 11))
        for b, contacts in enumerate(self._contacts):
            for k, c in enumerate(contacts):
                table[b, k] = 1, c.x, c.y, c.shear_x, c.shear_y, c.twist, c.radius, *c.ellipse, c.depth
        return Contacts(
            table[..., 0] > 0, table[..., 1:3], table[..., 3:5], table[..., 5], table[..., 6], table[..., 7:10], table[..., 10]
        )

    def _motion(self, pose: np.ndarray | None) -> list[tuple[float, ...] | None]:
        """D's rows of x and y in every environment, (xx, xy, xz, x, yx, yy, yz, y), and its turn about z.

        None where this or the last pose is not known.
        """
        before, self._pose = self._pose, np.full_like(self._pose, np.nan) if pose is None else np.array(pose, dtype=float)
        if pose is None or all(not contacts for contacts in self._contacts):
            return [None] * self.batch
        turn = self._pose[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
        shift = self._pose[:, :3, 3] - (turn @ before[:, :3, 3:])[..., 0]
        rows = np.concatenate([turn.reshape(-1, 9), shift], axis=1).tolist()
        return [
            (*r[:3], r[9], *r[3:6], r[10], math.atan2(r[3] - r[1], r[0] + r[4])) if math.isfinite(sum(r)) else None
            for r in rows
        ]  # fmt: skip


def chosen_envs(envs: np.ndarray | list[int], batch: int) -> list[int]:
    """Numbers of the environments that a mask (B,) or a list names.

    Raises:
        InputError: an environment that does not exist, or a mask of the wrong length.
    """
    chosen = np.asarray(envs)
    if chosen.dtype == bool:
        if chosen.shape != (batch,):
            raise InputError("envs", value=chosen.shape, rule=f"a mask must have shape ({batch},)")
        return np.flatnonzero(chosen).tolist()
    if chosen.size and (chosen.min() < 0 or chosen.max() >= batch):
        raise InputError("envs", value=chosen.tolist(), rule=f"must name environments 0 to {batch - 1}")
    return chosen.astype(int).ravel().tolist()


def _followed(now: _Contact, before: list[_Contact], motion: tuple[float, ...] | None) -> _Contact:
    """``now`` with the history of the contact before that the motion carries to it, if there is one."""
    xx, xy, xz, x, yx, yy, yz, y, turn = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0) if motion is None else motion
    nearest, least = None, math.inf
    for c in before:
        carried = xx * c.x + xy * c.y + xz * c.z + x, yx * c.x + yy * c.y + yz * c.z + y
        apart = math.hypot(now.x - carried[0], now.y - carried[1])
        if apart < least:
            nearest, least = (c, carried), apart
    if nearest is None or least > max(now.radius, nearest[0].radius) + _REACH:
        return now
    c, carried = nearest
    shear_x, shear_y = c.shear_x + carried[0] - c.x, c.shear_y + carried[1] - c.y
    return _Contact(now.x, now.y, now.radius, now.ellipse, now.depth, now.z, shear_x, shear_y, c.twist + turn)


def _find(samples: ContactSamples) -> list[list[_Contact]]:
    """The contacts of every environment, in order of their first row, without history."""
    cells, (r0, r1, c0, c1) = samples.cells, samples.box
    found: list[list[_Contact]] = [[] for _ in samples.contact]
    if r1 == r0:
        return found
    row, start, stop = find_runs(samples.contact[:, r0:r1, c0:c1])
    if len(row) == 0:
        return found
    ny, nx = r1 - r0, c1 - c0
    # A touch of no depth still has a place: the floor keeps its weights from all being zero.
    weight = np.maximum(samples.depth[:, r0:r1, c0:c1].reshape(-1, nx), 1e-9)
    sums = np.zeros((2, len(weight), nx + 1))
    sums[0, :, 1:] = weight
    np.multiply(sums[0, :, 1:], cells.x[c0:c1], out=sums[1, :, 1:])
    sums = sums.cumsum(axis=2).reshape(2, -1)
    line = row * (nx + 1)
    total, along = (sums.take(line + stop, axis=1) - sums.take(line + start, axis=1)).tolist()
    rows, starts, stops, y = row.tolist(), start.tolist(), stop.tolist(), cells.y[r0:r1].tolist()
    # Second moments are taken about the box's corner, in cells: whole numbers, so that nothing cancels.
    pieces: dict[int, list[float]] = {}
    for i, number in enumerate(join_runs(rows, starts, stops, ny)):
        piece = pieces.get(number)
        if piece is None:
            piece = pieces[number] = [0.0] * 9
        line, length = rows[i] % ny, stops[i] - starts[i]
        middle = 0.5 * (starts[i] + stops[i])
        piece[0] += total[i]
        piece[1] += along[i]
        piece[2] += total[i] * y[line]
        piece[3] += length
        piece[4] += length * middle
        piece[5] += length * line
        piece[6] += length * (middle * middle + length * length / 12.0)
        piece[7] += length * middle * line
        piece[8] += length * line * line
    dx, dy = (pitch * nodes for pitch, nodes in zip(cells.grid.pitch, cells.nodes, strict=True))
    for number, (w, wx, wy, count, mx, my, mxx, mxy, myy) in pieces.items():
        area = count * dx * dy / math.pi
        mx, my = mx / count, my / count
        xx, xy, yy = mxx / count - mx * mx, mxy / count - mx * my, myy / count - my * my + 1.0 / 12.0
        xx, xy, yy = xx * dx * dx, xy * dx * dy, yy * dy * dy
        scale = area / math.sqrt(xx * yy - xy * xy)
        ellipse = scale * xx, scale * xy, scale * yy
        at = wx / w, wy / w
        z = _rest_at(cells.grid, *at) - w / count
        found[rows[number] // ny].append(_Contact(*at, math.sqrt(area), ellipse, w / count, z))
    return found


def _rest_at(grid: PadGrid, x: float, y: float) -> float:
    """Height of the resting gel at the node nearest to a place [m]."""
    column, row = (
        round((at - float(line[0])) / pitch) for at, line, pitch in zip((x, y), (grid.x, grid.y), grid.pitch, strict=True)
    )
    return float(grid.rest[min(row, len(grid.y) - 1), min(column, len(grid.x) - 1)])
