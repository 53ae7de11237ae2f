"""Friction of the soft solver: partial slip and twist against closed forms at several step counts, a long hold, and a landing.

    python experiments/stick_slip.py [--cells 3] [--hold 600]

A ball pressed into a bonded block, ``--cells`` of its mesh to the contact radius (``tests/ipc/oracles/sheared.py``).
"""

from __future__ import annotations

import argparse

import numpy as np

import ipc
from tests.ipc.oracles.sheared import FULL_TWIST, MU, Sheared, sticking
from tests.ipc.test_friction import PLACES, block_over_table


def row(name: str, values: np.ndarray) -> None:
    print(f"{name:28}", *(f"{value:7.3f}" for value in values), flush=True)


def partial_slip(cells: int) -> None:
    """Shares of full slip along a pull and a turn."""
    exact = sticking(cells)
    row("pulled by [µm]", PLACES * 1e6)
    row("Cattaneo-Mindlin", exact.pulled(PLACES))
    for steps in (5, 20, 80):
        ball = Sheared(cells)
        shares = np.concatenate([[0.0], ball.pull(PLACES[-1], steps) / MU])
        row(f"{steps} steps", np.interp(PLACES, np.arange(steps + 1) * PLACES[-1] / steps, shares))
    angles = 0.015 * np.arange(1, 7)
    row("turned by [mrad]", angles * 1e3)
    row("Lubkin", exact.turned(angles))
    for steps in (6, 24):
        torque = Sheared(cells).turn(angles[-1], steps)[steps // 6 - 1 :: steps // 6]
        row(f"{steps} steps", torque / (FULL_TWIST * MU * exact.load * exact.radius))


def hold(cells: int, steps: int) -> None:
    """What a hold leaves of the tangential force."""
    ball = Sheared(cells)
    before = ball.pull(40e-6, 4)[-1]
    shares = ball.pull(0.0, steps) / before
    print(f"hold: {shares[0]:.5f} of the force after 1 step, {shares[-1]:.5f} after {steps}")


def landing(relags: int) -> None:
    """Tangential over normal force of a block that lands on a turning table, in converged steps."""
    for offset, speed, cells, mu in ((0.1, 20.0, 2, 0.5), (0.1, 5.0, 2, 0.5), (0.15, 40.0, 1, 0.5), (0.1, 5.0, 2, 1.0)):
        world = block_over_table(offset, cells=cells, friction=mu, friction_relags=relags)
        angle, ratios, newton, unconverged = 0.0, [], 0, 0
        for _ in range(6):
            angle += speed * world.settings.dt
            world.set_target("table", rotation=(np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)))
            report = world.step()
            force = world.wrench("block").force[0]
            newton += int(report.newton[0])
            unconverged += int(not report.converged[0])
            if report.converged[0]:
                ratios.append(float(np.hypot(force[0], force[1]) / force[2]))
        worst = f"{max(ratios):.3f}" if ratios else "-"
        print(f"landing at {speed:g} rad/s, μ = {mu}: at most {worst}, {newton} Newton iterations, {unconverged} unconverged")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=3)
    parser.add_argument("--hold", type=int, default=600)
    args = parser.parse_args()
    landing(ipc.Settings().friction_relags)
    hold(2, args.hold)
    partial_slip(args.cells)


if __name__ == "__main__":
    main()
