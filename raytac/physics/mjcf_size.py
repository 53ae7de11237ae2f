"""Size of a MuJoCo model, read from its XML before compiling, which takes what that asks."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator
from pathlib import Path

from raytac.errors import InputError

MOST_COPIES = 100_000
"""Copies that nested ``replicate``, ``composite`` and ``flexcomp`` elements may make."""
MOST_NODES = 2**22
"""Nodes of a height field."""
_LARGEST = 2**26
"""Longest file [byte]."""
_DEEPEST = 200
"""Elements within each other."""
_COPIERS = ("replicate", "composite", "flexcomp")
# As lenient as MuJoCo's own reader, which takes what a strict one does not, such as two hyphens in a comment. Each is read in a time
# in proportion to the text, whatever the text is: what is not closed goes to the end, and nothing is tried again in a shorter form.
_TOKEN = re.compile(
    r"<!--(?:.*?-->|.*)|<!\[CDATA\[(?:.*?\]\]>|.*)|<\?(?:.*?\?>|.*)|<![^>]*+"
    r"|<(?P<slash>/?)(?P<name>[^\s<>/!?\"']++)(?P<rest>(?:[^<>\"']++|\"[^\"]*+\"|'[^']*+')*+)>",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"(?<![^\s=\"'])([^\s=\"']++)\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')")


def check_mjcf_size(path: str | Path) -> None:
    """Refuse a model that asks, with its includes, for more copies or nodes than the limits.

    Raises:
        InputError: the model asks for too much, is too long or nested too deep, or names a file that is none, such as a device. What else
            is wrong in it, MuJoCo says.
    """
    _check_file(Path(path), Path(path).parent, ())


def _check_file(path: Path, root: Path, above: tuple[Path, ...]) -> None:
    if path in above or not _is_file(path):
        return
    try:
        with path.open("rb") as stream:
            data = stream.read(_LARGEST + 1)
    except OSError as error:
        raise InputError("MJCF file", value=path, rule=f"cannot be read ({error.strerror})") from error
    if len(data) > _LARGEST:
        raise InputError("MJCF file", value=path, rule=f"must be at most {_LARGEST} bytes long")
    copies, folders, files, included = [1], [root], [], []
    for opens, closes, name, values in _tags(data.decode("utf-8", "replace")):
        if opens:
            copies.append(copies[-1] * (_count(path, values.get("count", "")) if name in _COPIERS else 1))
            _check_element(path, name, values, copies)
            if name == "compiler":
                folders += [root / values[key] for key in ("meshdir", "texturedir", "assetdir") if key in values]
            for key, value in values.items():
                if name in ("include", "model") and key == "file":
                    included.append(value)
                elif key.startswith("file"):  # `filename` of a URDF, of which MuJoCo takes the last part, or `fileup` of a cube
                    files += [value, re.split(r"[/\\]", value)[-1]]
        if closes and len(copies) > 1:
            copies.pop()
    for file in files:
        for folder in folders:
            _is_file(folder / file)
    for file in included:
        _check_file(root / file, root, (*above, path))


def _tags(text: str) -> Iterator[tuple[bool, bool, str, dict[str, str]]]:
    """Tags of ``text``: (opens an element, closes one, name, attributes)."""
    for match in _TOKEN.finditer(text):
        slash, name, rest = match["slash"], match["name"], match["rest"]
        if name is None:  # a comment, or text that holds no tags
            continue
        values = {key: _unescaped(one or two) for key, one, two in _ATTRIBUTE.findall(rest)}
        yield not slash, bool(slash) or rest.rstrip().endswith("/"), name, values


def _unescaped(text: str) -> str:
    try:
        return html.unescape(text)
    except ValueError:  # the number of a character has more digits than Python reads
        return text


def _is_file(path: Path) -> bool:
    """True for a file, False for nothing; ``InputError`` for what may wait for ever."""
    try:
        if path.is_file() or not path.exists():
            return path.is_file()
    except (OSError, ValueError):  # a path that no file can have
        return False
    raise InputError("MJCF file", value=path, rule="must be a regular file, as all files that a model names")


def _check_element(path: Path, name: str, values: dict[str, str], copies: list[int]) -> None:
    if len(copies) > _DEEPEST:
        raise InputError("MJCF file", value=path, rule=f"must have at most {_DEEPEST} elements within each other")
    if copies[-1] > MOST_COPIES:
        rule = f"<{name}> would make {copies[-1]:.3g} copies, and at most {MOST_COPIES} are made"
        raise InputError("MJCF file", value=path, rule=rule)
    if "nrow" in values and "ncol" in values:
        nodes = _whole(path, values["nrow"]) * _whole(path, values["ncol"])
        if nodes > MOST_NODES:
            raise InputError(
                "MJCF file", value=path, rule=f"a height field must have at most {MOST_NODES} nodes, not {nodes:.3g}"
            )


def _count(path: Path, words: str) -> int:
    return math.prod(max(_whole(path, word), 1) for word in words.split()[:3])


def _whole(path: Path, word: str) -> int:
    """A whole number; of more than nine digits, any is as good as 10^9."""
    digits = re.fullmatch(r"\s*\+?0*(\d*)\s*", word, re.ASCII)
    if digits is None:
        raise InputError("MJCF file", value=path, rule=f"counts must be whole numbers, and one is {word[:40]!r}")
    return int(digits[1] or 0) if len(digits[1]) <= 9 else 10**9
