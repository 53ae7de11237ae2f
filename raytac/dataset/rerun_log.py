"""Episodes as recordings of Rerun, to look at with a time line."""

# pyright: reportMissingImports=false
# (rerun belongs to the extra "rerun".)

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_kind
from raytac.dataset.episode import Episode
from raytac.errors import BackendError
from raytac.io.folder import new_path

_MOST_CURVES = 64
"""Numbers of a frame that are drawn as curves; more are shown as a tensor."""


def write_rerun(path: str | Path, episode: Episode) -> Path:
    """Write an episode as one ``.rrd`` file for ``rerun FILE``; returns its path.

    8-bit images are images, up to 64 numbers of a frame curves, and larger arrays tensors, each under its own name on the time lines
    ``time`` [s] and ``frame``. Task and facts are the text ``about``.

    Raises:
        InputError: no episode, or a file that exists.
        BackendError: the Rerun SDK is not installed.
    """
    check_kind("episode", episode, Episode)
    try:
        import rerun as rr
    except ImportError as error:
        raise BackendError(f"a recording needs the Rerun SDK ({error}): `pip install 'raytac[rerun]'`") from error
    with new_path(path) as partial:
        recording = rr.RecordingStream("raytac")
        recording.save(partial)
        about = [f"{name}: {value}" for name, value in {"task": episode.task, "fps": episode.fps, **episode.facts}.items()]
        recording.log("about", rr.TextDocument("\n".join(about)), static=True)
        for t, seconds in enumerate(episode.time.tolist()):
            recording.set_time("frame", sequence=t)
            recording.set_time("time", duration=seconds)
            for name, values in episode.arrays.items():
                recording.log(name, _shown(rr, values[t]))
        recording.flush()
        recording.disconnect()
    return Path(path)


def _shown(rr: Any, value: np.ndarray) -> Any:
    """One frame of an array as Rerun draws it."""
    if value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] == 3:
        return rr.Image(value)
    if value.size <= _MOST_CURVES and value.ndim <= 1:
        return rr.Scalars(np.atleast_1d(value).astype(np.float64))
    return rr.Tensor(value.astype(np.uint8) if value.dtype == bool else value)
