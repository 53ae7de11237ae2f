"""Cost of the search for contacts of resting pads: the Warp kernels and the NumPy reference in turn, medians of many calls.

One process, one core; every number is of one ``contacts`` call, or of ``PadOverlap.touches`` and ``LoadLaw`` for the same poses.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import recorded, run
from raytac.io import CommonOptions
from raytac.physics import PadSearch
from raytac.se3 import rotations
from raytac.shapes import Part, mesh_part, object_radius, primitive
from raytac.specs import load_sensor
from tests.physics.rigid.oracle import PadOverlap

REACH = 0.1e-3
"""Gaps up to this are reported [m]."""


@dataclass(frozen=True)
class Args(CommonOptions):
    """Options; ``--device`` is the kernels', the reference runs on the CPU."""

    envs: tuple[int, ...] = (1, 16, 64)
    """Environments."""
    calls: int = 200
    """Calls of each, in turn."""


def bodies() -> dict[str, tuple[Part, float]]:
    """Shapes and how deep they are pressed [m]."""
    import trimesh

    ball = trimesh.creation.icosphere(4, 6e-3)
    return {
        "cube": (primitive("box", (10e-3, 10e-3, 10e-3)), 0.1e-3),
        "cube_edge": (primitive("box", (10e-3, 10e-3, 10e-3)), 0.5e-3),
        "ball": (primitive("sphere", (6e-3,)), 0.3e-3),
        "mesh_5120": (mesh_part(ball.vertices, ball.faces), 0.3e-3),
        "apart": (primitive("sphere", (6e-3,)), -5e-3),
    }


def poses_of(name: str, depth: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Poses (count, 4, 4) about the pad's centre, each a little different."""
    turn = rng.normal(0.0, 0.003, (count, 3))
    if name == "cube_edge":
        turn[:, 0] += 0.4
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations(turn)
    poses[:, :2, 3] = rng.uniform(-1e-3, 1e-3, (count, 2))
    lowest = 6e-3 * np.ones(count) if "cube" not in name else np.abs(poses[:, 2, :3]).sum(axis=1) * 10e-3
    poses[:, 2, 3] = lowest - depth
    return poses


def medians(calls: int, *functions: Callable[[], object]) -> list[float]:
    """Median time of each [s], called in turn."""
    times = np.zeros((len(functions), calls))
    for function in functions:
        function()
    for k in range(calls):
        for i, function in enumerate(functions):
            start = time.perf_counter()
            function()
            times[i, k] = time.perf_counter() - start
    return np.median(times, axis=1).tolist()


def main(args: Args) -> None:
    gelpad = load_sensor("gelsight_mini").gelpad
    overlap, rng = PadOverlap(gelpad), np.random.default_rng(args.seed)
    with recorded(args, "bench_pad_contact", out=args.out or Path("runs/bench_pad_contact")) as (_, metrics):
        device = str(metrics["device"])
        for name, (part, depth) in bodies().items():
            radius = object_radius([part])
            for count in args.envs:
                poses, envs = poses_of(name, depth, count, rng), np.arange(count)
                search = PadSearch([gelpad], [[part]], num_envs=count, device=device)
                shaped = poses[:, None, None]

                def reference(poses: np.ndarray = poses, part: Part = part, radius: float = radius) -> None:
                    touches = overlap.touches([part], poses, radius)
                    for k in range(len(touches.env)):
                        overlap.law(touches, k)

                def kernels(search: PadSearch = search, shaped: np.ndarray = shaped, envs: np.ndarray = envs) -> None:
                    search.contacts(shaped, envs, REACH)

                ours, numpy = medians(args.calls, kernels, reference)
                key = f"pad_contact.{name}.{count}"
                metrics |= {f"{key}.ms": 1e3 * ours, f"{key}.numpy_ms": 1e3 * numpy, f"{key}.speedup": numpy / ours}
                print(
                    f"{name:10} {count:5} environments: {1e3 * ours:8.3f} ms, NumPy {1e3 * numpy:8.3f} ms, {numpy / ours:.1f} times"
                )


if __name__ == "__main__":
    run(main, Args, __doc__)
