"""How a press drives the simulated pad: to a depth of the coat, to a force, sideways, about z, and off again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from raytac.physics.press import CLEARANCE, PressTargets
from raytac.physics.soft.placement import SoftPlaces
from raytac.physics.soft.press_solver import SoftContact
from raytac.physics.soft.reading import SoftReader
from raytac.physics.soft.substeps import STEP, TURN
from raytac.specs.press import PressScene, StageSpec

__all__ = ["SoftDrive", "StageStart"]

_LIFT = 3.0
"""A release may go in steps so many times as long."""
_CLOSE = 1e-6
"""A depth is reached within this [m]."""
_TIGHT = 5e-4
"""A force is reached within this share."""
_FAR = 0.01
"""Share of the force from which a change of it tells the contact's stiffness; lesser ones may be friction that still gives way."""
_GROWTH = 8.0
"""Times the force that is borne up to which a contact's stiffness is extrapolated."""
_SLIGHT = 1e-6
"""No force [N]."""
_PATIENCE, _REFINEMENTS = 120, 4
_STILL = 2e-5
"""Speed below which a free object lies still [m/s]."""


@dataclass(frozen=True)
class StageStart:
    """Where B environments were when a stage began."""

    depth: np.ndarray
    """[m], (B,)."""
    shear: np.ndarray
    """[m], (B, 2)."""
    twist: np.ndarray
    """[rad], (B,)."""
    force: np.ndarray
    """Normal force that is kept, or where none is, that the contact bears [N], (B,); what a stage to a force begins from."""


