"""Which environments of a batch are meant."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from raytac.errors import InputError

__all__ = ["chosen_envs", "rounded_envs"]


def rounded_envs(envs: list[int], batch: int) -> list[int]:
    """The same with the last of them named again, up to a power of two or ``batch``: kernels are recorded for each number of rows."""
    count = min(1 << max(len(envs) - 1, 0).bit_length(), batch)
    return [*envs, *envs[-1:] * (count - len(envs))]


def chosen_envs(envs: ArrayLike | None, batch: int) -> list[int]:
    """Numbers of the environments that a mask (B,) or a list names, in its order; None names all.

    Raises:
        InputError: an environment that does not exist, numbers that are not whole, or a mask of the wrong length.
    """
    if envs is None:
        return list(range(batch))
    try:
        chosen = np.asarray(envs)
    except ValueError as error:  # lists of several lengths
        raise InputError("envs", value=envs, rule=f"must name environments 0 to {batch - 1}") from error
    if chosen.dtype == bool:
        if chosen.shape != (batch,):
            raise InputError("envs", value=chosen.shape, rule=f"a mask must have shape ({batch},)")
        return np.flatnonzero(chosen).tolist()
    if chosen.size == 0:
        return []
    if not np.issubdtype(chosen.dtype, np.integer) or chosen.min() < 0 or chosen.max() >= batch:
        raise InputError("envs", value=chosen.tolist(), rule=f"must name environments 0 to {batch - 1}")
    return chosen.ravel().tolist()
