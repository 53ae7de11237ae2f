"""The scenes that the solver's benchmarks share: a sphere on a pad, and two pads that put a peg into a hole."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import ipc

__all__ = [
    "CELLS",
    "DT",
    "D_HAT",
    "FRICTION",
    "GAP",
    "HOLD",
    "MATERIAL",
    "PEG_DT",
    "PEG_SIDE",
    "PRESS",
    "RADIUS",
    "SIZE",
    "THICKNESS",
    "TRAVEL",
    "ball_height",
    "ball_surface",
    "peg_drive",
    "peg_world",
    "press_pad",
    "press_world",
    "square_hole",
]

SIZE, THICKNESS = (20.75e-3, 25.25e-3), 4e-3
"""The pad of the press [m]: that of a GelSight Mini."""
CELLS = {300: (8, 10, 2), 1400: (16, 20, 3), 5300: (26, 32, 5), 18000: (40, 48, 8)}
"""Cells in x, y and z by about how many vertices: 297, 1,428, 5,346 and 18,081."""
MATERIAL = ipc.Material(young=1e5, poisson=0.45, density=1000.0)
RADIUS, GAP, TRAVEL = 4e-3, 1.1e-4, 1e-3
"""The sphere, its distance from the pad at the start, and how far it is driven down [m]."""
PRESS, HOLD, DT, D_HAT, FRICTION = 20, 5, 0.01, 1e-4, 0.5
"""Steps down, steps at rest, time step [s], d̂ [m] and μ."""


def press_pad(cells: tuple[int, int, int], cut: ipc.Cut) -> tuple[ipc.TetMesh, NDArray[np.int64]]:
    """The flat pad and its bonded vertices: those of the base.

    Args:
        cells: in x, y and z.
        cut: how a cell is cut into tetrahedra, see ``ipc.box_mesh``.
    """
    mesh = ipc.domed_pad(SIZE, THICKNESS, (math.inf, math.inf), cells, cut=cut)
    return mesh, ipc.vertices_in_box(mesh, (-1, -1, -THICKNESS), (1, 1, -THICKNESS))


def ball_surface() -> ipc.TriMesh:
    """The sphere: 642 vertices, 1,280 triangles."""
    return ipc.icosphere(RADIUS, 3)


def ball_height(step: int) -> float:
    """Height of the sphere's centre [m] at the end of step 0, 1, …: down for ``PRESS`` steps, then at rest."""
    return RADIUS + GAP - TRAVEL * min(step + 1, PRESS) / PRESS


def press_world(cells: tuple[int, int, int], settings: ipc.Settings, num_envs: int, device: str, cut: ipc.Cut) -> ipc.World:
    """The pad and, above it, the sphere."""
    mesh, base = press_pad(cells, cut)
    pad = ipc.SoftBody("pad", mesh, MATERIAL, bonded=base)
    ball = ipc.KinematicBody("ball", ball_surface(), ipc.Pose((0, 0, RADIUS + GAP)))
    return ipc.World([pad, ball], settings, num_envs=num_envs, device=device)


# --- peg -----------------------------------------------------------------------------------------------------------------------

PEG_DT = 0.02
PEG_SIDE, PEG_LENGTH = 10e-3, 40e-3
"""The peg is a square prism [m]."""
PEG_CLEARANCE, PEG_CHAMFER, PEG_OFFSET = 0.25e-3, 1e-3, 0.4e-3
"""Gap between a centred peg and each wall of the hole, chamfer of the hole's rim, and how far the peg starts off the hole's axis [m]:
more than the clearance, so that it meets the chamfer and the gel must give way."""
PEG_PAD, PEG_THICKNESS, PEG_CELLS = (20e-3, 16e-3), 4e-3, (6, 4, 3)
PEG_GRIP = 0.6e-3
"""Indentation of each pad by the peg [m]."""
PEG_ABOVE = 2e-3
"""Height of the peg's lower end above the block at the start [m]."""
PEG_CLOSE, PEG_LOWER, PEG_SPEED = 6, 24, 0.02
"""Steps to close the grip, steps down, and the speed of those [m/s]."""
GRAVITY = 9.81


