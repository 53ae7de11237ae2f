"""The reader itself: units, intervals, and which error comes first."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytac.checks import Interval
from raytac.errors import SpecError
from raytac.specs.toml import Integer, Number, Table, Text, read_toml, split_unit

SCHEMA = {"thickness_mm": Number("(0, 50]"), "radius_mm": Number("[1, inf]", length=2), "rows": Integer("[0, 9]"), "name": Text()}
GOOD = {"thickness_mm": 4.0, "radius_mm": [210, math.inf], "rows": 3, "name": "mini"}


def table(**changes: object) -> Table:
    return Table({**GOOD, **changes}, Path("pad.toml"), "gelpad")


def test_values_come_out_in_si_without_the_unit_in_the_name() -> None:
    assert table().read(SCHEMA) == {"thickness": 0.004, "radius": (0.21, math.inf), "rows": 3, "name": "mini"}


@pytest.mark.parametrize(
    ("key", "name", "si"),
    [
        ("size_mm", "size", 0.002),
        ("youngs_modulus_kpa", "youngs_modulus", 2000.0),
        ("twist_deg", "twist", math.pi / 90),
        ("density_kg_m3", "density", 2.0),
        ("mass_kg", "mass", 2.0),
        ("duration_s", "duration", 2.0),
        ("force_n", "force", 2.0),
        ("resolution_px", "resolution", 2.0),
        ("power_w_per_sr", "power", 2.0),
        ("scale_m_per_unit", "scale", 2.0),
        ("friction", "friction", 2.0),
        ("lights", "lights", 2.0),
    ],
)
def test_every_unit(key: str, name: str, si: float) -> None:
    bare, unit = split_unit(key)
    assert bare == name
    assert unit.to_si(2.0) == pytest.approx(si, rel=1e-15)


@given(st.integers(-(10**6), 10**6))
def test_whole_millimetres_give_the_float_nearest_to_the_decimal(millimetres: int) -> None:
    assert split_unit("x_mm")[1].to_si(float(millimetres)) == float(f"{millimetres}e-3")


@pytest.mark.parametrize(
    ("text", "inside", "outside"),
    [
        ("[0, 1]", (0.0, 1.0), (-1e-9, 1.0000001, math.nan, math.inf)),
        ("(0, 1)", (1e-12, 0.5), (0.0, 1.0, math.nan)),
        ("[5, inf]", (5.0, math.inf), (4.9, -math.inf, math.nan)),
        ("[5, inf)", (5.0, 1e300), (math.inf,)),
        ("[-500, 0)", (-500.0, -1e-9), (0.0, -501.0)),
    ],
)
def test_interval(text: str, inside: tuple[float, ...], outside: tuple[float, ...]) -> None:
    interval = Interval.parse(text)
    assert all(value in interval for value in inside)
    assert not any(value in interval for value in outside)


def test_an_interval_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="not of the form"):
        Interval.parse("0..1")


@pytest.mark.parametrize(
    ("key", "value", "rule"),
    [
        ("thickness_mm", 0.0, "must be a number in (0, 50] mm"),
        ("thickness_mm", 50.1, "must be a number in (0, 50] mm"),
        ("thickness_mm", math.nan, "must be a number in (0, 50] mm"),
        ("thickness_mm", math.inf, "must be a number in (0, 50] mm"),
        ("thickness_mm", "4", "must be a number in (0, 50] mm"),
        ("thickness_mm", True, "must be a number in (0, 50] mm"),
        ("thickness_mm", 10**400, "must be a number in (0, 50] mm"),
        ("thickness_mm", [4.0], "must be a number in (0, 50] mm"),
        ("radius_mm", 5.0, "must be 2 numbers, each in [1, inf] mm"),
        ("radius_mm", [5.0], "must be 2 numbers, each in [1, inf] mm"),
        ("radius_mm", [5.0, "x"], "must be 2 numbers, each in [1, inf] mm"),
        ("radius_mm", [5.0, math.nan], "must be 2 numbers, each in [1, inf] mm"),
        ("rows", 3.0, "must be a whole number in [0, 9]"),
        ("rows", True, "must be a whole number in [0, 9]"),
        ("rows", 10, "must be a whole number in [0, 9]"),
        ("name", "", "must be a non-empty string"),
        ("name", 3, "must be a non-empty string"),
    ],
)
def test_a_bad_value_names_file_key_value_and_rule(key: str, value: object, rule: str) -> None:
    with pytest.raises(SpecError) as caught:
        table(**{key: value}).read(SCHEMA)
    error = caught.value
    assert (error.file, error.key, error.value, error.rule) == (Path("pad.toml"), f"gelpad.{key}", value, rule)
    shown = repr(value)
    assert str(error).startswith(f"pad.toml: gelpad.{key} = {shown if len(shown) <= 80 else shown[:79] + '…'}: {rule}")


def test_a_misspelt_key_is_called_unknown_and_not_missing() -> None:
    data = {("thicknes_mm" if key == "thickness_mm" else key): value for key, value in GOOD.items()}
    with pytest.raises(SpecError) as caught:
        Table(data, Path("pad.toml"), "gelpad").read(SCHEMA)
    assert str(caught.value) == (
        "pad.toml: gelpad.thicknes_mm: unknown key; did you mean 'thickness_mm'? choose from: thickness_mm, radius_mm, rows, name"
    )


def test_a_missing_key_says_what_it_must_be() -> None:
    data = {key: value for key, value in GOOD.items() if key != "thickness_mm"}
    with pytest.raises(SpecError) as caught:
        Table(data, Path("pad.toml"), "gelpad").read(SCHEMA)
    assert str(caught.value) == "pad.toml: gelpad.thickness_mm: missing key: must be a number in (0, 50] mm"


def test_a_default_stands_in_for_a_missing_key() -> None:
    assert Table({}, Path("a.toml")).read({"mass_kg": Number("(0, 1]", default=0.1)}) == {"mass": 0.1}


def test_choices_are_listed_with_the_closest() -> None:
    with pytest.raises(SpecError, match="did you mean 'slab'\\? choose from: none, slab"):
        Table({"model": "slap"}, Path("a.toml")).read({"model": Text(choices=("none", "slab"))})


@pytest.mark.parametrize(
    ("data", "rule"),
    [({}, "missing table [pad]"), ({"pad": 3}, "must be a table [pad]"), ({"pad": [{}]}, "must be a table [pad]")],
)
def test_a_section_must_be_a_table(data: dict[str, object], rule: str) -> None:
    with pytest.raises(SpecError) as caught:
        Table(data, Path("a.toml")).section("pad")
    assert (caught.value.key, caught.value.rule) == ("pad", rule)


def test_sections_must_be_an_array_of_tables() -> None:
    assert Table({}, Path("a.toml")).sections("led") == ()
    with pytest.raises(SpecError, match=r"a.toml: led = \[1\]: must be an array of tables \[\[led\]\]"):
        Table({"led": [1]}, Path("a.toml")).sections("led")


@pytest.mark.parametrize("content", [b"a = ", b"\xff\xfe", b"a = 1\na = 2", b"a = " + b"[" * 20000])
def test_what_is_not_toml_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(SpecError, match=r"bad\.toml: the file is not valid TOML"):
        read_toml(path)


def test_a_file_that_cannot_be_opened_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="does not exist"):
        read_toml(tmp_path / "none.toml")
    with pytest.raises(SpecError, match="cannot be read"):
        read_toml(tmp_path)
