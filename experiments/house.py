"""Measure how the code is built: size, import circles, small files, docstrings and names. Standard library only.

    python experiments/house.py --out runs/house

Counts over ``raytac`` and ``ipc``: lines, files, circles of imports (imports inside functions and for types count), files of at most 130
lines that one module imports, docstrings that begin with a question word or whose first line is longer than 90 characters, names that
the word list of the glossary replaces, and files that a user's optical mode consists of.
"""

from __future__ import annotations

import argparse
import ast
import gc
import itertools
import json
import platform
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

PACKAGES = ("raytac", "ipc")
SMALL_FILE = 130
LONG_FILE = 400
LONG_LINE = 90
EXAMPLE = Path("examples", "own_optical_mode.py")
OTHER_MODES = {"raytrace", "taxim", "phong", "mlp"}
QUESTION = re.compile(r"(What|Whether|How|Where|Which|Who)\b")
# "led" is not among them: the code models LEDs.
WORDS = ("found", "way", "left", "borne", "held", "told", "anew", "askew")
"""Words that stand for "result", "displacement", "residual", "carried", "constrained", "reported", "again" and "tilted"."""


def modules(root: Path) -> dict[str, Path]:
    """Files by dotted module name; a package is named by its ``__init__``."""
    files = sorted(path for package in PACKAGES for path in (root / package).rglob("*.py"))
    return {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file's syntax tree; the first is the module."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def parsed(files: Mapping[str, Path]) -> dict[str, list[ast.AST]]:
    """Nodes of every file by module name; the garbage collector waits, since all of them stay."""
    gc.disable()
    try:
        return {name: nodes_of(path) for name, path in files.items()}
    finally:
        gc.enable()


def imports(nodes: Iterable[ast.AST], module: str, names: set[str], *, is_package: bool) -> set[str]:
    """Modules of ``names`` that a module imports anywhere, by the nodes of its tree."""
    result = set()
    package = module if is_package else module.rpartition(".")[0]
    for node in nodes:
        if isinstance(node, ast.Import):
            result |= {alias.name for alias in node.names if alias.name in names}
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level > 1 else package
            base = node.module if node.level == 0 else ".".join(filter(None, (above, node.module)))
            for alias in node.names:
                target = f"{base}.{alias.name}"
                result |= {target} if target in names else {base} & names
    return result - {module}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (R. Tarjan, SIAM J. Comput. 1, 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    result = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in graph[node]:
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            start = stack.index(node)
            component = stack[start:]
            del stack[start:]
            if len(component) > 1:
                result.append(sorted(component))

    for node in graph:
        if node not in index:
            visit(node)
    return result


def docstrings(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Docstrings of the module, its classes and functions, and of constants and fields (a string after an assignment)."""
    for node in nodes:
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            text := ast.get_docstring(node)
        ):
            yield text
        for before, after in itertools.pairwise(body):
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str)
            if is_text and isinstance(before, ast.Assign | ast.AnnAssign):
                yield after.value.value  # type: ignore[union-attr]


def names_bound(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Names that the code gives to variables, arguments, fields, functions and classes; each place where one is given counts."""
    for node in nodes:
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name


def strings_in(node: ast.AST) -> Iterator[str]:
    """Strings that a tuple, list, set, dictionary or call holds side by side."""
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        items: Iterable[ast.expr | None] = node.elts
    elif isinstance(node, ast.Dict):
        items = (*node.keys, *node.values)
    elif isinstance(node, ast.Call):
        items = node.args
    else:
        return
    for item in items:
        if isinstance(item, ast.Constant) and isinstance(item.value, str):
            yield item.value


def mode_files(root: Path, library: Mapping[str, Iterable[ast.AST]]) -> list[str] | None:
    """Files of the optical mode that ``EXAMPLE`` adds; None without the example.

    They are the example, modules of its folder that it imports, and each module of the library that lists the mode's name beside that of
    another mode: in a tuple, list, set, dictionary or call.

    Raises:
        ValueError: the example registers no mode by name.
    """
    if not (root / EXAMPLE).exists():
        return None
    example = nodes_of(root / EXAMPLE)
    calls = [node for node in example if isinstance(node, ast.Call) and node.args]
    registered = [call.args[0] for call in calls if ast.unparse(call.func).rpartition(".")[2] == "register"]
    names = {node.value for node in registered if isinstance(node, ast.Constant)}
    if not names:
        raise ValueError(f"{EXAMPLE} must register its mode: register(NAME) with a string")
    beside = {f"{EXAMPLE.parent}.{path.stem}": path for path in (root / EXAMPLE).parent.glob("*.py")}
    beside |= {path.stem: path for path in beside.values()}
    own = {beside[module] for module in imports(example, EXAMPLE.stem, set(beside), is_package=False)}
    listed = [
        module
        for module, nodes in library.items()
        if any(names & (together := set(strings_in(node))) and together & OTHER_MODES for node in nodes)
    ]
    return [str(EXAMPLE), *sorted(str(path.relative_to(root)) for path in own), *listed]


def measure(root: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Counts by metric name, and what was counted, for those who want to mend it."""
    files = modules(root)
    library = parsed(files)
    lines = {name: path.read_text(encoding="utf-8").count("\n") for name, path in files.items()}
    packages = {name for name, path in files.items() if path.name == "__init__.py"}
    names = set(files)
    graph = {name: imports(nodes, name, names, is_package=name in packages) for name, nodes in library.items()}
    importers = {name: [other for other, targets in graph.items() if name in targets and other not in packages] for name in files}
    texts = [(name, text) for name, nodes in library.items() for text in docstrings(nodes)]
    details = {
        "files_over_400": [name for name in files if lines[name] > LONG_FILE],
        "circles": [" <-> ".join(circle) for circle in circles(graph)],
        "single_importer_small_files": [
            f"{name} ({lines[name]}) <- {importers[name][0]}"
            for name in files
            if name not in packages and lines[name] <= SMALL_FILE and len(importers[name]) == 1
        ],
        "docstrings_wh": [f"{name}: {text.splitlines()[0]}" for name, text in texts if QUESTION.match(text)],
        "docstrings_long": [f"{name}: {text.splitlines()[0]}" for name, text in texts if len(text.split("\n", 1)[0]) > LONG_LINE],
        "words": [
            f"{name}: {word}" for name, nodes in library.items() for word in names_bound(nodes) if word.strip("_") in WORDS
        ],
    }
    counts = {"files": len(files)} | {
        f"{package}_lines": sum(n for name, n in lines.items() if name.partition(".")[0] == package) for package in PACKAGES
    }
    toy = mode_files(root, library)
    if toy is not None:
        details["mode_files"] = toy
    return counts | {name: len(items) for name, items in details.items()}, details


def main() -> None:
    start = time.perf_counter()
    parser = argparse.ArgumentParser(description="Measure how the code is built.")
    parser.add_argument("--root", type=Path, default=Path(__file__).parent.parent, help="the checkout to measure")
    parser.add_argument("--out", type=Path, help="folder for metrics.json and details.txt; without it nothing is written")
    args = parser.parse_args()
    counts, details = measure(args.root)
    for name, count in counts.items():
        print(f"house.{name:30} {count}")
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        text = "".join(f"# {name}\n" + "".join(f"{item}\n" for item in items) for name, items in details.items())
        (args.out / "details.txt").write_text(text, encoding="utf-8")
        metrics = {f"house.{name}": count for name, count in counts.items()}
        metrics |= {"device": "cpu", "versions.python": platform.python_version(), "wall_s": time.perf_counter() - start}
        (args.out / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
