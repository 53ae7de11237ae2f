"""A gel's stiffness from forces of one ball at known depths.

Forces of a press are proportional to Young's modulus E; Poisson's ratio ν decides how they grow with depth. So does a rig that yields
by C F on the way: then the gel is pressed to d − C F only. ``fit_gel`` tries all three and tests each on depths that it was not fitted to.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from raytac.checks import check_number
from raytac.errors import InputError, RaytacError
from raytac.io.progress import Progress
from raytac.physics.base import Pad, PhysicsConfig
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

COLUMNS = "depth_mm", "force_n"
PITCH = 0.1e-3
"""Spacing of the pads' nodes [m]."""
RATIOS = (0.30, 0.36, 0.40, 0.44, 0.46, 0.48, 0.49)
"""Poisson's ratios at which pads are pressed.

In between, the logarithm of a force is a polynomial."""
_DEGREE, _STEP = 4, 0.005
"""Degree of that polynomial; spacing of the ratios that are tried."""
_MOST_YIELD, _YIELDS = 0.5, 201
"""Most that a rig may yield, over the depth; number of compliances that are tried."""


@dataclass(frozen=True)
class ForceTable:
    """Forces [N] at depths [m] from first touch, ascending, (N,) each."""

    depth: np.ndarray
    force: np.ndarray

    @classmethod
    def read(cls, path: Path) -> ForceTable:
        """A file with columns ``COLUMNS``, lines with # skipped; ``InputError`` for other rows.

        Numbers must be above 0, each depth once, at least two.
        """
        try:
            lines = [line for line in path.read_text("utf-8").splitlines() if line.strip() and not line.startswith("#")]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError("data", value=str(path), rule=f"cannot be read: {error}") from error
        rows = list(csv.DictReader(lines))
        if not rows or any(name not in rows[0] for name in COLUMNS):
            raise InputError("data", value=str(path), rule=f"must have the columns {', '.join(COLUMNS)} and a row of numbers")
        try:
            values = np.array([[float(row[name]) for name in COLUMNS] for row in rows])
        except (TypeError, ValueError) as error:
            raise InputError("data", value=str(path), rule=f"must hold numbers: {error}") from error
        if not (np.isfinite(values) & (values > 0.0)).all() or len(np.unique(values[:, 0])) < max(2, len(values)):
            raise InputError("data", value=str(path), rule="must hold depths and forces above 0, each depth once, at least two")
        depth, force = values[values[:, 0].argsort()].T
        return cls(1e-3 * depth, force)


@dataclass(frozen=True)
class GelFit:
    """One reading of the forces: values fitted to all depths, and errors at depths left out."""

    name: str
    """``modulus`` alone, or with it ``poisson_ratio`` or ``compliance``."""
    youngs_modulus: float
    """[Pa]."""
    poisson_ratio: float
    compliance: float
    """Of the rig [m/N]; 0 is a rigid one."""
    held_out: np.ndarray
    """Error of each pad at each depth with the values that the other depths give, (P, N).

It is the force over the measured one, less 1."""
    at_end: bool = False
    """Poisson's ratio or compliance lies at an end of what was tried.

The best one may lie beyond."""

    @property
    def held_out_rms(self) -> float:
        return float(np.sqrt(np.mean(self.held_out**2)))


