"""All hard cases by name."""

from __future__ import annotations

from collections.abc import Callable

from tests.ipc.hard import gels, machines, piles, scenes
from tests.ipc.hard.run import Setup, Worst

CASES: dict[str, Callable[[Setup], Worst]] = {**scenes.CASES, **piles.CASES, **machines.CASES, **gels.CASES}
