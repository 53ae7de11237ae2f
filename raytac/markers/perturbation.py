"""Seeded perturbations of a marker tracker: noise, lost dots, a gel mounted with an offset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from raytac.checks import is_number
from raytac.errors import InputError


@dataclass(frozen=True)
class MarkerPerturbation:
    """Sizes of the perturbations; all 0 is none.

    The simulators of the ViTac challenges use 0.5 px, 1 %, 1 mm and 0.1 rad (peers' released settings).
    """

    noise_px: float = 0.0
    """Standard deviation of every detected centre along u and v, each frame [px of the image]."""
    dropout: float = 0.0
    """Probability that a marker is lost in a frame, in [0, 1)."""
    shift: float = 0.0
    """Largest shift of the pattern along x and y [m]; uniform, drawn at every reset."""
    turn: float = 0.0
    """Largest rotation of the pattern about the pad's centre [rad]; drawn with the shift."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (is_number(value) and 0.0 <= value < (1.0 if field.name == "dropout" else np.inf)):
                rule = "must be a probability in [0, 1)" if field.name == "dropout" else "must be finite and >= 0"
                raise InputError(field.name, value=value, rule=rule)

    @property
    def moves_pattern(self) -> bool:
        return self.shift > 0 or self.turn > 0


class Perturber:
    """Random streams, one an environment: its draws do not depend on their number."""

    def __init__(self, settings: MarkerPerturbation, seed: int, batch: int) -> None:
        self.settings = settings
        self._streams = [np.random.default_rng((seed, env)) for env in range(batch)]

    def reseed(self, env: int, seed: int) -> None:
        """Restart the stream of an environment, as that of environment 0 with this seed."""
        self._streams[env] = np.random.default_rng((seed, 0))

    def placement(self, env: int) -> tuple[np.ndarray, float]:
        """Shift (2,) [m] and rotation [rad] of an environment's pattern, drawn now."""
        draw = self._streams[env].uniform(-1.0, 1.0, 3)
        return self.settings.shift * draw[:2], float(self.settings.turn * draw[2])

    def noise(self, count: int, envs: Sequence[int] | None = None) -> np.ndarray | None:
        """Errors of centres [px], (n, M, 2), of ``envs`` (None: all); None without noise."""
        if self.settings.noise_px == 0:
            return None
        return self.settings.noise_px * self._drawn(lambda stream: stream.standard_normal((count, 2)), envs)

    def visible(self, count: int, envs: Sequence[int] | None = None) -> np.ndarray | None:
        """True for markers that are detected, (n, M), bool; None where none is lost."""
        if self.settings.dropout == 0:
            return None
        return self._drawn(lambda stream: stream.random(count) >= self.settings.dropout, envs)

    def _drawn(self, draw: Callable[[np.random.Generator], np.ndarray], envs: Sequence[int] | None) -> np.ndarray:
        """One draw of each environment, also of one that is named twice."""
        chosen = range(len(self._streams)) if envs is None else envs
        drawn = {b: draw(self._streams[b]) for b in dict.fromkeys(chosen)}
        return np.stack([drawn[b] for b in chosen])
