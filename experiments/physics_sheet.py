"""What does each physics of the pad show? Every press scene under the rigid pad and under the simulated one, on one sheet.

    python experiments/physics_sheet.py --out runs/physics_sheet              # both pads, eight scenes: some minutes on two cores
    python experiments/physics_sheet.py --pad medium --out runs/physics_sheet_medium
    python experiments/physics_sheet.py --scenes sphere --against fine --out runs/sphere_against_fine   # the levels against a finer one

One row a scene at its peak stage: tactile images of the two, their indentation on one scale, and the second's height less the first's, on a
scale of its own. No scale cuts anything off.
``metrics.json``: ``<scene>.<physics>.`` ``imprint_mm`` (deepest), ``bulge_mm`` (highest above rest), ``force_n``, ``contact_mm2``,
``press_s``; and ``<scene>.contact_um``, ``ring_um``, ``image``: height of the soft pad less that of the rigid one, root mean square
where both touch and within 2 mm of that, and mean absolute difference of the images (of 255).

``--against LEVEL`` draws nothing and compares heights of every level below with that one: ``<scene>.<level>.`` ``contact_um`` (where both
touch: small by construction, since every level is laid on the object there), ``near_um`` and ``ring_um``: within 1 mm of the contact of
either, and 1 to 2 mm from it; ``force_n`` of all.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel import GelSurface
from raytac.io import CommonOptions, Metric, parse_names
from raytac.physics import Ipc
from raytac.sensor import TactileSensor
from raytac.specs import PADS, load_press

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENES = ("sphere", "cylinder", "edge", "cone", "torus", "pins", "coin", "mesh")
RING = 2e-3
STEP_MM = 0.05
"""A scale of height differences ends at a multiple of this."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Press scenes under both physics and draw them side by side."""

    scenes: str = ",".join(SCENES)
    """Names of shipped press scenes or paths of scene files, joined by commas."""
    pad: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = "coarse"
    """Level of the soft pad."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    against: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(PADS[1:]) + "}")] = ""
    """Compare the levels of the soft pad with this one instead of the two physics."""
    quick: bool = False
    """Small images of the first scene only: enough to see that all works."""

    def run(self) -> None:
        start = time.perf_counter()
        names = parse_names(self.scenes, "scenes")
        if self.pad not in PADS:
            raise InputError("pad", value=self.pad, rule="must be a known level", choices=PADS)
        if self.against and self.against not in PADS[1:]:
            raise InputError("against", value=self.against, rule="must be a level with one below it", choices=PADS[1:])
        names = names[:1] if self.quick else names
        if self.against:
            self._levels(names, start)
            return
        with recorded(self, "physics_sheet", owned=("sheet.png",), packages=("warp-lang",)) as (folder, metrics):
            metrics["pad"] = self.pad
            sensors = {
                physics: TactileSensor(
                    self.sensor,
                    physics=Ipc(self.pad) if physics == "ipc" else physics,
                    outputs=("rgb", "wrench"),
                    device=self.device,
                    seed=self.seed,
                    resolution=(80, 60) if self.quick else None,
                )
                for physics in ("rigid", "ipc")
            }
            rows = []
            for name in names:
                frames = {}
                for physics, sensor in sensors.items():
                    began = time.perf_counter()
                    frames[physics] = frame = sensor.press(load_press(name))
                    metrics |= {f"{name}.{physics}.{key}": value for key, value in measured(frame).items()}
                    metrics[f"{name}.{physics}.press_s"] = time.perf_counter() - began
                metrics |= {f"{name}.{key}": value for key, value in compared(frames["rigid"], frames["ipc"]).items()}
                rows.append((name, frames["rigid"], frames["ipc"]))
                print(f"{name}: done after {time.perf_counter() - start:.0f} s", flush=True)
            sheet_figure(rows, sensors["ipc"], self.pad).savefig(folder / "sheet.png", pil_kwargs={"optimize": True})
            metrics["device"] = sensors["ipc"].device_used

    def _levels(self, names: tuple[str, ...], start: float) -> None:
        out = Path("runs") / "physics_levels"
        with recorded(self, "physics_sheet", out=out, owned=("metrics.json",), packages=("warp-lang",)) as (_, metrics):
            metrics["against"] = self.against
            for name in names:
                surfaces = {}
                for level in PADS[PADS.index(self.against) :: -1]:
                    sensor = TactileSensor(
                        self.sensor, physics=Ipc(level), outputs=("height", "wrench"), device=self.device, seed=self.seed
                    )
                    frame = sensor.press(load_press(name))
                    surfaces[level] = frame.surface
                    metrics[f"{name}.{level}.force_n"] = measured(frame)["force_n"]
                    metrics["device"] = sensor.device_used
                    if level != self.against:
                        found = levels_apart(surfaces[level], surfaces[self.against])
                        metrics |= {f"{name}.{level}.{key}": value for key, value in found.items()}
                    print(f"{name}, {level}: done after {time.perf_counter() - start:.0f} s", flush=True)
        for key, value in metrics.items():
            if isinstance(value, float):
                print(f"{key} = {value:.4g}")


def levels_apart(one: GelSurface, truth: GelSurface) -> dict[str, Metric]:
    """Root mean square height of a pad less that of another one [µm]: where both touch, within 1 mm of that, and 1 to 2 mm from it."""
    off = 1e6 * (one.height[0].astype(float) - truth.height[0])
    either = one.contact[0] | truth.contact[0]
    near, ring = (widened(either, reach, one.grid.pitch) for reach in (0.5 * RING, RING))
    where = {"contact_um": one.contact[0] & truth.contact[0], "near_um": near & ~either, "ring_um": ring & ~near}
    return {key: float(np.sqrt((off[mask] ** 2).mean())) if mask.any() else float("nan") for key, mask in where.items()}


def measured(frame: TactileFrame) -> dict[str, Metric]:
    surface = frame.surface
    found: dict[str, Metric] = {
        "imprint_mm": 1e3 * float(surface.indentation.max()),
        "bulge_mm": -1e3 * float(surface.indentation.min()),
        "contact_mm2": 1e6 * float(surface.contact[0].sum()) * surface.grid.pitch[0] * surface.grid.pitch[1],
    }
    if "force" in frame.outputs:
        found["force_n"] = -float(frame.force[0, 2])
    return found


def compared(rigid: TactileFrame, soft: TactileFrame) -> dict[str, Metric]:
    one, two = rigid.surface, soft.surface
    off = 1e6 * (two.height[0].astype(float) - one.height[0])
    both = one.contact[0] & two.contact[0]
    ring = widened(both, RING, one.grid.pitch) & ~one.contact[0] & ~two.contact[0]
    found: dict[str, Metric] = {
        key: float(np.sqrt((off[where] ** 2).mean())) if where.any() else float("nan")
        for key, where in (("contact_um", both), ("ring_um", ring))
    }
    assert rigid.rgb is not None and soft.rgb is not None
    found["image"] = float(np.abs(rigid.rgb[0].astype(float) - soft.rgb[0]).mean())
    return found


def widened(mask: np.ndarray, by: float, pitch: tuple[float, float]) -> np.ndarray:
    """Nodes within ``by`` [m] of the mask along x and y, (Ny, Nx)."""
    out = mask.copy()
    for axis, step in ((1, pitch[0]), (0, pitch[1])):
        grown = out.copy()
        for k in range(1, round(by / step) + 1):
            ahead, back = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], back[axis] = slice(k, None), slice(None, -k)
            grown[tuple(ahead)] |= out[tuple(back)]
            grown[tuple(back)] |= out[tuple(ahead)]
        out = grown
    return out


def sheet_figure(rows: list[tuple[str, TactileFrame, TactileFrame]], sensor: TactileSensor, pad: str) -> Figure:
    """One row for each scene: its name, and its frames under the rigid and the soft pad."""
    from matplotlib.figure import Figure

    from raytac.report import camera_extent_mm

    left, right, bottom, top = camera_extent_mm(sensor.spec.camera)
    titles = (
        "image, rigid pad",
        f"image, ipc ({pad})",
        "indentation, rigid",
        f"indentation, ipc ({pad})",
        "height, ipc − rigid",
    )
    figure = Figure(figsize=(10.0, 1.24 * len(rows) + 0.45), layout="constrained", dpi=100)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.0)  # type: ignore[union-attr, call-arg]
    axes = np.atleast_2d(figure.subplots(len(rows), len(titles), squeeze=False))
    for row, (line, (name, rigid, soft)) in enumerate(zip(axes, rows, strict=True)):
        grid = rigid.surface.grid
        extent = [1e3 * v for v in (grid.x[0], grid.x[-1], grid.y[-1], grid.y[0])]
        dents = [1e3 * frame.surface.indentation[0] for frame in (rigid, soft)]
        deepest, highest = max(float(d.max()) for d in dents), min(float(d.min()) for d in dents)
        for axis, frame in zip(line[:2], (rigid, soft), strict=True):
            axis.imshow(frame.rgb[0], extent=(left, right, bottom, top))
        for axis, dent in zip(line[2:4], dents, strict=True):
            shown = axis.imshow(dent, extent=extent, cmap="cividis", vmin=highest, vmax=deepest)
        bars = [figure.colorbar(shown, ax=list(line[2:4]), shrink=0.9, pad=0.01)]
        off = dents[0] - dents[1]
        end = max(float(np.ceil(np.abs(off).max() / STEP_MM - 1e-9)), 1.0) * STEP_MM
        shown = line[4].imshow(off, extent=extent, cmap="PuOr", vmin=-end, vmax=end)
        bars.append(figure.colorbar(shown, ax=line[4], shrink=0.9, pad=0.02, ticks=(-end, 0.0, end)))
        for bar in bars:
            bar.set_label("mm", fontsize=8, labelpad=1)
            bar.ax.tick_params(labelsize=7.5, length=2)
        for axis in line:
            axis.set(xlim=(left, right), ylim=(bottom, top), xticks=(-5, 0, 5), yticks=(-5, 0, 5))
            axis.tick_params(labelsize=7.5, length=2, labelleft=axis is line[0], labelbottom=row == len(rows) - 1)
        line[0].set_ylabel(f"{name}\ny [mm]", fontsize=9)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("x [mm]", fontsize=8)
    return figure


if __name__ == "__main__":
    run(Args.run, Args)
