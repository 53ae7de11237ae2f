"""Folders of the shipped data in a wheel, an editable install or a checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from raytac.errors import AssetError, InputError

AssetKind = Literal["scenes", "lights"]
ASSET_KINDS: tuple[AssetKind, ...] = ("scenes", "lights")


def asset_root(kind: AssetKind) -> Path:
    """Absolute folder of the shipped ``scenes`` or ``lights``.

    Raises:
        InputError: ``kind`` is neither.
        AssetError: the folder is neither in the installed package nor beside it; the message lists where it was looked for.
    """
    return find_asset_root(kind, Path(__file__).resolve().parent)


def find_asset_root(kind: AssetKind, package: Path) -> Path:
    """As ``asset_root``, for the package folder ``package``.

    A wheel holds the data in ``raytac/_assets/<kind>``. In a checkout, which is also what an editable install points at, both
    data folders lie beside ``raytac/``; both are asked for, so that an unrelated ``lights`` package in ``site-packages`` is not
    taken for ours.
    """
    if kind not in ASSET_KINDS:
        raise InputError("kind", value=kind, rule="must be a kind of shipped data", choices=ASSET_KINDS)
    shipped = package / "_assets" / kind
    if shipped.is_dir():
        return shipped
    checkout = package.parent
    if (checkout / "scenes" / "sensors").is_dir() and (checkout / "lights").is_dir():
        return checkout / kind
    raise AssetError(
        f"the data folder {kind}/ is missing: looked for {shipped} (wheel) and for scenes/ and lights/ in {checkout} (checkout); "
        "reinstall raytac, or run it from a complete checkout"
    )
