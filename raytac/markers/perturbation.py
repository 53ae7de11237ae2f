"""What a real marker tracker adds: noise of the found centres, lost dots, and a gel that was not put in straight. All seeded."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from raytac.errors import InputError

__all__ = ["MarkerPerturbation", "Perturber"]


@dataclass(frozen=True)
class MarkerPerturbation:
    """Sizes of the perturbations; all 0 is none.

    The simulators of the ViTac challenges use 0.5 px, 1 %, 1 mm and 0.1 rad (peers' released settings).
    """

    noise_px: float = 0.0
    """Standard deviation of every found centre along u and v, each frame [px of the image]."""
    dropout: float = 0.0
    """Probability that a marker is lost in a frame, in [0, 1)."""
    shift: float = 0.0
    """Pattern shifted by up to this along x and y, uniform, drawn at every reset of an environment [m]."""
    turn: float = 0.0
    """Pattern turned about the pad's centre by up to this, uniform, drawn with the shift [rad]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0.0) or (field.name == "dropout" and value >= 1.0):
                rule = "must be a probability in [0, 1)" if field.name == "dropout" else "must be finite and >= 0"
                raise InputError(field.name, value=value, rule=rule)

    @property
    def moves_pattern(self) -> bool:
        return self.shift > 0 or self.turn > 0


class Perturber:
    """Random streams, one an environment, so that what one draws does not depend on how many there are."""

    def __init__(self, settings: MarkerPerturbation, seed: int, batch: int) -> None:
        self.settings = settings
        self._streams = [np.random.default_rng((seed, env)) for env in range(batch)]

    def reseed(self, env: int, seed: int) -> None:
        """Start the stream of an environment anew; environment 0 of a perturber that was made with this seed has the same."""
        self._streams[env] = np.random.default_rng((seed, 0))

    def placement(self, env: int) -> tuple[np.ndarray, float]:
        """A new shift (2,) [m] and turn [rad] of an environment's pattern."""
        draw = self._streams[env].uniform(-1.0, 1.0, 3)
        return self.settings.shift * draw[:2], float(self.settings.turn * draw[2])

    def noise(self, count: int) -> np.ndarray | None:
        """Errors of the found centres [px], (B, M, 2); None without noise."""
        if self.settings.noise_px == 0:
            return None
        return self.settings.noise_px * np.stack([stream.standard_normal((count, 2)) for stream in self._streams])

    def visible(self, count: int) -> np.ndarray | None:
        """Which markers are found, (B, M), bool; None where none is lost."""
        if self.settings.dropout == 0:
            return None
        return np.stack([stream.random(count) >= self.settings.dropout for stream in self._streams])