def ball_scene(radius: float, depth: float) -> PressScene:
    """A ball of ``radius`` [m] over the pad's middle, pressed to ``depth`` [m]."""
    ball = ObjectSpec("sphere", {"radius": radius}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    return PressScene("ball", ball, (StageSpec("indent", depth=depth),))


def pressed_forces(pad: Pad, depths: np.ndarray) -> np.ndarray:
    """Normal force [N] at each of ``depths`` [m], ascending.

    Raises ``RaytacError``: the physics marks a state as failed, or the ball is not felt.
    """
    forces = []
    for depth in depths:
        (reading,) = pad.follow(StageSpec("indent", depth=float(depth)))
        if reading.failed.any() or (reading.unconverged is not None and reading.unconverged.any()):
            raise RaytacError(f"the press to {1e3 * depth:g} mm did not converge")
        if not reading.wrench[0, 2]:
            raise RaytacError(f"the press to {1e3 * depth:g} mm is not felt: leave this depth out")
        forces.append(float(reading.wrench[0, 2]))
    return np.abs(forces)


def ball_forces(
    sensor: SensorSpec, pads: Sequence[PhysicsConfig], radius: float, depths: np.ndarray, *, device: str = "auto"
) -> np.ndarray:
    """Normal forces (P, N) [N] of a ball at ``depths`` (N,) [m], ascending, on each of ``pads``.

    ``radius`` of the ball [m]. Raises ``RaytacError``: a press did not converge.
    """
    scene = ball_scene(radius, float(depths[-1]))
    built = (pad.build(sensor, scene, pitch=PITCH, num_envs=1, device=device) for pad in pads)
    return np.array([pressed_forces(pad, depths) for pad in built])


def modulus_factor(force: np.ndarray, measured: np.ndarray) -> float:
    """Factor c of the modulus that makes Σ (c F / F_measured − 1)² least; ``force`` (…, N)."""
    share = force / measured
    return float(share.sum() / (share**2).sum())


def fit_gel(
    sensor: SensorSpec,
    table: ForceTable,
    radius: float,
    pads: Sequence[PhysicsConfig],
    *,
    device: str = "auto",
    progress: bool = False,
) -> list[GelFit]:
    """Fits of the gel of all ``pads`` together to the forces of a ball of ``radius`` [m].

    The modulus alone, with Poisson's ratio as in ``sensor``; modulus and Poisson's ratio; modulus and a rig's compliance. The last two
    need three depths. Each makes the sum of squared relative errors least.

    Raises ``InputError``: no pad. RaytacError: a press did not converge.
    """
    if not pads:
        raise InputError("pads", value=(), rule="must name at least one pad")
    check_number("radius", radius, "(0, 0.1]", "m")
    own = sensor.gelpad.poisson_ratio
    presses: dict[float, np.ndarray] = {}
    with Progress(desc="presses", total=len({own, *RATIOS}), show=progress) as bar:
        for ratio in sorted({own, *RATIOS}):
            gelpad = replace(sensor.gelpad, poisson_ratio=ratio)
            presses[ratio] = ball_forces(replace(sensor, gelpad=gelpad), pads, radius, table.depth, device=device)
            bar.update()
    return fits_of(presses, own, table, sensor.gelpad.youngs_modulus)


def fits_of(presses: Mapping[float, np.ndarray], own: float, table: ForceTable, youngs_modulus: float) -> list[GelFit]:
    """Fits from the forces (P, N) [N] of ``presses`` by Poisson's ratio.

    They are of ``youngs_modulus`` [Pa]; ``own`` is the sensor's ratio.
    """
    shape = presses[own].shape
    tried = np.arange(RATIOS[0], RATIOS[-1] + 0.5 * _STEP, _STEP)
    logs = np.log(np.array([presses[ratio] for ratio in RATIOS])).reshape(len(RATIOS), -1)
    middle = 0.5 * (RATIOS[0] + RATIOS[-1])
    powers = np.polynomial.polynomial.polyfit(np.array(RATIOS) - middle, logs, _DEGREE)
    by_ratio = np.exp(np.polynomial.polynomial.polyval(tried - middle, powers)).T.reshape(len(tried), *shape)
    yields = np.linspace(0.0, _MOST_YIELD * (table.depth / table.force).min(), _YIELDS)
    by_yield = np.array([_between(table.depth - c * table.force, table.depth, presses[own]) for c in yields])
    candidates = {
        "modulus": (presses[own][None], [own], [0.0]),
        "poisson_ratio": (by_ratio, tried, np.zeros_like(tried)),
        "compliance": (by_yield, np.full_like(yields, own), yields),
    }
    fits = []
    for name, (forces, ratios, compliances) in candidates.items():
        if len(forces) > 1 and len(table.depth) < 3:
            continue
        held_out = np.empty(shape)
        for k in range(len(table.depth)):
            best, factor = _best(forces, table.force, np.arange(len(table.depth)) != k)
            for pad, force in enumerate(forces[best] if compliances[best] == 0.0 else presses[own]):
                held_out[pad, k] = _with_rig(force, table.depth, factor, compliances[best], k) / table.force[k] - 1.0
        best, factor = _best(forces, table.force, np.ones(len(table.depth), bool))
        at_end = len(forces) > 1 and best in ((len(forces) - 1,) if name == "compliance" else (0, len(forces) - 1))
        fits.append(GelFit(name, factor * youngs_modulus, float(ratios[best]), float(compliances[best]), held_out, at_end))
    return fits


def _best(forces: np.ndarray, measured: np.ndarray, used: np.ndarray) -> tuple[int, float]:
    """Number and factor of the best candidate of ``forces`` (K, P, N) at ``used`` depths (N,)."""
    share = forces[..., used] / measured[used]
    factors = share.sum(axis=(1, 2)) / (share**2).sum(axis=(1, 2))
    best = int(((factors[:, None, None] * share - 1.0) ** 2).sum(axis=(1, 2)).argmin())
    return best, float(factors[best])


def _between(depth: np.ndarray, depths: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Forces (P, M) at ``depth`` (M,): powers of the depth between ``depths`` (N,), and beyond."""
    k = np.clip(np.searchsorted(depths, depth) - 1, 0, len(depths) - 2)
    log_depth, log_force = np.log(depths), np.log(forces)
    power = np.diff(log_force, axis=-1) / np.diff(log_depth)
    return np.exp(log_force[..., k] + power[..., k] * (np.log(depth) - log_depth[k]))


def _with_rig(force: np.ndarray, depths: np.ndarray, factor: float, compliance: float, k: int) -> float:
    """Force [N] at the ``k``-th depth of ``factor`` times ``force`` (N,), on a rig that yields."""
    if compliance == 0.0:
        return factor * float(force[k])
    low, high = 0.0, float(depths[k])
    for _ in range(60):  # the gel's share of the depth
        middle = 0.5 * (low + high)
        reached = middle + compliance * factor * float(_between(np.array([middle]), depths, force)[0])
        low, high = (middle, high) if reached < depths[k] else (low, middle)
    return factor * float(_between(np.array([high]), depths, force)[0])
