"""Does the rigid pad's load law carry contacts of any shape? Its force against an elastic layer's, for one piece and for many.

    python experiments/load_law.py --out runs/load_law        # some minutes on two cores
    python experiments/load_law.py --quick --out runs/load_law_quick

Flat faces, balls, wavy faces and the shipped press objects are pressed into a linear elastic layer bonded at its back, without friction
(``tests/gel/layer_contact.py``). ``<shape>.<depth>.layer_n`` is its force, and the others are how far laws are off, as shares of it:

- ``area``: every region is a disc of its area;
- ``parts``: every part of a region is a disc of its area on a layer of its own, so that parts do not feel each other;
- ``law``: by area, perimeter and second moments of the region (``LoadLaw``);
- ``world``: the same in the contact search of worlds, for objects that are bodies.

``figure.png`` shows them, and the force of a punch that is cut into quarters and of two balls, over their distance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import label

from experiments.running import recorded, run
from raytac import quiet_warp
from raytac.gel import make_grid
from raytac.io import CommonOptions, Progress
from raytac.physics import LoadLaw, PadSearch, first_touch, object_parts
from raytac.se3 import rotations
from raytac.shapes import Part, object_height
from raytac.specs import load_press, load_sensor
from tests.gel.layer_contact import ABSENT, Layer
from tests.ipc.oracles.closed_forms import BondedLayer, Elastic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MM = 1e-3
GEL = load_sensor("gelsight_mini").gelpad
WIDE = replace(GEL, size=(38e-3, 38e-3), dome_radius=(np.inf, np.inf))
"""Its gel without an edge near the shapes."""
MODULUS = GEL.youngs_modulus / (1.0 - GEL.poisson_ratio**2)
LEVELS = 64
"""Levels of the gap below which regions are tried for the two simple laws."""
Gap = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Gap at first touch [m] at x and y [m]; inf where there is no object."""
SHIPPED = {
    "sphere": (0.2, 0.8),
    "cylinder": (0.1, 0.3, 0.7),
    "edge": (0.2, 0.8),
    "cone": (0.3, 1.0),
    "torus": (0.1, 0.3, 0.7),
    "pins": (0.2, 0.8),
    "coin": (0.1, 0.2, 0.4, 0.7),
    "mesh": (0.1, 0.3, 0.6, 0.9),
}
"""Press scenes and depths [mm]; the last is that of the scene."""
CUTS, DISTANCES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0), (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
"""Gaps between the quarters of a punch, and distances of two balls [mm]."""
QUICK = "disc_4", "pins_4", "quarters_0", "quarters_4", "balls_2_12", "sphere"
"""Shapes of a quick run."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Press shapes into a layer and ask the load laws."""

    pitch_mm: float = 0.05
    """Spacing of the nodes [mm]."""
    quick: bool = False
    """A few shapes on coarse nodes: enough to see that all works."""


def faces(*boxes: tuple[float, float, float, float], slope: float = 0.0) -> Gap:
    """Flat rectangles: middle and half sides [mm], off the nodes' lines, level or tilted along x."""

    def gap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        on = np.any(
            [(np.abs(x - (a + 0.011) * MM) < p * MM) & (np.abs(y - (b + 0.011) * MM) < q * MM) for a, b, p, q in boxes], axis=0
        )
        return np.where(on, slope * (x - min(a - p for a, _, p, _ in boxes) * MM), np.inf)

    return gap


def discs(places: Sequence[tuple[float, float]], radius: float, hole: float = 0.0) -> Gap:
    """Flat discs or rings about places [mm]."""

    def gap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        far = [np.hypot(x - (a + 0.011) * MM, y - (b + 0.017) * MM) for a, b in places]
        return np.where(np.any([(r < radius * MM) & (r >= hole * MM) for r in far], axis=0), 0.0, np.inf)

    return gap


def balls(places: Sequence[tuple[float, float]], radius: float) -> Gap:
    def gap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        squares = [(radius * MM) ** 2 - (x - a * MM) ** 2 - (y - b * MM) ** 2 for a, b in places]
        return np.min([np.where(s > 0.0, radius * MM - np.sqrt(np.maximum(s, 0.0)), np.inf) for s in squares], axis=0)

    return gap


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A square face with waves of 2 mm, 0.2 mm high."""
    crests = 0.1 * MM * (1.0 + np.cos(np.pi * x / MM) * np.cos(np.pi * y / MM))
    return np.where((np.abs(x) < 5 * MM) & (np.abs(y) < 5 * MM), crests, np.inf)


def holed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A square plate with 16 holes of 1.6 mm."""
    holes = np.isfinite(discs(square(4, 2.5), 0.8)(x, y))
    return np.where((np.abs(x) < 5 * MM) & (np.abs(y) < 5 * MM) & ~holes, 0.0, np.inf)


def square(count: int, pitch: float) -> list[tuple[float, float]]:
    """Places of count × count things about the origin [mm]."""
    line = (np.arange(count) - 0.5 * (count - 1)) * pitch
    return [(a, b) for a in line.tolist() for b in line.tolist()]


def quarters(cut: float) -> Gap:
    at = 1.0 + 0.5 * cut
    return faces(*((a, b, 1.0, 1.0) for a in (-at, at) for b in (-at, at)))


def shapes() -> dict[str, tuple[Gap, tuple[float, ...]]]:
    """Shapes other than the shipped objects, and depths [mm]."""
    flat = {
        "disc_1": discs([(0, 0)], 1.0),
        "disc_4": discs([(0, 0)], 4.0),
        "square_4": faces((0, 0, 2, 2)),
        "square_12": faces((0, 0, 6, 6)),
        "strip_12_0.5": faces((0, 0, 6, 0.25)),
        "strip_12_2": faces((0, 0, 6, 1)),
        "ring_2_0.5": discs([(0, 0)], 2.25, 1.75),
        "ring_4_0.5": discs([(0, 0)], 4.25, 3.75),
        "ring_4_2": discs([(0, 0)], 5.0, 3.0),
        "cross": faces((0, 0, 5, 0.5), (0, 0, 0.5, 5)),
        "holed_plate": holed,
        **{f"pins_{n * n}": discs(square(n, 3.0), 0.5) for n in (1, 2, 3, 5)},
        "pins_25_close": discs(square(5, 1.5), 0.5),
        "pins_25_thin": discs(square(5, 3.0), 0.25),
        **{f"quarters_{cut:g}": quarters(cut) for cut in CUTS},
    }
    others = {
        **{f"balls_2_{d:g}": (balls([(-0.5 * d, 0), (0.5 * d, 0)], 3.155), (0.1, 0.5)) for d in DISTANCES},
        "balls_9": (balls(square(3, 2.5), 1.5), (0.1, 0.6)),
        "balls_25": (balls(square(5, 3.0), 1.0), (0.1, 0.6)),
        "tilted_strip": (faces((0, 0, 5, 1), slope=0.02), (0.3,)),
        "waves": (waves, (0.1, 0.3)),
        "ball_and_pins": (
            lambda x, y: np.minimum(balls([(-4, 0)], 4.0)(x, y), discs([(4, -3), (4, 0), (4, 3)], 0.4)(x, y)),
            (0.2, 0.5),
        ),
    }
    return {name: (gap, (0.3,)) for name, gap in flat.items()} | others


def placed(name: str) -> tuple[Sequence[Part], np.ndarray]:
    """Parts of a shipped object, and its pose at first touch of the Mini's gel."""
    scene = load_press(name).object
    parts, pose = object_parts(scene), np.eye(4)
    w, *axis = scene.quaternion
    length = float(np.linalg.norm(axis))
    if length > 0.0:
        pose[:3, :3] = rotations(2.0 * np.arctan2(length, w) / length * np.array([axis]))[0]
    pose[:2, 3] = scene.position[:2]
    pose[2, 3] = first_touch(parts, pose, GEL, make_grid(GEL, 0.05 * MM)).z
    return parts, pose


def simple_laws(gap: np.ndarray, pitch: float, depths: np.ndarray) -> dict[str, np.ndarray]:
    """Forces [N] of the laws ``area`` and ``parts``: greatest k (δ − ⟨gap⟩) of regions below a level.

    The mean is under the pressure of a half-space's punch, by the rank of the gap: 2 x over its mean.
    """
    disc = BondedLayer(Elastic(GEL.youngs_modulus, GEL.poisson_ratio), GEL.thickness)
    radii = np.linspace(0.02, 13.0, 200) * MM
    stiffness = np.array([float(disc.punch_force(a, 1.0)) for a in radii])
    forces, before = {name: np.zeros(len(depths)) for name in ("area", "parts")}, 0
    j, i = np.nonzero(gap < depths.max())
    gap = gap[j.min() : j.max() + 1, i.min() : i.max() + 1]
    pieces = np.zeros(gap.shape, int)
    for level in depths.max() * (np.arange(1, LEVELS + 1) / LEVELS) ** 2:
        on = gap < level
        under = np.sort(gap[on])
        if len(under) == before:
            continue
        before = len(under)
        mean = float((under * (2.0 * np.arange(len(under)) + 1.0)).sum()) / len(under) ** 2
        label(on, np.ones((3, 3)), output=pieces)
        for name, counts in (("area", np.array([before])), ("parts", np.bincount(pieces.ravel())[1:])):
            k = np.interp(np.sqrt(counts / np.pi) * pitch, radii, stiffness).sum()
            forces[name] = np.maximum(forces[name], k * (depths - mean))
    return forces


def world_forces(parts: Sequence[Part], pose: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Forces [N] that a world's contacts have at depths [m] beyond a pose."""
    poses = np.tile(pose, (len(depths), 1, 1))
    poses[:, 2, 3] -= depths
    contacts = PadSearch([GEL], [parts], num_envs=len(depths)).contacts(poses[:, None, None], np.arange(len(depths)), 0.1 * MM)
    at = contacts.deepest[:, None] * np.linspace(0.0, 1.0, contacts.force.shape[1]) ** 2
    return np.array([np.interp(*row) for row in zip(contacts.depth, at, contacts.force, strict=True)])


def main(args: Args) -> None:
    quiet_warp()
    pitch = (0.2 if args.quick else args.pitch_mm) * MM
    layer = Layer(2 * round(19.2 * MM / pitch), 38.4 * MM, GEL.thickness, GEL.poisson_ratio)
    line, others, shipped = layer.lines, shapes(), SHIPPED
    if args.quick:
        others, shipped = ({name: all_of[name] for name in QUICK if name in all_of} for all_of in (others, shipped))
    with recorded(args, "load_law", device="cpu", owned=("figure.png",)) as (folder, metrics):
        rows: dict[str, dict[str, float]] = {}
        cases = [*((name, depths) for name, (_, depths) in others.items()), *shipped.items()]
        for name, depths_mm in Progress(cases, desc="shapes"):
            depths, laws = np.array(depths_mm) * MM, {}
            if name in shipped:
                parts, pose = placed(name)
                rest = -GEL.sag(line[None, :], line[:, None])
                gap = np.maximum(object_height(parts, pose[None], line, line)[0] - rest, 0.0)
                laws["world"] = world_forces(parts, pose, depths)
            else:
                gap = others[name][0](line[None, :], line[:, None])
            law = LoadLaw(gap, line, line, WIDE)
            laws |= simple_laws(gap, layer.pitch, depths) | {"law": np.array([law.force(d) for d in depths])}
            for k, depth in enumerate(depths):
                pressure, _ = layer.press(np.where(np.isfinite(gap), depth - gap, ABSENT), 2e-4)
                force = float(pressure.sum()) * layer.pitch**2 * MODULUS
                rows[f"{name}.{depths_mm[k]:g}"] = {"layer_n": force} | {
                    kind: float(values[k]) / force - 1.0 for kind, values in laws.items()
                }
        for case, row in rows.items():
            metrics |= {f"{case}.{kind}": value for kind, value in row.items()}
            print(
                f"{case:20} {row['layer_n']:8.3f} N  "
                + "  ".join(f"{k} {100 * v:+5.1f} %" for k, v in row.items() if k != "layer_n")
            )
        for kind in ("area", "parts", "law"):
            errors = np.array([row[kind] for row in rows.values()])
            metrics |= {f"{kind}.rms": float(np.sqrt((errors**2).mean())), f"{kind}.worst": float(np.abs(errors).max())}
        figure(rows).savefig(folder / "figure.png", dpi=110)


def figure(rows: dict[str, dict[str, float]]) -> Figure:
    """Errors of the laws, and forces over the distance of parts."""
    import matplotlib.figure

    sheet = matplotlib.figure.Figure(figsize=(10.5, 4.2), layout="constrained")
    left, middle, right = sheet.subplots(1, 3, width_ratios=[1.5, 1.0, 1.0])
    names = [case for case in rows if case.partition(".")[0] in SHIPPED]
    for kind, colour in (("area", "#b0b0b0"), ("parts", "#e0a030"), ("law", "#2060a0"), ("world", "#60b0d0")):
        left.plot([100.0 * rows[case][kind] for case in names], range(len(names)), "o", color=colour, label=kind, markersize=4)
    left.set_yticks(range(len(names)), [case.replace(".", " ", 1) + " mm" for case in names], fontsize=7)
    left.set(xlabel="force, off the layer's [%]", xlim=(-80, 40))
    left.axvline(0.0, color="k", linewidth=0.6, label="layer")
    left.invert_yaxis()
    left.legend(fontsize=7, loc="lower left")
    for axis, stem, places, depth, title in (
        (middle, "quarters", CUTS, "0.3", "quarters of a 4 mm punch, 0.3 mm"),
        (right, "balls_2", DISTANCES, "0.5", "two balls of 3.155 mm, 0.5 mm"),
    ):
        cases = [(place, rows[f"{stem}_{place:g}.{depth}"]) for place in places if f"{stem}_{place:g}.{depth}" in rows]
        at, truth = [place for place, _ in cases], np.array([row["layer_n"] for _, row in cases])
        axis.plot(at, truth, "k-", label="layer")
        for kind, colour in (("area", "#b0b0b0"), ("parts", "#e0a030"), ("law", "#2060a0")):
            axis.plot(at, truth * [1.0 + row[kind] for _, row in cases], "o", color=colour, label=kind, markersize=4)
        axis.set(xlabel="gap [mm]" if stem == "quarters" else "distance [mm]", ylabel="force [N]", ylim=(0.0, None))
        axis.set_title(title, fontsize=8)
    return sheet


if __name__ == "__main__":
    run(main, Args)
