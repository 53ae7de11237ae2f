"""Pictures of sensors on robots that others modelled: the scene as MuJoCo draws it beside what the sensors see and feel.

    MUJOCO_GL=egl python experiments/foreign_sheet.py --out runs/foreign_sheet

Runs the examples ``fetch_pick_place``, ``panda_lift_cube`` and ``shadow_hand``, which need the model files of ``gymnasium-robotics`` and
``robosuite``, and draws their last states.
"""

from __future__ import annotations

import runpy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.running import recorded, run
from raytac.io import CommonOptions
from raytac.sensor import TactileSensor
from raytac.world import SceneCamera, TactileWorld

EXAMPLES = Path(__file__).parents[1] / "examples"
GRIPPERS = {
    "fetch": ("fetch_pick_place", "Fetch lifts its 2 kg cube", {"l": "left", "r": "right"}),
    "panda": ("panda_lift_cube", "Panda lifts its 74 g cube", {"left": "left", "right": "right"}),
}
"""Example, title of the scene, and titles of the sensors, by the picture's name."""
VIEWS = {"fetch": (0.34, 140.0, -14.0), "panda": (0.36, 150.0, -12.0), "shadow_hand": (0.27, 60.0, -20.0)}
"""Distance [m], azimuth and elevation [°] of the camera."""
AMBIENT = {"fetch": 0.25, "panda": 0.45, "shadow_hand": 0.25}
"""Light from everywhere: robosuite's lamps are over the robot, whose sides would be dark."""
FINGERS = {"ff": "first", "mf": "middle", "rf": "ring", "lf": "little", "th": "thumb"}
ENLARGED = {"fetch": 2.0, "panda": 5.0}
"""Factor of the drawn displacements of markers."""
KEY_MM = 0.5
"""Displacement that the arrow of the legend stands for [mm]."""
BAR_MM = 5.0
"""Length of the scale bar [mm]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Draw robots of gymnasium-robotics and robosuite that hold things by their sensors."""


def draw_scene(axis: Any, world: TactileWorld, name: str, title: str) -> None:
    """Robot and body as MuJoCo draws them, around the pads."""
    distance, azimuth, elevation = VIEWS[name]
    camera = SceneCamera(world, resolution=(480, 480), distance=distance, azimuth=azimuth, elevation=elevation)
    model = camera.model
    model.site_rgba[:, 3] = 0.0
    for geom in map(model.geom, range(model.ngeom)):
        if geom.name.endswith("_collision") or model.body_mocapid[geom.bodyid.item()] >= 0:
            geom.matid[:], geom.rgba[3] = -1, 0.0  # robosuite has another shape to look at; Fetch's mocap body is a green cross
        elif geom.name in ("object0", *(f"{sensor}_case" for sensor in world.sensors)):
            geom.matid[:], geom.rgba[:] = -1, (0.8, 0.15, 0.1, 1.0) if geom.name == "object0" else (0.1, 0.3, 0.7, 1.0)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = AMBIENT[name], 0.25  # the packages' scenes have lights
    axis.imshow(camera.draw())
    camera.close()
    axis.set_title(title, fontsize=11)
    axis.set_axis_off()


def loads(state: Any, name: str) -> tuple[float, float]:
    """Normal load on a pad and force along it [N]."""
    force = state.wrench[name][0, :3]
    return float(-force[2]), float(np.hypot(*force[:2]))


