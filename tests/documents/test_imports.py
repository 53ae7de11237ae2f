"""Scripts of documents and examples use only modules that they import.

Where they are run (:mod:`tests.forked`), modules that only other scripts import are loaded, too.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable

from tests.documents.test_python_blocks import DOCS, NOTEBOOKS, ROOT, blocks
from tests.examples.test_examples import EXAMPLES

FOLLOW = """
import json, sys, types
statements, chains = json.loads(sys.argv[1])
names = {}
try:
    for statement in statements:
        exec(statement, names)
except ImportError:
    chains = []  # an extra that this machine has not
for place, *attributes in chains:
    value = names[place]
    for attribute in attributes:
        if not isinstance(value, types.ModuleType):
            break
        try:
            value = getattr(value, attribute)
        except ImportError:
            break
        except AttributeError:
            print(f"{'; '.join(statements)}: no {'.'.join([place, *attributes])}")
            break
"""
"""Follow names through modules, in an interpreter that has done nothing but some imports."""


def used(code: str) -> dict[tuple[str, ...], set[tuple[str, ...]]]:
    """Names with dots that begin with an imported module, by the statements that import it."""
    nodes, statements = list(ast.walk(ast.parse(code))), defaultdict(set)
    for node in nodes:
        for alias in node.names if isinstance(node, ast.Import) else ():
            statements[alias.asname or alias.name.split(".")[0]].add(
                f"import {alias.name}" + f" as {alias.asname}" * bool(alias.asname)
            )
    chains = defaultdict(set)
    for node in nodes:
        attributes = []
        while isinstance(node, ast.Attribute):
            attributes.insert(0, node.attr)
            node = node.value
        if attributes and isinstance(node, ast.Name) and node.id in statements:
            chains[tuple(sorted(statements[node.id]))].add((node.id, *attributes))
    return chains


def missing(codes: Iterable[str]) -> list[str]:
    """What some scripts use of modules and their imports do not load."""
    together = defaultdict(set)
    for code in codes:
        for statements, chains in used(code).items():
            together[statements] |= chains
    lines = []
    for statements, chains in sorted(together.items()):
        command = [sys.executable, "-c", FOLLOW, json.dumps([statements, sorted(chains)])]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        lines += done.stdout.splitlines()
    return lines


def test_scripts_use_only_modules_that_they_import() -> None:
    pages = ["\n".join(blocks(path.read_text(encoding="utf-8"))) for path in sorted(DOCS.rglob("*.md"))]
    cells = [json.loads(path.read_text(encoding="utf-8"))["cells"] for path in NOTEBOOKS]
    notebooks = ["\n".join("".join(cell["source"]) for cell in of if cell["cell_type"] == "code") for of in cells]
    examples = [path.read_text(encoding="utf-8") for path in EXAMPLES]
    assert any("raytac." in page for page in pages) and notebooks and examples
    assert missing([*pages, *notebooks, *examples]) == []


def test_a_module_that_a_script_does_not_import_is_named() -> None:
    """Of an import of the package alone; with one of the module, under another name or in a function, nothing is missing."""
    sound = (
        "import xml\ndef f():\n    import xml.dom.minidom\nxml.dom.minidom.parse",
        "import numpy as np\nnp.random.default_rng(1).normal",
        "import no_such_package\nno_such_package.part.other",
    )
    assert missing(sound) == []
    assert missing(["import xml.dom\nxml.dom.minidom"]) == ["import xml.dom: no xml.dom.minidom"]
    assert missing(["import raytac\nraytac.report.preview"]) == ["import raytac: no raytac.report.preview"]
