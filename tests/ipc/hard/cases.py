"""All hard cases by name and by group."""

from __future__ import annotations

from collections.abc import Callable

from tests.ipc.hard import gels, machines, piles, scenes
from tests.ipc.hard.run import Setup, Worst

GROUPS: dict[str, dict[str, Callable[[Setup], Worst]]] = {
    "basic": scenes.CASES,
    "piles": piles.CASES,
    "machines": machines.CASES,
    "gels": gels.CASES,
}
CASES: dict[str, Callable[[Setup], Worst]] = {name: case for group in GROUPS.values() for name, case in group.items()}
