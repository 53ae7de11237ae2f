"""The picture on the front page: a coin in the gel, and a real photograph beside the ray-traced image of the same press.

    python experiments/front_page.py --data GELSLAM_MINI --out runs/front_page

``--data`` is a folder of photographs of balls pressed into a real GelSight Mini (docs/guide/calibrate.md). The lights are fitted to four of
five presses, as one fold of ``raytac compare-real``; the press that is shown is among the fifth, which the fit has not seen. The fit takes
minutes on a GPU and longer on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from experiments.running import recorded, run
from raytac.calibrate import FitSettings, by_press, fit_models, images_of, leds_at_walls, read_photographs
from raytac.io import CommonOptions
from raytac.optics import RayTraced
from raytac.sensor import TactileSensor
from raytac.specs import load_sensor, with_lights

FOLDS = 5
MARGIN = 2.2
"""Half the side of the cut-out of a photograph, in radii of the contact."""
ERROR_SCALE = 4.0


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Draw the picture on the front page."""

    data: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of photographs of a GelSight Mini, as `raytac compare-real` takes it."""
    shown: int = 2
    """Number of the press that is shown, among those that the fit has not seen."""
    starts: int = 1
    """Starts of the fit of direct light."""
    rounds: int = 2
    """Rounds of the fit with the ray tracer."""
    prior: str = "tied"
    """Strength of the priors of the fit."""


def main(args: Args) -> None:
    with recorded(args, "front_page") as (folder, metrics):
        base = load_sensor("gelsight_mini")
        response = replace(base.response, exposure=20.0, white_balance=(1.0, 1.0, 1.0), gamma=1.4, black_level=(0.0,) * 3)
        sensor = replace(base, response=replace(response, vignetting=(-0.1, 0.0, 0.0)))
        sensor = with_lights(sensor, leds_at_walls(sensor, "12,8,9"))
        shots = read_photographs(args.data, sensor)
        train, test = by_press(len(shots.presses), FOLDS)[0]
        models = fit_models(
            sensor,
            shots.take(train),
            settings=FitSettings(fixed=("gamma",)),
            modes=("raytrace",),
            device=args.device,
            seed=args.seed,
            starts=args.starts,
            rounds=args.rounds,
            prior=args.prior,
            tracing=RayTraced(shadows=False),
            tick=lambda stage, cost: print(f"{stage}: cost {cost:.4g}", flush=True),
        )
        unseen = shots.take(test)
        images = images_of(
            models.modes["raytrace"], models.fitted.sensor, unseen, models.circles(unseen), models.fitted.state.slopes
        )
        real = unseen.presses[args.shown]
        metrics["contact_mae"] = float(np.abs(images - unseen.presses)[unseen.distance(sensor) < 1.0].mean())
        coin = TactileSensor("gelsight_mini", outputs=("rgb", "height"), device=args.device, seed=args.seed).press("coin")
        np.savez_compressed(
            folder / "images.npz", photograph=real, ray_tracer=images[args.shown], circle=unseen.circles[args.shown]
        )
        draw(coin, real, images[args.shown], unseen.circles[args.shown], sensor.camera.pixel_pitch[0], folder / "real_mini.png")


def draw(coin, photograph: np.ndarray, ray_traced: np.ndarray, circle: np.ndarray, pitch: float, path: Path) -> None:
    """Write the figure: object's indentation and image; photograph, ray tracer and their difference with a scale bar each."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x, y, r = circle
    low_x, low_y = (max(0, int(c - MARGIN * r)) for c in (x, y))
    box = np.s_[low_y : int(y + MARGIN * r), low_x : int(x + MARGIN * r)]
    error = 128.0 + ERROR_SCALE * (ray_traced.astype(float) - photograph)
    indentation = 1e3 * coin.surface.indentation[0]
    grid = coin.surface.grid
    extent = tuple(1e3 * v for v in (grid.x[0], grid.x[-1], grid.y[-1], grid.y[0]))
    with plt.rc_context({"font.size": 10}):
        figure, axes = plt.subplots(1, 5, figsize=(11.0, 2.05), width_ratios=(4 / 3, 4 / 3, 1, 1, 1), layout="constrained")
        shown = axes[0].imshow(indentation, cmap="viridis", extent=extent)
        view = [1e3 * pitch * side / 2 for side in coin.rgb.shape[2:0:-1]]
        axes[0].set(xlim=(-view[0], view[0]), ylim=(view[1], -view[1]))
        scale = axes[0].inset_axes((0.03, 0.1, 0.03, 0.76))
        figure.colorbar(shown, cax=scale, ticks=(0.0, 0.2, 0.4, 0.6))
        scale.tick_params(colors="white", labelsize=8)
        scale.set_title("mm", color="white", fontsize=8, pad=2)
        axes[1].imshow(coin.rgb[0])
        for axis, image in zip(axes[2:], (photograph, ray_traced, error), strict=True):
            axis.imshow(np.clip(image[box], 0, 255).astype(np.uint8))
            rows, bar = image[box].shape[0], 2e-3 / pitch
            axis.plot([0.06 * rows, 0.06 * rows + bar], [0.94 * rows] * 2, color="white", linewidth=2)
            axis.text(0.06 * rows + bar / 2, 0.915 * rows, "2 mm", color="white", ha="center", va="bottom", fontsize=8)
        titles = ("coin: indentation", "coin: ray-traced", "ball: photograph", "ball: ray-traced", "difference × 4")
        for axis, title in zip(axes, titles, strict=True):
            axis.set_title(title)
            axis.set(xticks=[], yticks=[])
        figure.savefig(path, dpi=150)
        plt.close(figure)


if __name__ == "__main__":
    run(main, Args)
