"""The library speaks plainly: docstrings that say what a thing is, and one word for each concept of docs/glossary.md."""

from __future__ import annotations

import ast
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
def library() -> dict[str, list[ast.AST]]:
    """Nodes of every file's syntax tree."""
    return house.parsed(house.modules(ROOT))


def test_docstrings_begin_with_no_question_word(library: dict[str, list[ast.AST]]) -> None:
    wrong = [
        f"{name}: {text.splitlines()[0]}"
        for name, nodes in library.items()
        for text in house.docstrings(nodes)
        if house.QUESTION.match(text)
    ]
    assert not wrong, "begin with a noun phrase, an imperative verb or 'True if':\n" + "\n".join(wrong)


def test_docstrings_begin_with_one_short_line(library: dict[str, list[ast.AST]]) -> None:
    firsts = [(name, text.split("\n", 1)[0]) for name, nodes in library.items() for text in house.docstrings(nodes)]
    wrong = [f"{name}: {first}" for name, first in firsts if len(first) > house.LONG_LINE]
    assert not wrong, f"first lines of at most {house.LONG_LINE} characters:\n" + "\n".join(wrong)


def test_names_say_what_they_hold(library: dict[str, list[ast.AST]]) -> None:
    wrong = [
        f"{name}: {word}" for name, nodes in library.items() for word in house.names_bound(nodes) if word.strip("_") in NAMES
    ]
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
