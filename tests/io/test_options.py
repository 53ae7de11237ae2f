"""Text of the command line to values."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytac.errors import InputError
from raytac.frame import OUTPUTS
from raytac.io.options import parse_outputs, parse_resolution


@given(st.integers(1, 10**5), st.integers(1, 10**5))
def test_resolution_is_width_then_height(width: int, height: int) -> None:
    assert parse_resolution(f"{width}x{height}") == (width, height)


@pytest.mark.parametrize("text", ["", "320", "320x", "x240", "0x240", "320x-1", "320x240x3", "3.5x2", "320×240"])
def test_other_resolutions_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="WIDTHxHEIGHT"):
        parse_resolution(text)


@given(st.lists(st.sampled_from(OUTPUTS), min_size=1))
def test_outputs_come_once_each_in_their_own_order(names: list[str]) -> None:
    parsed = parse_outputs(",".join(names), OUTPUTS)
    assert set(parsed) == set(names) and list(parsed) == sorted(set(names), key=OUTPUTS.index)


@pytest.mark.parametrize("text", ["", ",", "rgb;depth", "colour"])
def test_unknown_outputs_are_refused_with_the_choices(text: str) -> None:
    with pytest.raises(InputError, match="layers, normals"):
        parse_outputs(text, OUTPUTS)
