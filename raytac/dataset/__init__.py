"""Data sets of presses: planned from a sweep, rendered in shards on one machine or on Ray, checked, and read back."""

from __future__ import annotations

from raytac.dataset.arrays import ARRAYS, COLUMNS, DATASET_OUTPUTS
from raytac.dataset.engines import ENGINES
from raytac.dataset.loader import PressDataset
from raytac.dataset.plan import DatasetPlan, Presses
from raytac.dataset.renderer import RenderJob, ShardRenderer, ShardResult
from raytac.dataset.run import Check, RunReport, render_dataset, verify_dataset
from raytac.dataset.sheet import contact_sheet

__all__ = [
    "ARRAYS",
    "COLUMNS",
    "DATASET_OUTPUTS",
    "ENGINES",
    "Check",
    "DatasetPlan",
    "PressDataset",
    "Presses",
    "RenderJob",
    "RunReport",
    "ShardRenderer",
    "ShardResult",
    "contact_sheet",
    "render_dataset",
    "verify_dataset",
]
