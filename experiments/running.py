"""What every recorded experiment does around its work: a folder, metrics with seed, device, versions and time, and plain errors."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import tyro

from raytac.device import resolve_device
from raytac.errors import RaytacError
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.io.options import CommonOptions

__all__ = ["recorded", "run"]

Args = TypeVar("Args", bound=CommonOptions)


@contextmanager
def recorded(args: CommonOptions, name: str) -> Iterator[tuple[Path, dict[str, Metric]]]:
    """The folder of a run, ``runs/NAME`` where the arguments say nothing else, and its metrics, to be filled.

    ``metrics.json`` is written when the block ends well; after an error nothing is left.
    """
    start = time.perf_counter()
    out = args.out if args.out is not None else Path("runs") / name
    device = resolve_device(args.device, ray_tracing=False)  # the solver's
    metrics: dict[str, Metric] = {"experiment": name, "seed": args.seed, "device": device}
    with result_folder(out) as folder:
        yield folder, metrics
        write_metrics(folder / "metrics.json", metrics | versions() | {"wall_s": time.perf_counter() - start})
    print(f"written: {out}")


def run(main: Callable[[Args], None], options: type[Args]) -> None:
    """Read the command line and do it; a mistake of the user's ends with one line."""
    try:
        main(tyro.cli(options))
    except RaytacError as error:
        sys.exit(f"error: {error}")
