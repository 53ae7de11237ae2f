"""What every recorded experiment does around its work: a folder, metrics with seed, device, versions and time, and plain errors.

``store`` and ``resumed`` keep the rows of a long run, so that an interrupted one goes on where it stopped.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import tyro

from raytac.device import resolve_device
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, Metric, result_folder, versions, write_atomic, write_metrics

__all__ = ["recorded", "resumed", "run", "store"]

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


def run(main: Callable[[Args], object], options: type[Args]) -> None:
    """Read the command line and do it; a mistake of the user's ends with one line."""
    try:
        main(tyro.cli(options))
    except RaytacError as error:
        sys.exit(f"error: {error}")


def store(path: Path, settings: Mapping[str, object], rows: Sequence[Mapping[str, object]]) -> None:
    """Keep the rows of a run with its settings; the file is replaced in one move."""
    write_atomic(path, json.dumps({"settings": settings, "rows": rows}, indent=1).encode())


def resumed(path: Path, settings: Mapping[str, object]) -> list[dict[str, Any]]:
    """Rows that an earlier run stored; empty if there is none.

    Raises:
        InputError: it is of a run with other settings, or damaged.
    """
    if not path.exists():
        return []
    try:
        record = json.loads(path.read_text("utf-8"))
        kept, rows = record["settings"], list(record["rows"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("out", value=path, rule=f"is no record of such a run ({error}): move it away") from error
    if kept != settings:
        raise InputError("out", value=path, rule=f"holds a run with other settings, {kept}: choose another")
    return rows
