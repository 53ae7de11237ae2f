"""A picture of sensors on robots that others modelled: the scene as MuJoCo draws it beside what the sensors see, ray-traced.

    MUJOCO_GL=egl python experiments/foreign_sheet.py --out runs/foreign_sheet

Runs the example ``fetch_pick_place``, which needs the model files of ``gymnasium-robotics``, and draws its last state.
"""

from __future__ import annotations

import runpy
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.running import recorded, run
from raytac.io import CommonOptions
from raytac.sensor import TactileSensor
from raytac.world import SceneCamera

EXAMPLE = Path(__file__).parents[1] / "examples" / "fetch_pick_place.py"
TITLES = {"l": "left finger", "r": "right finger"}
ENLARGED = 4.0
"""Factor of the drawn displacements of markers."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Draw the Fetch robot that holds its cube, and both tactile images."""


def main(args: Args) -> None:
    from matplotlib.figure import Figure

    with recorded(args, "foreign_sheet", owned=("fetch.png", "metrics.json"), packages=("gymnasium-robotics",)) as (
        folder,
        metrics,
    ):
        done = runpy.run_path(str(EXAMPLE))
        world, frames, state = done["world"], done["frames"], done["state"]
        camera = SceneCamera(world, resolution=(640, 480), distance=0.5, azimuth=130.0, elevation=-12.0)
        world.model.vis.headlight.ambient[:], world.model.vis.headlight.diffuse[:] = 0.15, 0.15  # the package's scene has a light
        figure = Figure(figsize=(10.0, 3.0), layout="constrained")
        axes = figure.subplots(1, 3)
        axes[0].imshow(camera.draw())
        axes[0].set_title("Fetch of gymnasium-robotics, its 2 kg cube", fontsize=10)
        axes[0].set_axis_off()
        for place, (name, frame) in zip(axes[1:], frames.items(), strict=True):
            sensor = TactileSensor(world.sensors[name].spec, optics="raytrace", outputs=("rgb",), device=args.device)
            place.imshow(sensor.update(frame.surface).rgb[0])
            at, by = frame.markers.rest_px[0], ENLARGED * frame.markers.displacement_px[0]
            place.quiver(*at.T, *by.T, angles="xy", scale_units="xy", scale=1.0, color="yellow", width=0.006)
            load = -float(state.wrench[name][0, 2])
            place.set_title(f"{TITLES[name]}: {load:.0f} N, markers × {ENLARGED:g}", fontsize=10)
            place.set(xticks=[], yticks=[])
            metrics[f"foreign.fetch.{name}.load_n"] = load
        metrics["foreign.fetch.lifted_mm"] = 1e3 * float(np.asarray(done["lifted"]))
        figure.savefig(folder / "fetch.png", dpi=150)


if __name__ == "__main__":
    run(main, Args, __doc__)
