"""Which Gaussians give a pressed gel the rim and the skirt of an elastic layer? Fits the widths and gains of the rigid pad's surround.

    python experiments/fit_surround.py --out runs/fit_surround
    python experiments/fit_surround.py --steps 0 --out runs/surround_error

Balls, cylinders, cones and punches are pressed into a linear elastic layer bonded at its back, without friction
(``tests/gel/layer_contact.py``), and into the surround, w ← max(gain · Gaussian(w), u). The error of a shape is the RMS difference of
slopes over the layer's RMS slope. What is minimised is the mean over shapes and 0.3 times their RMS, so that no shape is neglected. The sum
of all widths is what the surround costs, and is bounded.
With ``--steps 0`` nothing is fitted, and the errors are those of the code. Other shapes (``new.…``) were not fitted to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from experiments.running import recorded, run
from raytac.checks import check_whole
from raytac.gel import LAYER_STEPS, PYRAMID_SIGMAS
from raytac.io import CommonOptions
from tests.gel.layer_contact import Layer, Overlap, ball, cone, cylinder, punch, slope_error

MM = 1e-3
LARGE: dict[str, Overlap] = {
    **{
        f"ball_{r}_{d}": ball(r * MM, d * MM)
        for r, d in ((1, 0.15), (1, 0.5), (2, 0.2), (2, 0.8), (3.155, 0.3), (3.155, 1.0), (5, 0.3), (5, 0.9))
    },
    **{f"cylinder_{r}_{d}": cylinder(r * MM, h * MM, d * MM) for r, h, d in ((3, 3, 0.3), (2, 4, 0.7), (4, 3, 0.8))},
    "cone": cone(0.6, 0.6 * MM),
    "punch_1.2": punch(1.2 * MM, 0.3 * MM),
}
SMALL: dict[str, Overlap] = {
    **{f"ball_{r}_{d}": ball(r * MM, d * MM) for r, d in ((0.5, 0.1), (0.5, 0.3), (1, 0.1))},
    "punch_0.4": punch(0.4 * MM, 0.2 * MM),
    "cylinder_0.5": cylinder(0.5 * MM, 1.5 * MM, 0.2 * MM),
}
NEW: dict[str, Overlap] = {
    **{f"ball_{r}_{d}": ball(r * MM, d * MM) for r, d in ((4, 0.6), (3.2, 0.2), (3.2, 0.6), (7.5, 1.0), (1.5, 0.3))},
    "cylinder_1.5": cylinder(1.5 * MM, 5 * MM, 0.4 * MM),
    "cylinder_6": cylinder(6 * MM, 2 * MM, 0.5 * MM),
}
"""Shapes pressed on 19.2 and 6.4 mm of the layer, and those that nothing is fitted to; radius and depth [mm]."""

Steps = list[tuple[float, float]]
"""Standard deviation [m] and gain of every Gaussian."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Fit the surround's Gaussians to an elastic layer."""

    steps: int = 7
    """Number of Gaussians; 0 only measures those of the code."""
    width_mm: float = 1.8
    """Bound of the sum of all standard deviations [mm]."""
    evaluations: int = 450
    """Most evaluations of the fit."""


class Presses:
    """Shapes on one layer, and the layer's own surfaces under them."""

    def __init__(self, layer: Layer, shapes: dict[str, Overlap]) -> None:
        self.layer, self.names = layer, tuple(shapes)
        self.overlaps = np.array([layer.overlap(shape) for shape in shapes.values()])
        self.surfaces = np.array([layer.press(u)[1] for u in self.overlaps])
        self.near = np.hypot(*np.meshgrid(layer.lines, layer.lines)) < 0.32 * layer.side

    def errors(self, steps: Steps) -> np.ndarray:
        w = np.maximum(self.overlaps, 0.0)
        for sigma, gain in steps:
            w = np.maximum(self.layer.filtered(gain * np.exp(-0.5 * (sigma * self.layer.wave_numbers) ** 2), w), self.overlaps)
        return np.array([slope_error(*pair, self.layer.pitch, self.near) for pair in zip(w, self.surfaces, strict=True)])


def main(args: Args) -> None:
    check_whole("steps", args.steps, 0)
    with recorded(args, "fit_surround", device="cpu") as (_, metrics):
        fitted = [Presses(Layer(192, 19.2 * MM), LARGE), Presses(Layer(128, 6.4 * MM), SMALL)]
        new, thickness = Presses(Layer(256, 25.6 * MM), NEW), fitted[0].layer.thickness
        steps = [(share * thickness, gain) for share, gain in LAYER_STEPS]
        if args.steps:
            steps = fit(fitted, args)
        for k, (sigma, gain) in enumerate(steps):
            metrics |= {f"step_{k}.sigma_over_thickness": sigma / thickness, f"step_{k}.gain": gain}
            print(f"    ({sigma / thickness:.4f}, {gain:.4f}),")
        for what, own in (("layer", steps), ("taxim", [(sigma, 1.0) for sigma in PYRAMID_SIGMAS])):
            for kind, presses in (("fitted", fitted), ("new", [new])):
                errors = {name: e for one in presses for name, e in zip(one.names, one.errors(own), strict=True)}
                metrics |= {f"{kind}.{what}.{name}": float(e) for name, e in errors.items()}
                values = np.array(list(errors.values()))
                metrics |= {f"{kind}.{what}.mean": float(values.mean()), f"{kind}.{what}.worst": float(values.max())}
                print(f"{kind} shapes, {what}: mean {values.mean():.3f}, worst {values.max():.3f}")


def fit(presses: list[Presses], args: Args) -> Steps:
    """Powell's method from a geometric row of widths."""

    def steps_of(x: np.ndarray) -> Steps:
        sigma, gain = np.split(x, 2)
        return list(zip(np.exp(sigma).tolist(), (1 / (1 + np.exp(-gain))).tolist(), strict=True))

    def cost(x: np.ndarray) -> float:
        steps = steps_of(x)
        errors = np.concatenate([one.errors(steps) for one in presses])
        excess = sum(sigma for sigma, _ in steps) / MM - args.width_mm
        return float(errors.mean() + 0.3 * np.sqrt((errors**2).mean()) + 0.1 * max(excess, 0.0))

    start = np.concatenate([np.log(np.geomspace(0.6 * MM, 0.05 * MM, args.steps)), np.linspace(2.2, 3.2, args.steps)])
    bounds = [(np.log(0.02 * MM), np.log(1.5 * MM))] * args.steps + [(0.0, 9.0)] * args.steps
    options = {"maxfev": args.evaluations, "xtol": 1e-2, "ftol": 1e-3}
    return steps_of(minimize(cost, start, method="Powell", bounds=bounds, options=options).x)


if __name__ == "__main__":
    run(main, Args)
