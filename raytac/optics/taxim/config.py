"""Configuration of the Taxim table. Importing it loads no renderer."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from raytac.errors import InputError
from raytac.optics.base import OpticsConfig, Variant, check_shadows
from raytac.specs.sensor import SensorSpec

if TYPE_CHECKING:
    from raytac.optics.taxim.table import PolyTable


@dataclass(frozen=True)
class Taxim(OpticsConfig[Any]):
    """A Taxim table: colour by a polynomial for each slope, shadows from a table."""

    calibration: str | Path | PolyTable | None = None
    """A table, a calibration folder, or None: baked from this sensor's ray tracer at first use.

    The sensor's lights matter only then. The table's image is laid over the whole image."""
    shadows: bool | None = None
    """Cast shadows from the table's list.

    None: those of a calibration folder as the sensor says; a baked table casts none, since they bring it no nearer to
    the ray tracer (docs/measurements/image-modes.md).
    """

    def __post_init__(self) -> None:
        check_shadows(self.shadows)
        if not (self.calibration is None or isinstance(self.calibration, (str, Path)) or hasattr(self.calibration, "gradients")):
            rule = f"must be a PolyTable, a calibration folder or None, not {type(self.calibration).__name__}"
            raise InputError("calibration", value=self.calibration, rule=rule)

    def check(self, spec: SensorSpec) -> None:
        if isinstance(self.calibration, (str, Path)):
            from raytac.optics.taxim.folder import load_calibration

            load_calibration(self.calibration)

    def bake(self, spec: SensorSpec, device: str) -> None:
        if self.calibration is None:
            from raytac.optics.taxim.bake.bake import baked_table

            baked_table(spec, device=device)

    def bake_renders(self, spec: SensorSpec) -> int:
        from raytac.optics.taxim.bake.settings import BakeSettings
        from raytac.optics.taxim.cache import table_folder

        settings = BakeSettings()
        folder = table_folder(spec, settings, 0, spec.camera.resolution)
        is_there = self.calibration is not None or (folder is not None and folder.is_dir())
        return 0 if is_there else settings.renders(spec.optics.shadows)

    def maker(self) -> Any:
        return import_module("raytac.optics.taxim.mode").TaximMode

    @classmethod
    def variants(cls) -> tuple[Variant, ...]:
        return (
            Variant("taxim", "Taxim table", "table", cls(shadows=False), slow=True),
            Variant("taxim_shadow", "Taxim table with shadow", "+ shadow", cls(shadows=True), slow=True),
        )
