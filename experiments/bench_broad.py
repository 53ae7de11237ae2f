"""How long does the solver's broad phase take, by lists and by hierarchies? One search anew of everything, no step around it.

    python experiments/bench_broad.py --out runs/bench_broad                                 # CPU or CUDA, whichever there is
    python experiments/bench_broad.py --device cuda --envs 1,128 --out runs/bench_broad_cuda

Five scenes: ``press``, the pad of ``bench_ipc`` and its sphere, sunk in by 0.5 mm; ``plate``, the pad and another one that lies flat on
it; ``mat``, a thin sheet twisted by two turns that may touch itself; ``heap``, spheres of 42 vertices side by side, every one free;
``peg``, the two pads, the peg and the hole of ``bench_ipc``.

Both ways must find as many pairs. On CUDA a search is recorded as a graph, as it is in a step, and the clock is read; on the CPU, where
kernels run in one thread, the processor's time is.

Keys: ``DEVICE.SCENE.EDGES[xENVS].lists_ms``, ``.bvh_ms``, ``.bvh_speedup``, ``.pairs``; with more than one environment also
``.one_lists_ms`` and ``.one_bvh_ms``, of a search that only one of them needs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from bench_ipc_scenes import D_HAT, GAP, MATERIAL, RADIUS, SIZE, THICKNESS, ball_surface, peg_world
from numpy.typing import NDArray

import ipc
from experiments.running import recorded, run
from ipc.bodies import Layout, build_layout, rotation_matrix
from ipc.contact import Collision
from ipc.meshes import surface_of
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, parse_names

WAYS = ("lists", "bvh")
SUNK = 0.5e-3
"""Depth of the sphere in the undeformed pad [m]: boxes do not mind."""
TURNS = 2.0
REPEATS = 200
"""The most searches that one median is of."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Time the solver's broad phase by lists and by hierarchies."""

    scenes: str = "press,plate,mat,heap,peg"
    """Any of press, plate, mat, heap, peg, joined by commas."""
    most: int = 20000
    """Scenes of more edges are left out."""
    envs: str = "1"
    """Numbers of environments, joined by commas; more than one only up to 3000 edges."""
    seconds: float = 0.5
    """Each median is of as many searches as fit in this time [s], at least 3."""


Scene = tuple[Layout, NDArray[np.float64], float]
"""Bodies, positions of their vertices [m] (V, 3), and d̂ [m]."""


def press_scenes() -> Iterator[Scene]:
    for cells in ((3, 4, 1), (8, 10, 2), (16, 20, 3), (26, 32, 5), (40, 48, 8)):
        mesh = ipc.domed_pad(SIZE, THICKNESS, (math.inf, math.inf), cells, cut="alike")
        ball = ipc.KinematicBody("ball", ball_surface(), ipc.Pose((0, 0, RADIUS + GAP - SUNK)))
        layout = build_layout([ipc.SoftBody("pad", mesh, MATERIAL), ball], 0.0, {}, [])
        yield layout, layout.vert_local + layout.frame_pose[layout.vert_body, :3], D_HAT


def plate_scenes() -> Iterator[Scene]:
    for cells in ((2, 3, 1), (4, 5, 1), (8, 10, 2), (16, 20, 3), (26, 32, 5)):
        mesh = ipc.domed_pad(SIZE, THICKNESS, (math.inf, math.inf), cells, cut="alike")
        used, faces = np.unique(surface_of(mesh.tets), return_inverse=True)
        aside = 0.3 * SIZE[0] / cells[0]
        plate = ipc.KinematicBody(
            "plate", ipc.TriMesh(mesh.vertices[used], faces.reshape(-1, 3)), ipc.Pose((aside, aside, THICKNESS + GAP))
        )
        layout = build_layout([ipc.SoftBody("pad", mesh, MATERIAL), plate], 0.0, {}, [])
        yield layout, layout.vert_local + layout.frame_pose[layout.vert_body, :3], D_HAT


def mat_scenes() -> Iterator[Scene]:
    for n in (2, 3, 4, 6, 8, 12, 16, 24, 32, 40, 56):
        side, h = 1.0, 1.0 / n
        line = np.linspace(0.0, side, n + 1)
        mesh = ipc.box_mesh(line, line - side / 2, np.array([0.0, h]), cut="alike")
        layout = build_layout([ipc.SoftBody("mat", mesh, MATERIAL, self_contact=True)], 0.0, {}, [])
        angle = 2 * math.pi * TURNS * layout.vert_local[:, 0]
        c, s, (x, y, z) = np.cos(angle), np.sin(angle), layout.vert_local.T
        yield layout, np.stack([x, c * y - s * z, s * y + c * z], axis=1), 0.1 * h


def heap_scenes() -> Iterator[Scene]:
    radius, pitch = 0.5, 1.02
    for n in (1, 2, 3):
        grid = [(i, j, k) for i in range(n) for j in range(n) for k in range(2)]
        turn = np.random.default_rng(0).normal(size=(len(grid), 4))
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        bodies = [
            ipc.AffineBody(f"ball{b}", ipc.icosphere(radius, 1), pose=ipc.Pose(tuple(pitch * np.array(place)), tuple(turn[b])))
            for b, place in enumerate(grid)
        ]
        layout = build_layout(bodies, 0.0, {}, [])
        x = np.einsum("vij,vj->vi", rotation_matrix(turn)[layout.vert_body], layout.vert_local)
        yield layout, x + pitch * np.array(grid, float)[layout.vert_body], 0.03


