"""The data folders are found from a wheel and from a checkout, and nothing else is taken for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from raytac.assets import ASSET_KINDS, asset_root, find_asset_root
from raytac.errors import AssetError, InputError


def folders(root: Path, *names: str) -> None:
    for name in names:
        (root / name).mkdir(parents=True)


@pytest.mark.parametrize("kind", ASSET_KINDS)
def test_the_running_package_finds_its_data(kind: Any) -> None:
    root = asset_root(kind)
    assert root.is_absolute()
    assert list(root.rglob("gelsight_mini.toml"))


@pytest.mark.parametrize("kind", ASSET_KINDS)
def test_a_wheel_comes_before_what_lies_beside_it(tmp_path: Path, kind: Any) -> None:
    folders(tmp_path, "raytac/_assets/scenes/sensors", "raytac/_assets/lights", "scenes/sensors", "lights")
    assert find_asset_root(kind, tmp_path / "raytac") == tmp_path / "raytac" / "_assets" / kind


@pytest.mark.parametrize("kind", ASSET_KINDS)
def test_a_checkout(tmp_path: Path, kind: Any) -> None:
    folders(tmp_path, "raytac", "scenes/sensors", "lights")
    assert find_asset_root(kind, tmp_path / "raytac") == tmp_path / kind


def test_another_lights_package_in_site_packages_is_not_ours(tmp_path: Path) -> None:
    folders(tmp_path, "raytac", "lights")
    with pytest.raises(AssetError) as caught:
        find_asset_root("lights", tmp_path / "raytac")
    message = str(caught.value)
    assert message.startswith("the data folder lights/ is missing")
    assert str(tmp_path / "raytac" / "_assets" / "lights") in message and str(tmp_path) in message and "reinstall" in message


def test_an_unknown_kind_lists_the_known(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"kind = 'light': .*did you mean 'lights'\? choose from: scenes, lights"):
        find_asset_root(cast(Any, "light"), tmp_path)