def square_hole(half: float, chamfer: float, depth: float, outer: float) -> ipc.TriMesh:
    """A square block with its top at z = 0 and a square hole right through it, chamfered at 45° above; all lengths in [m].

    Args:
        half: half the hole's width.
        chamfer: height and width of the chamfer.
        depth: height of the block.
        outer: half the block's width.
    """
    profile = [(outer, 0.0), (half + chamfer, 0.0), (half, -chamfer), (half, -depth), (outer, -depth)]
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], float)
    vertices = np.array([(*(w * c), z) for w, z in profile for c in corners])
    faces = []
    for ring in range(len(profile)):
        a, b = 4 * ring, 4 * ((ring + 1) % len(profile))
        for side in range(4):
            after = (side + 1) % 4
            faces += [(a + side, b + side, b + after), (a + side, b + after, a + after)]
    return ipc.TriMesh(vertices, np.array(faces)[:, ::-1])


def _pad_poses() -> tuple[ipc.Pose, ipc.Pose]:
    """Pads left (towards +x) and right of the peg; a pad's own x points along world z, so that its long side stands upright."""
    half, r = PEG_SIDE / 2 + GAP, math.sqrt(0.5)
    # About y by 90°: z → x, x → −z. About y by −90°: z → −x, x → z.
    return ipc.Pose((-half, 0.0, 0.0), (r, 0.0, r, 0.0)), ipc.Pose((half, 0.0, 0.0), (r, 0.0, -r, 0.0))


def peg_world(num_envs: int, device: str, graph: bool = True) -> ipc.World:
    """Two pads of 140 vertices, a free peg between them and, below it, a block with a hole that is off the peg's axis.

    As in the peg scene of Taccel (two pads of 139 vertices and an affine peg; h = 20 ms, d̂ = 0.1 mm, tolerance 1e-3 m/s; at most 20
    Newton and 40 PCG iterations, where here every step converges); meshes and motion are ours. the elastic slip is what
    the velocity tolerance leaves open in a step: friction that is resolved finer than the rest is stiff for nothing.
    """
    tolerance = 1e-3
    settings = ipc.Settings(
        dt=PEG_DT,
        d_hat=D_HAT,
        friction=FRICTION,
        velocity_tolerance=tolerance,
        friction_slip=tolerance * PEG_DT,
        graph=graph,
    )
    mesh = ipc.domed_pad(PEG_PAD, PEG_THICKNESS, (math.inf, math.inf), PEG_CELLS, cut="alike")
    base = ipc.vertices_in_box(mesh, (-1, -1, -PEG_THICKNESS), (1, 1, -PEG_THICKNESS))
    left, right = _pad_poses()
    peg = ipc.box_surface((PEG_SIDE, PEG_SIDE, PEG_LENGTH))
    hole = square_hole(PEG_SIDE / 2 + PEG_CLEARANCE, PEG_CHAMFER, 15e-3, 15e-3)
    below = -PEG_LENGTH / 2 - PEG_ABOVE
    bodies = [
        ipc.SoftBody("left", mesh, MATERIAL, bonded=base, pose=left),
        ipc.SoftBody("right", mesh, MATERIAL, bonded=base, pose=right),
        ipc.AffineBody("peg", peg),
        ipc.KinematicBody("hole", hole, ipc.Pose((0.3 * PEG_OFFSET, PEG_OFFSET, below))),
    ]
    return ipc.World(bodies, settings, num_envs=num_envs, device=device, ignored=[("left", "right")])


def peg_drive(world: ipc.World) -> Iterator[str]:
    """Say where the pads go, step by step: ``"close"`` while the grip closes (without weight), then ``"lower"`` with gravity on."""
    for step in range(PEG_CLOSE + PEG_LOWER):
        closed = min(step + 1, PEG_CLOSE) / PEG_CLOSE
        down = PEG_SPEED * PEG_DT * max(0, step + 1 - PEG_CLOSE)
        x = PEG_SIDE / 2 + GAP - (GAP + PEG_GRIP) * closed
        world.set_target("left", (-x, 0.0, -down))
        world.set_target("right", (x, 0.0, -down))
        if step == PEG_CLOSE:
            world.set_gravity((0.0, 0.0, -GRAVITY))
        yield "close" if step < PEG_CLOSE else "lower"
