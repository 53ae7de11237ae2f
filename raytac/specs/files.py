"""Files of sensors, lights, marker motions, scenes and sweeps, by name or path."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Final

from raytac.assets import AssetKind, asset_root
from raytac.errors import SpecError

_FOLDERS: Final[dict[str, tuple[AssetKind, str]]] = {
    "sensor": ("scenes", "sensors"),
    "press scene": ("scenes", "press"),
    "task scene": ("scenes", "tasks"),
    "lights": ("lights", ""),
    "sweep": ("scenes", "sweeps"),
    "marker motion": ("scenes", "markers"),
}


def available(what: str) -> tuple[str, ...]:
    """Names of the shipped files of a kind, such as ``"sensor"`` or ``"press scene"``."""
    return tuple(sorted(path.stem for path in _folder(what).glob("*.toml")))


def find_file(what: str, name_or_path: str | Path, *, base: Path | None = None) -> Path:
    """Absolute path of the TOML file that ``name_or_path`` means.

    A bare word (``coin``) is a shipped file. Anything with a folder or the suffix ``.toml`` is a path: relative to ``base``, or,
    with no ``base``, to the working directory first and then to the folder that holds the shipped ``scenes/`` and ``lights/``, so
    that ``scenes/press/coin.toml`` means the same inside and outside a checkout; a warning says when the shipped file was taken.

    Raises ``SpecError``: no such name (the message lists those there are), or no such file.
    """
    if not isinstance(name_or_path, (str, Path)):
        raise SpecError(f"must be a name or a path, not {type(name_or_path).__name__}", key=what, value=name_or_path)
    text = str(name_or_path)
    if isinstance(name_or_path, str) and not text.endswith(".toml") and not set(text) & {"/", "\\"}:
        names = available(what)
        if text not in names:
            raise SpecError("no shipped file of this name, and not a path to a .toml file", key=what, value=text, choices=names)
        return _folder(what) / f"{text}.toml"
    try:
        path = Path(name_or_path).expanduser()
    except RuntimeError as error:  # "~nobody/x.toml"
        raise SpecError(f"the path has no meaning here ({error})", key=what, value=text) from error
    candidates = [base / path] if base is not None else [Path.cwd() / path, asset_root(_FOLDERS[what][0]).parent / path]
    for candidate in candidates:
        if is_file(candidate):
            if candidate is not candidates[0]:
                warnings.warn(
                    f"{text} is not in {Path.cwd()}: taking the {what} that comes with raytac, {candidate}", stacklevel=3
                )
            return candidate.resolve()
    shipped = ", and none of this path comes with raytac" if base is None and not path.is_absolute() else ""
    raise SpecError(f"the file does not exist{shipped}", file=candidates[0], key=what, value=text)


def name_of(path: Path) -> str:
    """Stem of a file as text that can be written anywhere; bytes not UTF-8 as ``\\udcXX``."""
    return path.stem.encode("utf-8", "backslashreplace").decode()


def is_file(path: Path) -> bool:
    """True if there is such a file; False too for a path that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _folder(what: str) -> Path:
    kind, folder = _FOLDERS[what]
    return asset_root(kind) / folder
