"""metrics.json is flat, finite and complete, or it is not written."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.io.metrics import check_metrics, read_metrics, versions, write_metrics

GOOD = {"device": "cpu", "wall_s": 1.5, "versions.raytac": "0.1.0"}


def test_numbers_of_numpy_become_plain_json(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    write_metrics(path, GOOD | {"fast.cpu.320x240.fps": np.float32(30.5), "n": np.int64(3)})
    values = json.loads(path.read_text())
    assert values["fast.cpu.320x240.fps"] == 30.5
    assert values["n"] == 3 and isinstance(values["n"], int)
    assert read_metrics(path) == values


@pytest.mark.parametrize("value", [True, None, [1], {"a": 1}, math.nan, math.inf, np.bool_(True), np.zeros(2), 1j])
def test_values_that_are_not_finite_numbers_or_text_are_refused(tmp_path: Path, value: object) -> None:
    with pytest.raises(InputError, match=r"metrics\['bad\.key'\]"):
        write_metrics(tmp_path / "metrics.json", GOOD | {"bad.key": value})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("key", ["", "a..b", ".a", "a.", "a b", "a/b", 3])
def test_keys_are_dotted_words(key: object) -> None:
    with pytest.raises(InputError, match="metrics key"):
        check_metrics(GOOD | {key: 1})  # type: ignore[dict-item]


@pytest.mark.parametrize("missing", list(GOOD))
def test_device_wall_time_and_versions_are_required(missing: str) -> None:
    with pytest.raises(InputError, match=missing.split(".")[0]):
        check_metrics({key: value for key, value in GOOD.items() if key != missing})


@pytest.mark.parametrize("text", ["[1, 2]", "{", '{"device": "cpu"}'])
def test_reading_checks_too(tmp_path: Path, text: str) -> None:
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(InputError):
        read_metrics(tmp_path / "metrics.json")


def test_versions_name_what_is_installed_and_leave_out_what_is_not() -> None:
    found = versions(("numpy", "no-such-distribution"))
    assert found["versions.numpy"] == np.__version__
    assert {"versions.python", "versions.raytac"} <= set(found)
    assert "versions.no-such-distribution" not in found
