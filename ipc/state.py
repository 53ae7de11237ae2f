"""Snapshots of a world, frames moved at once, and a caller's values for environments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipc.bodies.body import AffineBody, Body, rotation_matrix
from ipc.bodies.layout import Layout
from ipc.errors import IpcError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """A snapshot of every environment; arrays lead with the environment, B.

    Attributes:
        y: node positions in their body's frame [m] (B, N, 3).
        velocity: node velocities, world frame [m/s] (B, N, 3).
        frame_rotation, frame_position: frames of bodies, grips and aims, quaternion (w, x, y, z) (B, frames, 4) and [m] (B, frames, 3).
        kappa: [Pa] (B,).
        failed: (B,).
        stuck: pairs that remember a slip: four vertices, −1 unused, and the body pair, all −1 without a pair, (B, C, 5).
        slip: their elastic slips, world frame [m] (B, C, 3).
    """

    y: Floats
    velocity: Floats
    frame_rotation: Floats
    frame_position: Floats
    kappa: Floats
    failed: NDArray[np.bool_]
    stuck: NDArray[np.int32]
    slip: Floats


def start_state(layout: Layout, num_envs: int, kappa: float) -> State:
    """The state of undeformed bodies at rest, placed as in the layout."""
    nodes = np.broadcast_to(layout.node_rest, (num_envs, *layout.node_rest.shape))
    frames = layout.frame_pose
    return State(
        y=nodes.copy(),
        velocity=np.zeros(nodes.shape),
        frame_rotation=np.broadcast_to(frames[:, 3:], (num_envs, len(frames), 4)).copy(),
        frame_position=np.broadcast_to(frames[:, :3], (num_envs, len(frames), 3)).copy(),
        kappa=np.full(num_envs, kappa),
        failed=np.zeros(num_envs, bool),
        stuck=np.zeros((num_envs, 0, 5), np.int32),
        slip=np.zeros((num_envs, 0, 3)),
    )


def teleported(
    state: State,
    layout: Layout,
    body: Body,
    frame: int,
    position: Floats | None,
    rotation: Floats | None,
    mask: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Move a frame, and all that is bonded to it, in the environments of the mask.

    Changes ``state``; velocities become zero, and contacts of the body forget their slip.

    Args:
        body: owner of the frame.
        position, rotation: [m] (B, 3), unit quaternion (w, x, y, z) (B, 4); None keeps it.

    Returns:
        the frames that moved, (frames,).
    """
    before = rotation_matrix(state.frame_rotation), state.frame_position.copy()
    if position is not None:
        state.frame_position[mask, frame] = position[mask]
    if rotation is not None:
        state.frame_rotation[mask, frame] = rotation[mask]
    index = int(layout.frame_body[frame])
    moved = np.arange(len(layout.frame_names)) == frame
    nodes = slice(layout.node_start[index], layout.node_start[index + 1])
    if frame == index:
        _carry_grips(state, layout, index, mask, before)
        moved = layout.frame_body == index
    elif isinstance(body, AffineBody):
        turned = np.einsum("bij,nj->bni", rotation_matrix(state.frame_rotation[:, frame]), layout.aim_local[nodes])
        state.y[mask, nodes] = (turned + state.frame_position[:, frame, None])[mask]
    state.velocity[mask, nodes] = 0.0
    touched = (state.stuck[..., 0] >= 0) & (layout.pairs[state.stuck[..., 4]] == index).any(axis=-1)
    state.stuck[mask[:, None] & touched] = -1
    return moved


def _carry_grips(state: State, layout: Layout, body: int, mask: NDArray[np.bool_], before: tuple[Floats, Floats]) -> None:
    """Move grips along with the frame of their body."""
    turn = rotation_matrix(state.frame_rotation[:, body]) @ np.swapaxes(before[0][:, body], -1, -2)
    for grip in np.flatnonzero((layout.frame_body == body) & (layout.frame_moves == 1)):
        if grip == body:
            continue
        arm = np.einsum("bij,bj->bi", turn, before[1][:, grip] - before[1][:, body])
        state.frame_position[mask, grip] = (state.frame_position[:, body] + arm)[mask]
        state.frame_rotation[mask, grip] = _quaternions(turn @ before[0][:, grip])[mask]


def _quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (..., 4) of rotation matrices, eigenvectors of Bar-Itzhack's matrix."""
    m = np.moveaxis(rotations, (-2, -1), (0, 1))
    zero = m[0, 0] * 0
    rows = [
        [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
    ]
    matrix = np.stack([np.stack([zero + e for e in row], axis=-1) for row in rows], axis=-2)
    return np.linalg.eigh(matrix)[1][..., -1]


def per_env(values: ArrayLike, shape: tuple[int, ...], what: str, num_envs: int) -> NDArray:
    """Finite values (B, \\*shape), given for all environments or for each."""
    array = np.asarray(values, dtype=float)
    if array.shape not in (shape, (num_envs, *shape)):
        raise IpcError(f"{what} has shape {array.shape}: it must be {shape} or {(num_envs, *shape)}")
    if not np.isfinite(array).all():
        raise IpcError(f"{what} = {array}: it must be finite")
    return np.broadcast_to(array, (num_envs, *shape))


def unit_pose(position: ArrayLike | None, rotation: ArrayLike | None, num_envs: int) -> tuple[Floats | None, Floats | None]:
    """Position (B, 3) and unit quaternion (w, x, y, z) (B, 4), where given."""
    p = None if position is None else per_env(position, (3,), "position", num_envs)
    if rotation is None:
        return p, None
    q = per_env(rotation, (4,), "rotation", num_envs)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.allclose(length, 1, atol=1e-6):
        raise IpcError(f"rotation = {rotation}: a quaternion (w, x, y, z) must have length 1")
    return p, q / length


def env_mask(envs: ArrayLike | None, num_envs: int) -> NDArray[np.bool_]:
    """A mask (B,) from a mask, a list of environments, or None for all."""
    if envs is None:
        return np.ones(num_envs, bool)
    chosen = np.asarray(envs)
    if chosen.dtype == bool:
        if chosen.shape != (num_envs,):
            raise IpcError(f"envs is a mask of shape {chosen.shape}: it must be ({num_envs},)")
        return chosen.copy()
    if chosen.size and not np.issubdtype(chosen.dtype, np.integer):
        raise IpcError(f"envs = {envs}: give a mask or whole numbers")
    if chosen.size and (chosen.min() < 0 or chosen.max() >= num_envs):
        raise IpcError(f"envs names environments {chosen.min()} to {chosen.max()}: there are {num_envs}")
    mask = np.zeros(num_envs, bool)
    mask[chosen.astype(int)] = True
    return mask
