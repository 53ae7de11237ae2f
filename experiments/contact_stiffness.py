"""How stiff is the contact of a soft pad, and by how much is the bound that two-way coupling takes for it too large?

    python experiments/contact_stiffness.py --out runs/contact_stiffness

A body is pressed into the pad, then moved a little along and about each axis of the place where it presses, there and back; the change of
what it bears is the stiffness. The bound must not be less in any direction: ``least`` is the smallest ratio of both quadratic forms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.io import CommonOptions
from raytac.physics import ScenePad, SoftScene, pad_mesh, scene_body
from raytac.se3 import rotations
from raytac.shapes import primitive
from raytac.specs import PADS, load_sensor

SHAPES = {
    "ball": ("sphere", (4e-3,), 4e-3),
    "face": ("box", (5e-3, 5e-3, 3e-3), 3e-3),
    "plate": ("box", (18e-3, 18e-3, 3e-3), 3e-3),
}
"""Kind, size and height of the middle over the lowest point [m]: a ball of 4 mm, a face of 10 mm, one wider than the pad."""
AXES = (("normal", 2), ("shear", 0), ("rocking", 3), ("twist", 5))
WAY, TURN, STEP = 1e-5, 1e-3, 5e-5
"""By how much the body is moved [m], [rad], and how far in a step of the press [m]."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Measure the stiffness of a pad's contact."""

    shapes: tuple[str, ...] = tuple(SHAPES)
    """What presses, of ball, face and plate."""
    pads: tuple[str, ...] = ("coarse",)
    """How finely the pad is cut."""
    depth_mm: float = 0.3
    """How far beyond first touch [mm]."""
    sensor: str = "gelsight_mini"


def main(args: Args) -> None:
    for option, given, known in (("shapes", args.shapes, SHAPES), ("pads", args.pads, PADS)):
        for name in given:
            if name not in known:
                raise InputError(option, value=name, rule="must be known", choices=known)
    with recorded(args, "contact_stiffness") as (_, metrics):
        for pad in args.pads:
            for shape in args.shapes:
                true, bound = measure(args, shape, pad)
                least = float(np.linalg.eigvals(np.linalg.solve(true, bound)).real.min())
                print(f"{shape}, {pad}: " + ", ".join(f"{n} {true[k, k]:.3g} (bound {bound[k, k]:.3g})" for n, k in AXES))
                print(f"    least ratio of bound and stiffness {least:.2f}")
                for name, k in AXES:
                    metrics[f"contact_stiffness.{shape}.{pad}.{name}"] = float(true[k, k])
                    metrics[f"contact_stiffness.{shape}.{pad}.{name}_bound"] = float(bound[k, k])
                metrics[f"contact_stiffness.{shape}.{pad}.least"] = least


def measure(args: Args, shape: str, level: str) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and bound (6, 6) about the place where the body presses, pad axes: [N/m], [N m/rad]."""
    sensor = load_sensor(args.sensor)
    kind, size, height = SHAPES[shape]
    mesh = pad_mesh(sensor.gelpad, level)
    at = np.eye(4)
    at[2, 3] = height + 3.0 * mesh.d_hat
    body = scene_body("body", (primitive(kind, size),), "kinematic")
    scene = SoftScene([ScenePad("pad", sensor, mesh)], [body], np.eye(4)[None], {"body": at}, device=args.device)

    def go(pose: np.ndarray) -> np.ndarray:
        """What the body bears there, about the middle of the press (6,)."""
        scene.step(np.eye(4)[None], {"body": pose})
        wrench = scene.body_wrench("body")[0]
        return np.append(wrench[:3], wrench[3:] + np.cross(pose[:3, 3] - place, wrench[:3]))

    place = np.zeros(3)
    touched = None
    while touched is None or touched - at[2, 3] < 1e-3 * args.depth_mm - 0.5 * STEP:
        at[2, 3] -= STEP
        if go(at)[2] > 0.0 and touched is None:
            touched = float(at[2, 3])
    for _ in range(3):
        go(at)  # at rest
    place = scene.world.pressing()["pad", "body"].place[0]
    bound, there, columns = scene.stiffness("pad")[0], scene.save(), []
    for axis in range(6):
        sides = []
        for sign in (1.0, -1.0):
            scene.restore(there)
            moved, unit = at.copy(), sign * np.eye(3)[axis % 3]
            if axis < 3:
                moved[:3, 3] += WAY * unit
                sides.append(go(moved))
            else:
                turn = rotations(TURN * unit[None])[0]
                moved[:3, :3], moved[:3, 3] = turn @ at[:3, :3], place + turn @ (at[:3, 3] - place)
                sides.append(go(moved))
        columns.append((sides[1] - sides[0]) / (2.0 * (WAY if axis < 3 else TURN)))
    true = np.array(columns).T
    return 0.5 * (true + true.T), bound


if __name__ == "__main__":
    run(main, Args)
