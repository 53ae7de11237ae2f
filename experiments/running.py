"""Runner of the experiments: a result folder, metrics with seed, device, versions and time, and one line for a mistake of the user's.

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
from raytac.io import VERSIONED, CommonOptions, Metric, result_folder, versions, write_atomic, write_metrics
from raytac.report import machine

__all__ = ["record_of", "recorded", "resumed", "run", "store"]

Args = TypeVar("Args")


@contextmanager
def recorded(
    args: CommonOptions,
    name: str,
    *,
    out: Path | None = None,
    device: str | None = None,
    owned: Sequence[str] = (),
    packages: Sequence[str] = (),
) -> Iterator[tuple[Path, dict[str, Metric]]]:
    """Folder of a run, and its metrics, to be filled in the block.

    ``metrics.json`` is written when the block ends without an error; after an error nothing is left.

    Args:
        args: options of the command line; ``args.out`` is the folder if it is given.
        name: name of the experiment.
        out: folder if ``args.out`` is None; None is ``runs/NAME``.
        device: device that the metrics name; None is the solver's.
        owned: files that the run may write; those that an earlier run left are removed (see ``result_folder``).
        packages: distributions whose versions are recorded, beside the usual ones.
    """
    start = time.perf_counter()
    out = args.out or out or Path("runs") / name
    device = resolve_device(args.device, ray_tracing=False) if device is None else device
    metrics: dict[str, Metric] = {"experiment": name, "seed": args.seed, "device": device, **machine()}
    with result_folder(out, (*owned, "metrics.json") if owned else ()) as folder:
        yield folder, metrics
        metrics |= versions((*VERSIONED, *packages))
        metrics["wall_s"] = time.perf_counter() - start
        write_metrics(folder / "metrics.json", metrics)
    print(f"written: {out}")


def run(main: Callable[[Args], object], options: type[Args], description: str | None = None) -> None:
    """Read the command line and call ``main``; a mistake of the user's ends with one line. ``description`` is that of ``--help``."""
    try:
        main(tyro.cli(options, description=description))
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
    kept, rows = record_of(path, "out")
    if kept != settings:
        raise InputError("out", value=path, rule=f"holds a run with other settings, {kept}: choose another")
    return rows


def record_of(path: Path, name: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Settings and rows that a run stored.

    Raises:
        InputError: there are none, or they are damaged; the error is of the option ``name``.
    """
    try:
        record = json.loads(path.read_text("utf-8"))
        return dict(record["settings"]), list(record["rows"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(name, value=path, rule=f"is no record of such a run ({error}): move it away") from error
