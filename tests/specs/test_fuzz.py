"""Whatever a file holds, loading it gives a spec or a ``SpecError``, never another exception."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from raytac.errors import SpecError
from raytac.specs import available, load_lights, load_press, load_sensor, validate_press

MINI = load_sensor("gelsight_mini")
SETTINGS = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
SCALAR = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-5, 50),
    st.floats(),
    st.floats(-50, 50),
    st.sampled_from([0.0, 1.0, math.inf, -math.inf, math.nan, "none", "slab", "../lights.toml", "gelsight_mini", ".", "a/b"]),
    TEXT,
    st.datetimes(),
)
VALUE = st.recursive(SCALAR, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=3), max_leaves=6)
NUMBERS = st.lists(st.floats(-60, 60), min_size=1, max_size=4)


def leaves(node: Any, way: str = "") -> list[str]:
    """Dotted paths of everything in a document, tables included."""
    if isinstance(node, dict):
        items = [(f"{way}.{key}" if way else key, value) for key, value in node.items()]
    elif isinstance(node, list) and node and isinstance(node[0], dict):
        items = [(f"{way}[{i}]", value) for i, value in enumerate(node)]
    else:
        return []
    return [path for here, value in items for path in (here, *leaves(value, here))]


def spoil(data: st.DataObject, paths: list[str]) -> dict[str, Any]:
    """One to three changes of values, and perhaps a key that nobody knows."""
    picked = data.draw(st.lists(st.sampled_from(paths), min_size=1, max_size=3, unique=True))
    # A path inside a replaced table would no longer exist.
    picked = [p for p in picked if not any(p != q and p.startswith((f"{q}.", f"{q}[")) for q in picked)]
    changes = {path: data.draw(VALUE | NUMBERS) for path in picked}
    if data.draw(st.booleans()):
        changes[data.draw(st.sampled_from(["gelpd", "x_mm", "colour"]))] = data.draw(VALUE)
    return changes


def loads_or_refuses(load: Callable[[Path], object], path: Path) -> None:
    tomllib.loads(path.read_text("utf-8"))  # the fuzz is in the values, not in the syntax
    try:
        load(path)
    except SpecError as error:
        assert error.rule and error.file is not None and str(error).startswith(str(error.file))


@given(st.data())
@SETTINGS
def test_sensor(make_sensor: Callable[..., Path], data: st.DataObject) -> None:
    paths = leaves(tomllib.loads(make_sensor().read_text("utf-8")))
    loads_or_refuses(load_sensor, make_sensor(spoil(data, paths)))


@given(st.data())
@SETTINGS
def test_lights(make_sensor: Callable[..., Path], data: st.DataObject) -> None:
    paths = leaves(tomllib.loads(make_sensor().with_name("lights.toml").read_text("utf-8")))
    path = make_sensor(lights=spoil(data, paths))
    loads_or_refuses(load_lights, path.with_name("lights.toml"))
    loads_or_refuses(load_sensor, path)


@given(st.data(), st.sampled_from(["sphere", "cylinder", "edge", "cone", "torus", "pins", "coin", "none"]))
@SETTINGS
def test_press(make_press: Callable[..., Path], data: st.DataObject, name: str) -> None:
    paths = leaves(tomllib.loads(make_press(name).read_text("utf-8")))
    loads_or_refuses(lambda path: validate_press(MINI, load_press(path)), make_press(name, spoil(data, paths)))


@given(st.binary(max_size=200))
@SETTINGS
def test_random_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "random.toml"
    path.write_bytes(content)
    for load in (load_sensor, load_lights, load_press):
        with pytest.raises(SpecError):
            load(path)


@given(st.text(max_size=30))
@SETTINGS
def test_random_names(name: str) -> None:
    for what, load in (("sensor", load_sensor), ("lights", load_lights), ("press scene", load_press)):
        if name in available(what):  # Hypothesis draws words of the code too
            continue
        with pytest.raises(SpecError):
            load(name)