def peg_scenes() -> Iterator[Scene]:
    world = peg_world(1, "cpu")
    yield world.layout, world._potential.x.numpy()[0], world.d_hat


SCENES: dict[str, Callable[[], Iterator[Scene]]] = {
    "press": press_scenes,
    "plate": plate_scenes,
    "mat": mat_scenes,
    "heap": heap_scenes,
    "peg": peg_scenes,
}


def median_time(once: Callable[[], object], clock: Callable[[], float], seconds: float) -> float:
    """Median of as many calls as fit in ``seconds``, at least three [s]."""
    once()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or (time.perf_counter() < end and len(times) < REPEATS):
        start = clock()
        once()
        times.append(clock() - start)
    return float(np.median(times))


def search(scene: Scene, way: str, envs: int, device: wp.Device, seconds: float) -> tuple[float, float, tuple[int, int]]:
    """Median time of a search for all environments and for one [s], and the pairs of one: point-triangle and edge-edge."""
    layout, positions, d_hat = scene
    collision = Collision(layout, envs, d_hat, d_hat, False, device, way)
    x = wp.array(np.broadcast_to(positions, (envs, *positions.shape)), dtype=wp.vec3d, device=device)
    still, everyone = wp.zeros_like(x), wp.ones(envs, dtype=wp.int32, device=device)
    collision.refresh(x, still, everyone)
    if collision.overflow.numpy()[0]:
        collision.grow()
        collision.refresh(x, still, everyone)
    graph: wp.Graph | None = None
    if device.is_cuda:
        with wp.ScopedCapture(device=device) as capture:
            collision._rebuild(x, still)
        graph = capture.graph

    def once() -> None:
        if graph is None:
            collision._rebuild(x, still)
        else:
            wp.capture_launch(graph)
            wp.synchronize_device(device)

    clock = time.perf_counter if device.is_cuda else time.process_time
    candidates = collision.candidates
    found = int(candidates.pt_count.numpy()[0]), int(candidates.ee_count.numpy()[0])
    collision._stale.fill_(1)
    whole = median_time(once, clock, seconds)
    if envs == 1:
        return whole, whole, found
    collision._stale[1:].zero_()
    return whole, median_time(once, clock, seconds), found


def main(args: Args) -> None:
    names = parse_names(args.scenes, "scenes", tuple(SCENES))
    counts = parse_names(args.envs, "envs")
    if not all(count.isdecimal() and int(count) > 0 for count in counts):
        raise InputError("envs", value=args.envs, rule="must be whole numbers from 1, joined by commas")
    if not args.seconds > 0:
        raise InputError("seconds", value=args.seconds, rule="must be positive")
    ipc.start_warp()
    device = wp.get_device({"auto": "cuda" if wp.is_cuda_available() else "cpu"}.get(args.device, args.device))
    kind = "cuda" if device.is_cuda else "cpu"
    with recorded(args, "bench_broad", device=str(device), owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
        print(f"{'scene':24} {'body pairs':>10} {'vertices':>8} {'pairs':>8} {'lists':>10} {'bvh':>10} {'lists/bvh':>9}")
        for name in names:
            for scene in SCENES[name]():
                layout = scene[0]
                edges = len(layout.edges)
                for envs in map(int, counts):
                    if edges > args.most or (envs > 1 and edges > 3000):
                        continue
                    key = f"{kind}.{name}.{edges}" + (f"x{envs}" if envs > 1 else "")
                    (by_lists, one_lists, pairs), (by_bvh, one_bvh, same) = (
                        search(scene, way, envs, device, args.seconds) for way in WAYS
                    )
                    if pairs != same:
                        raise RaytacError(f"{key}: lists found {pairs} pairs, hierarchies {same}")
                    metrics |= {
                        f"{key}.lists_ms": 1e3 * by_lists,
                        f"{key}.bvh_ms": 1e3 * by_bvh,
                        f"{key}.bvh_speedup": by_lists / by_bvh,
                        f"{key}.pairs": sum(pairs),
                        f"{key}.body_pairs": len(layout.pairs),
                    }
                    if envs > 1:
                        metrics |= {f"{key}.one_lists_ms": 1e3 * one_lists, f"{key}.one_bvh_ms": 1e3 * one_bvh}
                    print(
                        f"{key:24} {len(layout.pairs):10d} {len(layout.vert_body):8d} {sum(pairs):8d} "
                        f"{1e3 * by_lists:7.3f} ms {1e3 * by_bvh:7.3f} ms {by_lists / by_bvh:9.2f}"
                        + (f"   of one: {1e3 * one_lists:7.3f} ms {1e3 * one_bvh:7.3f} ms" if envs > 1 else ""),
                        flush=True,
                    )


if __name__ == "__main__":
    run(main, Args)