def draw_touch(axis: Any, world: TactileWorld, frame: Any, name: str, enlarged: float, device: str) -> None:
    """Ray-traced image of a pad under its markers' displacements."""
    from matplotlib.patches import Rectangle

    sensor = TactileSensor(world.sensors[name].spec, optics="raytrace", outputs=("rgb",), device=device)
    image, markers = sensor.update(frame.surface).rgb[0], frame.markers
    at, by = markers.rest_px[0], markers.displacement_px[0]
    px_per_mm = 1e-3 * np.nanmedian(np.linalg.norm(by, axis=1) / np.linalg.norm(markers.displacement[0], axis=1))
    axis.imshow(image)
    arrows = axis.quiver(*at.T, *(enlarged * by).T, angles="xy", scale_units="xy", scale=1.0, color="yellow", width=0.006)
    label = f"{KEY_MM:g} mm (drawn × {enlarged:g})"
    length = enlarged * KEY_MM * px_per_mm
    axis.quiverkey(
        arrows, 0.08, -0.06, length, label, labelpos="E", color="black", coordinates="axes", fontproperties={"size": 9}
    )
    down = -world.state().world_from_pad[name][0, 2, :2]  # along the picture
    box = axis.add_patch(Rectangle((8, image.shape[0] - 80), 74, 76, color=(0.0, 0.15, 0.15, 0.85), linewidth=0))
    start = np.array([45.0, image.shape[0] - 49.0]) - 25.0 * down
    compass = axis.quiver(*start, *(50 * down), angles="xy", scale_units="xy", scale=1.0, color="white", width=0.012)
    axis.text(45, image.shape[0] - 7, "gravity", color="white", ha="center", va="bottom", fontsize=9, zorder=5)
    box.set_zorder(3)  # over the markers' arrows
    compass.set_zorder(4)
    right, bottom = image.shape[1] - 12.0, image.shape[0] - 12.0
    axis.plot([right - BAR_MM * px_per_mm, right], [bottom, bottom], color="white", linewidth=3)
    axis.text(right - BAR_MM * px_per_mm / 2, bottom - 6, f"{BAR_MM:g} mm", color="white", ha="center", va="bottom", fontsize=9)
    axis.set(xticks=[], yticks=[])


def main(args: Args) -> None:
    from matplotlib.figure import Figure

    pictures = ("fetch.png", "panda.png", "shadow_hand.png", "metrics.json")
    packages = ("gymnasium-robotics", "robosuite")
    with recorded(args, "foreign_sheet", owned=pictures, packages=packages) as (folder, metrics):
        for picture, (example, title, sensors) in GRIPPERS.items():
            done = runpy.run_path(str(EXAMPLES / f"{example}.py"))
            world, state = done["world"], done["state"]
            figure = Figure(figsize=(11.0, 3.5), layout="constrained")
            axes = figure.subplots(1, 3, width_ratios=(1.0, 1.33, 1.33))
            draw_scene(axes[0], world, picture, title)
            for axis, (name, side) in zip(axes[1:], sensors.items(), strict=True):
                draw_touch(axis, world, done["frames"][name], name, ENLARGED[picture], args.device)
                normal, shear = loads(state, name)
                axis.set_title(f"{side} pad: {normal:.1f} N normal, {shear:.2f} N shear", fontsize=11)
                metrics |= {f"foreign.{picture}.{name}.load_n": normal, f"foreign.{picture}.{name}.shear_n": shear}
            metrics[f"foreign.{picture}.lifted_mm"] = 1e3 * float(np.asarray(done["lifted"]))
            figure.savefig(folder / f"{picture}.png", dpi=150)

        done = runpy.run_path(str(EXAMPLES / "shadow_hand.py"))
        world, state, frames = done["world"], done["state"], done["world"].observe()
        figure = Figure(figsize=(11.0, 5.0), layout="constrained")
        axes = figure.subplot_mosaic([["scene", "ff", "mf", "rf"], ["scene", "lf", "th", "."]], width_ratios=(2.0, 1.0, 1.0, 1.0))
        draw_scene(axes["scene"], world, "shadow_hand", f"Shadow Hand holds its block of {done['weight']:.3f} N")
        depth = {name: 1e3 * frames[name].surface.indentation[0] for name in FINGERS}
        deepest = max(map(np.max, depth.values()))
        for name, finger in FINGERS.items():
            half = 0.5e3 * np.array(world.sensors[name].spec.gelpad.size)
            extent = (-half[0], half[0], half[1], -half[1])
            shown = axes[name].imshow(depth[name], vmin=0.0, vmax=deepest, extent=extent)
            normal, shear = loads(state, name)
            axes[name].set_title(f"{finger}: {normal:.2f} N,\n{shear:.2f} N shear", fontsize=11)
            axes[name].set(xticks=[-6, 0, 6], yticks=[-6, 0, 6])
            axes[name].set_xlabel("x [mm]", fontsize=9)
            axes[name].set_ylabel("y [mm]", fontsize=9)
            metrics |= {f"foreign.shadow_hand.{name}.load_n": normal, f"foreign.shadow_hand.{name}.shear_n": shear}
        figure.colorbar(shown, ax=[axes[name] for name in FINGERS], label="indentation [mm]")
        metrics |= {
            "foreign.shadow_hand.carried_n": float(done["carried"]),
            "foreign.shadow_hand.weight_n": float(done["weight"]),
        }
        figure.savefig(folder / "shadow_hand.png", dpi=150)


if __name__ == "__main__":
    run(main, Args, __doc__)
