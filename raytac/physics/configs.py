"""Configurations of raytac's own physics; they import neither MuJoCo nor the solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Unpack

from raytac.checks import check_kind, check_known, check_methods
from raytac.device import resolve_device
from raytac.physics.soft.settings import (
    DEFAULT_ACCURACY,
    DEFAULT_CONTROL,
    DEFAULT_CORRECTION,
    Correction,
    PressControl,
    SceneSettings,
)
from raytac.specs.press import PADS, PressScene
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.physics.base import TargetArrays
    from raytac.physics.rigid.pad import RigidPad
    from raytac.physics.soft.mesh import PadMesh
    from raytac.physics.soft.pad import SoftPad


@dataclass(frozen=True)
class Rigid:
    """Rigid pad on MuJoCo: a load law ties force to depth, Gaussians give the gel's surface."""

    is_simulated: ClassVar[bool] = False

    @property
    def label(self) -> str:
        return "rigid"

    def build(
        self,
        spec: SensorSpec,
        press: PressScene,
        *,
        pitch: float,
        num_envs: int = 1,
        device: str = "auto",
        **own: Unpack[TargetArrays],
    ) -> RigidPad:
        """The pad of a press; always on the CPU. See ``PhysicsConfig.build``."""
        from raytac.physics.rigid.pad import RigidPad

        return RigidPad(spec, press, pitch=pitch, num_envs=num_envs, **own)


@dataclass(frozen=True)
class Ipc:
    """Soft pad: the gel solved with contact, friction and large deformation by ``ipc``.

    Raises ``InputError``: an unknown level, or settings of another type.
    """

    level: str | PadMesh | None = None
    """Resolution of the mesh, one of ``PADS``, or a mesh; None: the scene's, else ``coarse``."""
    correction: Correction | None = DEFAULT_CORRECTION
    """Correction of the surface below the cells' size; None: the plain finite-element surface."""
    control: PressControl = DEFAULT_CONTROL
    """Tolerances and search of a press."""
    accuracy: SceneSettings = DEFAULT_ACCURACY
    """Tolerances of a world."""
    is_simulated: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if isinstance(self.level, str):
            check_known("level", self.level, PADS)
        elif self.level is not None:
            check_methods("level", self.level, (), ("tets", "coat"), f"one of {', '.join(PADS)}, or a PadMesh")
        if self.correction is not None:
            check_kind("correction", self.correction, Correction)
        check_kind("control", self.control, PressControl)
        check_kind("accuracy", self.accuracy, SceneSettings)

    @property
    def label(self) -> str:
        level = self.level or PADS[0]
        return f"ipc-{level if isinstance(level, str) else 'own'}"

    def build(
        self,
        spec: SensorSpec,
        press: PressScene,
        *,
        pitch: float,
        num_envs: int = 1,
        device: str = "auto",
        **own: Unpack[TargetArrays],
    ) -> SoftPad:
        """The pad of a press, as ``PhysicsConfig.build``; no ray is traced: CUDA needs no OptiX."""
        from raytac.physics.soft.pad import SoftPad

        device = resolve_device(device, ray_tracing=False)
        return SoftPad(
            spec,
            press,
            level=self.level or PADS[0],
            correction=self.correction,
            control=self.control,
            pitch=pitch,
            num_envs=num_envs,
            device=device,
            **own,
        )
