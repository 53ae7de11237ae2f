"""Interface of every physics of the gel: a configuration builds a pad, which gives readings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Any, ClassVar, Protocol, TypedDict, Unpack

import numpy as np

from raytac.gel.contact_shear import ContactShear
from raytac.gel.surface import GelSurface, PadGrid
from raytac.shapes.part import Part
from raytac.specs.press import PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

OfSurface = np.ndarray | Callable[[GelSurface], np.ndarray]
"""An array, or a function that computes it from the surface when it is first read."""


class PadReading:
    """B pads of one sensor at one instant, in a press or in a world; pad frame.

    Forces are those of all that touches, on the gel.

    Attributes:
        failed: environments whose physics broke down, (B,), bool; their arrays hold NaN.
        unconverged: steps of the solver since the start that did not meet its tolerance, (B,), int; None without a solver.
        has_forces: False if this is a bare surface, of which nothing else is known.
        pad_from_object: pose of the pressed object, (B, 4, 4). This and the next two are NaN in a world.
        world_from_pad: pose of the case, (B, 4, 4); the identity unless the scene moves it (world and pad frame are one at first touch).
        depth: travel below first touch at zero shear, twist and tilt [m], (B,); negative when lifted.
        force_law_area: area of contact by the law that ties force to depth [m²], (B,); None without such a law.
        solved: what the physics itself knows beyond this, of a type of its own: ``SoftReading`` of a soft pad's press; else None.
        shear: elastic shear of the contact with the body that is deepest; None where the physics has no such state.
    """

    stage: int = -1
    """Index in the scene's trajectory; −1 before the first stage, of other stages, in a world."""
    kind: str = ""
    """Kind of that stage, or ``start``; empty in a world."""
    fraction: float = 1.0
    """Completed part of the stage, in (0, 1]."""
    scene: PressScene | None = None
    """Press scene that the reading belongs to; None in a world."""

    def __init__(
        self,
        surface: GelSurface | Callable[[], GelSurface],
        wrench: OfSurface | None = None,
        failed: np.ndarray | None = None,
        traction: OfSurface | None = None,
        *,
        unconverged: np.ndarray | None = None,
        pad_from_object: np.ndarray | None = None,
        world_from_pad: np.ndarray | None = None,
        depth: np.ndarray | None = None,
        force_law_area: np.ndarray | None = None,
        solved: Any = None,
        shear: ContactShear | None = None,
    ) -> None:
        """Keep what the physics knows; arguments as of the class's attributes.

        A function is called when its value is first read; None says that it is not known.
        """
        self._surface, self._wrench, self._traction, self.has_forces = surface, wrench, traction, wrench is not None
        self.failed = np.zeros(self.surface.batch, bool) if failed is None else failed
        self.unconverged, self.force_law_area = unconverged, force_law_area
        self.solved, self.shear, batch = solved, shear, len(self.failed)
        self.pad_from_object = np.full((batch, 4, 4), np.nan) if pad_from_object is None else pad_from_object
        self.world_from_pad = np.full((batch, 4, 4), np.nan) if world_from_pad is None else world_from_pad
        self.depth = np.full(batch, np.nan) if depth is None else depth

    @cached_property
    def surface(self) -> GelSurface:
        """Gel surface."""
        return self._surface if isinstance(self._surface, GelSurface) else self._surface()

    @cached_property
    def wrench(self) -> np.ndarray:
        """Force on the pad [N], torque about the pad's origin [N m], (B, 6); NaN if not known."""
        if self._wrench is None:
            return np.full((len(self.failed), 6), np.nan)
        return self._wrench(self.surface) if callable(self._wrench) else self._wrench

    def traction(self) -> np.ndarray:
        """Traction on the pad [Pa], (B, Ny, Nx, 3), as ``TactileFrame.traction``; NaN if unknown."""
        if self._traction is None:
            return np.full((*self.surface.height.shape, 3), np.nan, np.float32)
        return self._traction(self.surface) if callable(self._traction) else self._traction

    @property
    def force(self) -> np.ndarray:
        """Force on the pad [N], (B, 3)."""
        return self.wrench[:, :3]

    @property
    def normal_force(self) -> np.ndarray:
        """Force towards −z [N], (B,)."""
        return -self.wrench[:, 2]

    @property
    def shear_force(self) -> np.ndarray:
        """Force along x and y [N], (B, 2)."""
        return self.wrench[:, :2]

    @property
    def twist_torque(self) -> np.ndarray:
        """Torque about +z at the contact's centre [N m], (B,)."""
        x, y = np.nan_to_num(self.surface.contact_centre).T
        return self.wrench[:, 5] - (x * self.wrench[:, 1] - y * self.wrench[:, 0])

    def of(self, envs: Sequence[int] | np.ndarray) -> PadReading:
        """The same of the environments named, one row each."""
        rows, surface, wrench = np.asarray(envs), self.surface.rows(envs), self.wrench
        part = copy(self)
        del part.surface, part.wrench  # cached of all environments
        part._surface = surface
        part._wrench, part._traction = wrench[rows], lambda _: self.traction()[rows]
        for name in ("failed", "unconverged", "pad_from_object", "world_from_pad", "depth", "force_law_area"):
            values = getattr(self, name)
            setattr(part, name, None if values is None else values[rows])
        part.shear = None if self.shear is None else self.shear.of(rows)
        return part


class TargetArrays(TypedDict, total=False):
    """Targets of the B environments of a press, as ``raytac.TactileSensor.load`` says."""

    offsets: np.ndarray | None
    depths: np.ndarray | None
    rotations: np.ndarray | None
    shears: np.ndarray | None
    twists: np.ndarray | None


class Pad(Protocol):
    """The gel with the object of a press scene before it; ``PressPad`` has what all pads share."""

    scene: PressScene
    grid: PadGrid
    """Nodes of its surfaces."""
    parts: tuple[Part, ...]
    """Shape of the object; empty without one."""

    def run(self, steps_per_stage: int = 1, *, progress: bool = False) -> Iterator[PadReading]:
        """Readings along the trajectory: one before it, then ``steps_per_stage`` through each stage."""
        ...

    def follow(self, stage: StageSpec, steps: int = 1) -> Iterator[PadReading]:
        """Readings along one more stage, from wherever the pad is now."""
        ...

    def peak(self, readings: Iterable[PadReading]) -> PadReading:
        """First of ``readings`` at the end of the scene's peak stage."""
        ...

    def object_height(self, surface: GelSurface) -> np.ndarray | None:
        """Underside of the object [m], (B, Ny, Nx), inf where it is not; None without an object."""
        ...


class PhysicsConfig(Protocol):
    """Configuration of one physics: a frozen dataclass that checks itself.

    ``raytac.physics.register`` makes it known by a name. A field ``level`` that is None is filled with the scene's, else
    ``coarse``.
    """

    is_simulated: ClassVar[bool]
    """True if a solver has the gel as a mesh.

    Then surfaces have a coat, the solver runs on the device that is asked for, and a world's bodies may belong to it.
    """

    @property
    def label(self) -> str:
        """Name for headers and reports."""
        ...

    def build(
        self, spec: SensorSpec, press: PressScene, *, pitch: float, num_envs: int, device: str, **own: Unpack[TargetArrays]
    ) -> Pad:
        """The pad of a press.

        Args:
            pitch: spacing of the grid of surfaces [m].
            device: ``auto``, ``cpu`` or ``cuda``.
            own: targets of B environments, see ``PressTargets``.

        Raises:
            BackendError: what it needs is not installed or does not work here.
            RaytacError: the scene and the sensor do not go together.
        """
        ...
