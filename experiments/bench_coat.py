"""How near is the shown coat to the truth around sharp features, on pads whose cells are far wider than they are?

    python experiments/bench_coat.py --out runs/bench_coat          # some minutes on two cores

An edge (the cube of the scene "edge", along x, 0.8 mm deep) and a bar 3 mm wide with sharp rims (0.5 mm deep) are pressed into the GelSight
Mini's pad. Both are the same all along x in the middle, so that a pad can be refined across y alone until nothing changes: the truth
is the vertices of such a mesh, with cells of ``--cell-um`` at the sharp line (nothing is interpolated or corrected), pressed until those
on the line x = 0 are at the depth.

``--shapes ball``: a ball (4 mm) pressed lightly, to 0.33 N and to 0.3 mm, and 0.5 mm deep and then sheared by 0.4 mm or twisted by 10°, and
what markers see of it. The truth is a pad with cells of four
times ``--cell-um`` in the middle, its solver's vertices; markers are 285 points on a grid of 1 mm that ride on the coat.
``ball.<load>.<level>.markers_um``, ``markers_most_um``: mean and greatest sideways distance of a marker from the truth;
``mesh_markers_um`` …: the same on the solver's vertices; ``force_n``, ``contact_mm2``; with ``truth`` for a level: its own motion.

``<shape>.<level>.near_um``, ``beyond_um``, ``far_um``: root mean square of the shown height less the truth, on the line x = 0, within 1 mm
of the edge or rim, 1 to 2 mm, 2 to 4 mm; ``mesh_near_um`` …: the same of the solver's vertices joined by straight lines, which is what
there was to see; ``force_n`` of each, and ``truth_force_n``.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import ipc
from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.gel import CoatMesh
from raytac.io import CommonOptions, Metric, parse_names
from raytac.markers import bind_to_coat
from raytac.physics import PadLevel, PadMesh, SoftPad, pad_mesh
from raytac.shapes import object_height
from raytac.specs import PADS, ObjectSpec, PressScene, SensorSpec, StageSpec, load_sensor

SHAPES = {"edge": 0.0, "bar": 1.5e-3}
"""y of the sharp line [m]."""
BALL = "ball"
LOADS = {
    "force": (StageSpec("indent", force=0.33),),
    "depth": (StageSpec("indent", depth=0.3e-3),),
    "shear": (StageSpec("indent", depth=0.5e-3), StageSpec("shear", shear=(0.4e-3, 0.0))),
    "twist": (StageSpec("indent", depth=0.5e-3), StageSpec("twist", twist=np.deg2rad(10.0))),
}
RANGES = {"near": (0.02e-3, 1e-3), "beyond": (1e-3, 2e-3), "far": (2e-3, 4e-3)}
_DEEPER = 0.1e-3
"""Room for a truth to be pressed deeper than the scene says [m]."""
_BLOCKS = (2, 2, 1), 1.0
"""Volume blocks of a truth, without which it would lock, and the elements' own share, as of the medium level."""
_GROWTH, _DOWN = 0.14, 0.25
"""How much a cell grows for each unit of distance from the sharp line, across and downwards."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure the shown coat around an edge and a bar against a pad refined across."""

    levels: str = "coarse,medium"
    """Levels to measure, joined by commas."""
    shapes: str = ",".join(SHAPES)
    """Of edge, bar, ball."""
    cell_um: float = 60.0
    """Cells of the truth at the sharp line [µm]."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""

    def run(self) -> None:
        levels, shapes = parse_names(self.levels, "levels"), parse_names(self.shapes, "shapes")
        for value, name, choices in [(v, "levels", PADS) for v in levels] + [(v, "shapes", (*SHAPES, BALL)) for v in shapes]:
            if value not in choices:
                raise InputError(name, value=value, rule="must be known", choices=tuple(choices))
        spec = load_sensor(self.sensor)
        with recorded(self, "bench_coat", device="cpu", owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
            metrics["cell_um"] = self.cell_um
            if BALL in shapes:
                metrics |= marked(spec, levels, 4e-6 * self.cell_um)
            for shape in (shape for shape in shapes if shape != BALL):
                mesh = refined(spec, SHAPES[shape], self.cell_um * 1e-6)
                truth, metrics[f"{shape}.truth_force_n"], _ = pressed(spec, shape, mesh, as_truth=True)
                metrics[f"{shape}.truth_vertices"] = len(mesh.tets.vertices)
                for level in levels:
                    found, metrics[f"{shape}.{level}.force_n"], shown = pressed(spec, shape, pad_mesh(spec.gelpad, level))
                    for kind, section in (("", shown), ("mesh_", found)):
                        for name, (low, high) in RANGES.items():
                            at = SHAPES[shape] + np.linspace(low, high, 200)
                            off = np.interp(at, *section) - np.interp(at, *truth)
                            metrics[f"{shape}.{level}.{kind}{name}_um"] = 1e6 * float(np.sqrt((off**2).mean()))
        for key, value in metrics.items():
            if not key.startswith("versions"):
                print(f"{key} = {value:.5g}" if isinstance(value, float) else f"{key} = {value}")


Section = tuple[np.ndarray, np.ndarray]
"""y and z [m] along the line x = 0, y ascending."""


def pressed(spec: SensorSpec, shape: str, mesh: PadMesh, *, as_truth: bool = False) -> tuple[Section, float, Section]:
    """Vertices of the coat on x = 0, normal force [N], shown surface on x = 0.

    ``as_truth``: pressed until those vertices are at the depth. A press ends by the clearance of all the contact, which a truth refined
    across y alone has too wide at the ends of the object, where its cells along x are a millimetre long.
    """
    rows, columns = mesh.coat.shape
    with tempfile.TemporaryDirectory() as folder:
        wanted = scene(shape, Path(folder))
        (stage,) = wanted.trajectory
        assert stage.depth is not None
        deeper = replace(wanted, trajectory=(stage, replace(stage, depth=stage.depth + _DEEPER)))
        pad = SoftPad(spec, deeper, pitch=0.05e-3, level=mesh)
        state = next(state for state in pad.run() if state.stage == 0)
        assert pad.solver is not None

        def on_line(values: np.ndarray) -> np.ndarray:
            return values[0].reshape(rows, columns, 3)[:, columns // 2]

        if as_truth:
            line, load = on_line(state.solved.vertices), -on_line(state.solved.forces)[:, 2]
            even = np.linspace(-2e-3, 2e-3, 801)
            under = object_height(pad.parts, state.pad_from_object, np.array([-1e-5, 0.0, 1e-5]), even)[0, :, 1]
            under = np.interp(line[:, 1], even, under, left=np.inf, right=np.inf)
            there = np.isfinite(under) & (load > 0.0)
            short = float((load[there] * (line[there, 2] - under[there])).sum() / load[there].sum())
            (state,) = pad.follow(replace(stage, depth=stage.depth + short))
    line = on_line(state.solved.vertices)
    shown = state.surface.height[0][:, pad.grid.shape[1] // 2].astype(float)
    return (line[:, 1], line[:, 2]), float(state.normal_force[0]), (pad.grid.y, shown)


def marked(spec: SensorSpec, levels: tuple[str, ...], cell: float) -> dict[str, Metric]:
    """Markers under a ball that is pressed, sheared or twisted, off those of a pad with cells of ``cell`` [m] in the middle."""
    target = ObjectSpec("sphere", {"radius": 4e-3}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05)
    probes = np.stack(np.meshgrid(np.arange(-9, 10) * 1e-3, np.arange(-7, 8) * 1e-3), axis=-1).reshape(-1, 2)
    truth_mesh = pad_mesh(spec.gelpad, PadLevel(2.9 * cell, max(round(2.2e-3 / cell), 3), 7.0, 5.0, cell / 25.0, *_BLOCKS))
    metrics: dict[str, Metric] = {}
    for load, stages in LOADS.items():
        truth = np.zeros(0)
        for level in ("truth", *levels):
            mesh = truth_mesh if level == "truth" else pad_mesh(spec.gelpad, level)
            pad = SoftPad(spec, PressScene(BALL, target, stages), pitch=0.1e-3, level=mesh)
            state = pad.peak(pad.run())
            surface, reading = state.surface, state.solved
            assert surface.coat is not None
            vertices, weights = bind_to_coat(mesh.coat, probes)
            solver, shown = (
                (weights[..., None] * (at[0] - mesh.coat.rest)[vertices]).sum(axis=1)[:, :2]
                for at in (reading.vertices, surface.coat.positions)
            )
            start = f"{BALL}.{load}.{level}"
            if level == "truth":
                truth, pairs = solver, (("", np.zeros_like(solver)),)
                metrics[f"{start}.vertices"] = len(mesh.tets.vertices)
            else:
                pairs = (("", shown), ("mesh_", solver))
            for kind, found in pairs:
                off = 1e6 * np.linalg.norm(found - truth, axis=1)
                metrics[f"{start}.{kind}markers_um"], metrics[f"{start}.{kind}markers_most_um"] = (
                    float(off.mean()),
                    float(off.max()),
                )
            metrics[f"{start}.force_n"] = float(state.normal_force[0])
            metrics[f"{start}.contact_mm2"] = 1e6 * float(surface.contact.sum() * np.prod(surface.grid.pitch))
    return metrics


def scene(shape: str, folder: Path) -> PressScene:
    upright = (1.0, 0.0, 0.0, 0.0)
    if shape == "edge":
        spec = ObjectSpec("edge", {"side": 8e-3}, (0.0, 0.0, 0.0), upright, 0.05)
        return PressScene("edge", spec, (StageSpec("indent", depth=0.8e-3),))
    import trimesh

    bar = trimesh.creation.box((8e-3, 2.0 * SHAPES["bar"], 4e-3))
    bar.export(folder / "bar.stl")
    spec = ObjectSpec("mesh", {"path": str(folder / "bar.stl"), "scale": 1.0}, (0.0, 0.0, 0.0), upright, 0.05)
    return PressScene("bar", spec, (StageSpec("indent", depth=0.5e-3),))


def refined(spec: SensorSpec, sharp: float, cell: float) -> PadMesh:
    """The pad with cells of ``cell`` [m] across y at ``sharp`` [m] and under the face, wide ones along x."""
    gelpad = spec.gelpad
    half = 0.5 * gelpad.size[1]
    inwards, outwards = steps(cell, sharp, _GROWTH) if sharp else np.zeros(1), steps(cell, half - sharp, _GROWTH)
    right = np.concatenate([sharp - inwards[::-1], sharp + outwards[1:]])
    y = np.concatenate([-right[:0:-1], right])
    along = ipc.graded(0.5 * gelpad.size[0], 7, 2.5 ** (1 / 6))
    x = np.concatenate([-along[:0:-1], along])
    z = -steps(cell, gelpad.thickness, _DOWN)[::-1]
    tets = ipc.box_mesh(x, y, z, cut="mirrored")
    vertices = tets.vertices.copy()
    vertices[:, 2] -= gelpad.sag(vertices[:, 0], vertices[:, 1]) * (1.0 + vertices[:, 2] / gelpad.thickness)
    per_layer = len(x) * len(y)
    on_coat = np.arange(len(vertices) - per_layer, len(vertices))
    top = tets.tets[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    top = top[(top >= on_coat[0]).all(axis=1)]
    a, b, c = (vertices[top[:, k], :2] for k in range(3))
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    top[turned] = top[turned][:, ::-1]
    coat = CoatMesh(vertices[on_coat], (top - on_coat[0]).astype(np.int32), x, y)
    block, own = _BLOCKS
    blocks = ipc.grid_blocks((len(x) - 1, len(y) - 1, len(z) - 1), block)
    return PadMesh(ipc.TetMesh(vertices, tets.tets), coat, on_coat, np.arange(per_layer), cell / 8.0, blocks, own)


def steps(first: float, length: float, growth: float) -> np.ndarray:
    """0 to ``length`` in steps that start near ``first`` [m] and grow by ``growth`` times the way that is done."""
    at = [0.0]
    while at[-1] < length:
        at.append(at[-1] + first + growth * at[-1])
    return np.asarray(at) * (length / at[-1])


if __name__ == "__main__":
    run(Args.run, Args)
