"""Write a folder of results so that an interrupt leaves nothing half-written."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from raytac.errors import InputError

__all__ = ["result_folder"]


@contextmanager
def result_folder(out: Path, owned: Iterable[str] = ()) -> Iterator[Path]:
    """Give a temporary folder beside ``out``; when the block ends well, move its files into ``out``, else delete them.

    A file of the same name in ``out`` is replaced. ``owned`` names every file that the command may write: those of an earlier run
    that this one does not write are removed, so that a folder never mixes two runs. All others stay. ``metrics.json`` moves last:
    where it is, the rest is complete.

    Raises:
        InputError: ``out`` is a file, or its folder cannot be written.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError("out", value=out, rule="must be a folder, and a file of that name exists")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    except OSError as error:
        raise InputError("out", value=out, rule=f"must be a folder that can be written ({error.strerror})") from error
    try:
        yield work
        out.mkdir(exist_ok=True)
        written = {path.name for path in work.iterdir()}
        # The old metrics.json goes first: while the files are of two runs, none says that they are complete.
        for name in ("metrics.json", *(name for name in owned if name not in written)):
            if name in written or name in owned:
                (out / name).unlink(missing_ok=True)
        for path in sorted(work.iterdir(), key=lambda path: path.name == "metrics.json"):
            os.replace(path, out / path.name)
    finally:
        shutil.rmtree(work, ignore_errors=True)
