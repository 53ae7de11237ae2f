"""The library keeps its order and speaks plainly: no circles, docstrings that say what a thing is, the words of docs/glossary.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from experiments import house

ROOT = Path(__file__).parents[1]
NAMES = {"found", "way", "borne", "told", "anew", "askew"}
PROSE = re.compile(r"\b(borne|anew|askew|simulated\s+pads?)\b", re.IGNORECASE)
NOT_PROSE = {"docs/glossary.md"}
"""The glossary names the words that it replaces."""


@pytest.fixture(scope="module")
def measured() -> tuple[dict[str, int], dict[str, list[str]]]:
    """Counts of the library, and what was counted; its files are parsed once for all tests."""
    return house.measure(ROOT)


def test_the_library_keeps_its_order(measured: tuple[dict[str, int], dict[str, list[str]]]) -> None:
    """No circles, a mode in one file, and few small files that one module imports."""
    counts, details = measured
    assert details["circles"] == []
    assert details["mode_files"] == [str(house.EXAMPLE)]
    assert counts["words"] <= 30, details["words"]
    assert counts["single_importer_small_files"] <= 25, details["single_importer_small_files"]


def test_docstrings_begin_with_no_question_word(measured: tuple[dict[str, int], dict[str, list[str]]]) -> None:
    wrong = measured[1]["docstrings_wh"]
    assert not wrong, "begin with a noun phrase, an imperative verb or 'True if':\n" + "\n".join(wrong)


def test_docstrings_begin_with_one_short_line(measured: tuple[dict[str, int], dict[str, list[str]]]) -> None:
    wrong = measured[1]["docstrings_long"]
    assert not wrong, f"first lines of at most {house.LONG_LINE} characters:\n" + "\n".join(wrong)


def test_names_say_what_they_hold(measured: tuple[dict[str, int], dict[str, list[str]]]) -> None:
    assert set(house.WORDS) > NAMES
    wrong = [name for name in measured[1]["words"] if name.rpartition(" ")[2].strip("_") in NAMES]
    assert not wrong, "name the result, direction, displacement or path instead:\n" + "\n".join(wrong)


def test_documents_use_the_words_of_the_glossary() -> None:
    files = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    wrong = [
        f"{name}: {match[0]!r}"
        for name, path in ((path.relative_to(ROOT).as_posix(), path) for path in files)
        if name not in NOT_PROSE
        for match in PROSE.finditer(path.read_text(encoding="utf-8"))
    ]
    assert not wrong, "docs/glossary.md has the words to use:\n" + "\n".join(wrong)
