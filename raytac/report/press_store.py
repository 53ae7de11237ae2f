"""Finished presses of the soft pad on disk, so that an interrupted calibration goes on."""

from __future__ import annotations

import hashlib
import importlib.util
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from raytac.gel.coat_mesh import CoatMesh, DeformedCoat
from raytac.io.arrays import npz_bytes
from raytac.io.code_digest import code_digest
from raytac.io.metrics import versions
from raytac.io.seal import read_sealed, write_sealed
from raytac.markers.calibration_presses import Press, PressStates
from raytac.specs.sensor import GelpadSpec

_CODE = ("ipc", "raytac.physics")
"""Packages of which every module may change what a press does."""


class PressStore:
    """One ``.npz`` a press, under a digest of gelpad, press, level, device, code and versions."""

    def __init__(
        self, folder: Path, gelpad: GelpadSpec, *, pad: str, device: str, code: str, say: Callable[[str], object] = print
    ) -> None:
        """``code``: see ``press_code``; ``say`` tells of presses that cannot be used."""
        self.folder, self._say = Path(folder), say
        self.reused = 0
        """Presses that were read and not damaged."""
        self._basis = repr((gelpad, pad, device, code, versions(("numpy", "warp-lang"))))

    def read(self, press: Press) -> PressStates | None:
        """The states of a press, or None if they are not kept or their file is damaged."""
        path = self._path(press)
        if not path.is_file():
            return None
        try:
            with np.load(io.BytesIO(read_sealed(path)), allow_pickle=False) as kept:
                mesh = CoatMesh(*(kept[name] for name in ("rest", "faces", "lines_x", "lines_y")))
                states = PressStates(tuple(kept["loads"].tolist()), kept["poses"], DeformedCoat(mesh, kept["positions"]))
        except (OSError, ValueError) as error:
            self._say(f"{path.name} cannot be used ({error}): pressed again")
            return None
        self.reused += 1
        return states

    def write(self, press: Press, states: PressStates) -> None:
        """Keep the states of a press, with a digest, so that damage is seen."""
        mesh = states.coat.mesh
        arrays = {name: getattr(mesh, name) for name in ("rest", "faces", "lines_x", "lines_y")}
        arrays |= {"loads": np.array(states.loads), "poses": states.poses, "positions": states.coat.positions}
        write_sealed(self._path(press), npz_bytes(arrays))

    def _path(self, press: Press) -> Path:
        return self.folder / f"{press.name}-{hashlib.sha256((self._basis + repr(press)).encode()).hexdigest()[:20]}.npz"


def press_code() -> str:
    """Digest of the source code that a press depends on: its own, solver and physics."""
    return code_digest("raytac.markers.calibration_presses", *_modules())


def _modules() -> list[str]:
    """Names of all modules of the packages ``_CODE``; none is run but their ``__init__``."""
    names = []
    for package in _CODE:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
            for path in sorted(Path(folder).rglob("*.py")):
                parts = path.relative_to(folder).with_suffix("").parts
                names.append(".".join((package, *(part for part in parts if part != "__init__"))))
    return names