class SoftDrive:
    """Takes the object of a press along its stages, for B environments together; knows where it is, not what the pad looks like."""

    def __init__(
        self,
        scene: PressScene,
        solver: SoftContact,
        reader: SoftReader,
        places: SoftPlaces,
        targets: PressTargets,
    ) -> None:
        self._scene, self._solver, self._reader, self._places = scene, solver, reader, places
        self._targets, self.num_envs = targets, len(targets.lost)
        self._d_hat = reader.mesh.d_hat
        self._is_free = scene.object.dynamics == "affine"
        self._weight = max((stage.force or 0.0 for stage in scene.trajectory), default=0.0)
        self.bar = tqdm(disable=True)
        """Counts the solver's steps."""
        self._forget()

    def reset(self) -> None:
        """Back to the start: the pad at rest, the object above it."""
        self._forget()
        self._solver.reset()

    def start(self) -> StageStart:
        """Where the next stage begins."""
        force = np.where(np.isfinite(self._force), self._force, np.maximum(np.nan_to_num(self._normal_force()), 0.0))
        return StageStart(self._depth.copy(), self._shear.copy(), self._twist.copy(), force)

    def read(self, clearance: np.ndarray) -> None:
        """Take note of the clearance [m], (B,), in the state that was read last."""
        self._seen = clearance

    def poses(self) -> np.ndarray:
        """``pad_from_object`` as driven: higher than the depth says by the clearance; (B, 4, 4)."""
        return self._places.poses(self._kept - self._depth, self._shear, self._twist)

    def case(self) -> np.ndarray | None:
        """``world_from_pad`` (B, 4, 4) if the case moves."""
        if self._scene.moves != "case":
            return None
        return self._places.case(self._kept - self._depth, self._shear, self._twist)

    def advance(self, stage: StageSpec, fraction: float, begun: StageStart) -> None:
        """From wherever it is to ``fraction`` of a stage that began at ``begun``."""
        depth, shear, twist, borne = begun.depth, begun.shear, begun.twist, begun.force
        if stage.kind in ("shear", "twist"):
            to_shear, to_twist = self._shear, self._twist
            if stage.kind == "shear":
                to_shear = shear + fraction * (self._targets.shear(stage) - shear)
            else:
                to_twist = twist + fraction * (self._targets.twist(stage) - twist)
            self._go(self._depth, to_shear, to_twist, follow=True)
            self._settle()  # a shear unloads what lies behind the object
        elif stage.kind == "release":
            self._force[:] = np.nan
            self._release(depth, fraction)
        elif stage.force is not None:
            self._force[:] = borne + fraction * (stage.force - borne)
            self._load()
            if not self._is_free and (self._force < borne).any():
                self._settle()
        else:
            self._force[:] = np.nan
            start = np.maximum(depth, 0.0)
            self._indent(start + fraction * (self._targets.depth(stage) - start), is_last=fraction == 1.0)
        self._converge()

    def _forget(self) -> None:
        batch = self.num_envs
        self._depth = np.full(batch, -CLEARANCE)
        self._shear, self._twist = np.zeros((batch, 2)), np.zeros(batch)
        self._force = np.full(batch, np.nan)
        """Normal force that is being kept [N]; NaN while a depth is."""
        self._kept = np.full(batch, self._d_hat)
        """Clearance that the object is held higher by [m]: at first as far as the barrier reaches, then as it was last read."""
        self._seen = np.full(batch, np.nan)
        """Clearance in the state that was read last [m]; NaN out of contact."""
        self._stiffness = np.full(batch, np.nan)
        self.failed: np.ndarray = self._targets.lost.copy()
        self._solver.unconverged[:] = 0

    @property
    def unconverged(self) -> np.ndarray:
        """Steps since the start that did not meet the solver's tolerance, shape (B,)."""
        return self._solver.unconverged.copy()

    def _indent(self, depth: np.ndarray, *, is_last: bool) -> None:
        """Drive the coat to a depth, without passing it on the way; exactly there at the stage's end."""
        way = depth - np.maximum(self._depth, -self._d_hat)
        # Follow the clearance, but never so fast that the object would stand still or turn back.
        off = np.nan_to_num(self._seen - self._kept)
        self._kept = self._kept + np.clip(off, -self._d_hat, 0.5 * np.abs(way))
        exact = np.full(self.num_envs, is_last) | np.isnan(self._seen)  # the first that touches has no clearance to go by
        short = np.where(exact, np.clip(way, 0.0, self._d_hat), 0.0)
        self._go(depth - short, self._shear, self._twist)
        if exact.any():
            self._kept = self._kept + self._off()
            self._depth = depth
            self._step()
            self._settle_depth()
        if (way < 0.0).any():
            self._settle_friction()

    def _go(self, depth: np.ndarray, shear: np.ndarray, twist: np.ndarray, stretch: float = 1.0, *, follow: bool = False) -> None:
        """Drive straight to a place in steps short enough; a force that is kept is kept on the way, and a depth if asked to ``follow``."""
        begun = np.maximum(self._depth, -self._d_hat) if stretch == 1.0 else self._depth
        ways = np.abs(depth - begun), np.linalg.norm(shear - self._shear, axis=1), np.abs(twist - self._twist) * (STEP / TURN)
        steps = max(int(np.ceil(max(way.max() for way in ways) / (STEP * stretch) - 1e-9)), 1)
        old_shear, old_twist = self._shear, self._twist
        for step in range(1, steps + 1):
            share = step / steps
            self._shear, self._twist = old_shear + share * (shear - old_shear), old_twist + share * (twist - old_twist)
            self._depth = begun + share * (depth - begun)
            self._step()
            if np.isfinite(self._force).any():
                self._load()
                begun = depth = self._depth
            elif follow and step < steps:
                self._kept = self._kept + np.clip(self._off(), -STEP, STEP)

    def _step(self) -> None:
        self._solver.fail(self.failed)
        if not self.failed.all():
            self.failed |= self._solver.drive(self.poses(), self.case())
            self.bar.update()

    def _converge(self) -> None:
        """Stand still for some steps where the last one did not meet the solver's tolerance; what does not meet it then has failed."""
        for _ in range(_REFINEMENTS):
            if (self._solver.converged | self.failed).all():
                return
            self._step()
            if np.isfinite(self._force).any():
                self._load()
            else:
                self._settle_depth()
        self.failed |= ~self._solver.converged

    def _settle_friction(self) -> None:
        self.failed |= self._solver.settle_friction(self.poses(), self.case(), self.failed)

    def _settle(self) -> None:
        """Let friction become that of the contacts there are, at the force or the depth that is kept."""
        if not np.isfinite(self._force).any():
            self._settle_depth()
            self._settle_friction()
            self._settle_depth()
            return
        for _ in range(_REFINEMENTS):  # where friction gives way the force does too, and to make up for that costs steps
            if (self._solver.obeys_friction() | self.failed).all():
                return
            self._settle_friction()
            self._load()

    def _off(self) -> np.ndarray:
        """How much more the barrier keeps than the object is held higher by [m], (B,); 0 out of contact, or where a force is kept."""
        clearance = self._reader.clearance(self._solver.coat_state(self.poses()))
        return np.where(np.isfinite(clearance) & ~self.failed & ~np.isfinite(self._force), clearance - self._kept, 0.0)

    def _settle_depth(self) -> None:
        """Correct until the coat, not the barrier's shell, is at the depth."""
        for _ in range(_REFINEMENTS):
            off = self._off()
            if np.abs(off).max() < _CLOSE:
                return
            self._kept = self._kept + np.clip(off, -STEP, STEP)
            self._step()

    def _release(self, depth: np.ndarray, fraction: float) -> None:
        lift = self._places.lift(self._shear, self._twist)
        if self._is_free:
            if fraction == 1.0:
                self._solver.reset()
                self._depth = lift - CLEARANCE
            return
        self._go(depth + fraction * (lift - CLEARANCE - depth), self._shear, self._twist, _LIFT)
        self._settle_friction()

    def _load(self) -> None:
        """Let the contact bear ``self._force``: a free object by its weight, a driven one by a secant search of its depth."""
        if self._is_free:
            self._lie()
            return
        self._depth = np.maximum(self._depth, -self._d_hat)
        if not np.isfinite(self._stiffness).all():
            wanted = np.nan_to_num(self._force)
            self._stiffness = np.array([self._places.stiffness(b, self._twist[b], wanted[b]) for b in range(self.num_envs)])
        borne, drift = self._normal_force(), np.zeros(self.num_envs)
        for _ in range(_PATIENCE):
            missing = self._missing()
            if self._bears(missing):
                return
            # On the way the contact grows and stiffens, a ball's as the cube root of its force.
            grown = np.clip(np.nan_to_num(self._force) / np.maximum(borne, _SLIGHT), 1.0, _GROWTH)
            way = np.clip((missing - drift) / (self._stiffness * 0.5 * (1.0 + np.cbrt(grown))), -STEP, STEP)
            self._depth = self._depth + way
            self._step()
            before, borne = borne, self._normal_force()
            gained, far = borne - before, np.abs(self._stiffness * way) > _FAR * np.maximum(borne, _SLIGHT)
            found = gained / np.where(far, way, 1.0)
            self._stiffness = np.where(far & (found > 0.3 * self._stiffness), found, self._stiffness)
            drift = np.where(far, 0.0, gained - self._stiffness * way)
        self.failed |= np.abs(self._missing()) > _TIGHT * np.nan_to_num(self._force)

    def _missing(self) -> np.ndarray:
        """What the contact bears too little of the force that is kept [N], (B,); 0 where none is."""
        return np.where(np.isfinite(self._force) & ~self.failed, self._force - self._normal_force(), 0.0)

    def _bears(self, missing: np.ndarray) -> bool:
        return bool((np.abs(missing) <= _TIGHT * np.nan_to_num(self._force)).all())

    def _lie(self) -> None:
        """Let a free object come to rest under its weight."""
        assert self._weight > 0.0
        self._solver.weigh(float(self._force[0]) / self._weight)
        for _ in range(4 * _PATIENCE):
            self._solver.fail(self.failed)
            self.failed |= self._solver.drive(self.poses())
            self.bar.update()
            if (self._solver.speed()[~self.failed] < _STILL).all() and (self._normal_force()[~self.failed] > 0.0).all():
                return
        self.failed |= self._solver.speed() >= _STILL

    def _normal_force(self) -> np.ndarray:
        return -self._solver.forces()[:, :, 2].sum(axis=1)
