"""Write the pages of the site: those of ``docs``, those that are generated, and links that lead within the site.

    python docs/build/pages.py .site     # then a site builder takes .site (mkdocs.yml, `make docs`)

The pages in ``docs`` are read on GitHub too. A marker such as ``<!-- generated: command line -->`` is where the site has more:

- every option of ``raytac``, from the help of its commands;
- one page for each package, whose text mkdocstrings takes from the docstrings of the public names.

``scenes/README.md``, ``ipc/README.md``, the change log and the examples become pages of their own.
"""

from __future__ import annotations

import ast
import os
import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PACKAGES = "reference/python"
"""Folder of the generated pages of Python packages."""
OUTSIDE = {
    "scenes/README.md": "reference/files.md",
    "ipc/README.md": "reference/ipc.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
}
"""Pages of the site that stand for files of the repository."""
EXAMPLES = "examples.md"
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^)\s]+)\)")
COMMAND = re.compile(r"^  ([a-z][a-z-]*)  ", re.MULTILINE)


def help_text(*command: str) -> str:
    """Help of ``raytac``, or of one of its commands."""
    environment = {**os.environ, "COLUMNS": "88", "NO_COLOR": "1", "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    call = [sys.executable, "-m", "raytac", *command, "--help"]
    text = subprocess.run(call, capture_output=True, text=True, check=True, env=environment, cwd=ROOT).stdout
    return re.sub(r"\x1b\[[0-9;]*m", "", text).strip()


def command_line() -> str:
    """Markdown of all commands with their options."""
    return "\n\n".join(f"## raytac {name}\n\n```text\n{help_text(name)}\n```" for name in COMMAND.findall(help_text()))


def packages() -> dict[str, dict[str, str]]:
    """Public names of each package of raytac and the path that defines each, read from its ``__init__.pyi``."""
    result: dict[str, dict[str, str]] = {}
    for stub in sorted((ROOT / "raytac").rglob("__init__.pyi")):
        package = ".".join(stub.parent.relative_to(ROOT).parts)
        names = {}
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                names |= {alias.asname or alias.name: f"{package}.{node.module}.{alias.name}" for alias in node.names}
        result[package] = names
    return result


def package_page(package: str, names: dict[str, str]) -> str:
    """Markdown of one package, for mkdocstrings."""
    summary = ast.get_docstring(ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text(encoding="utf-8"))) or ""
    head = "    options:\n      heading_level: 2\n      show_root_heading: true\n      show_root_full_path: false\n"
    shared = (
        {}
        if package != "raytac"
        else {path: other for other, rest in packages().items() if other != package for path in rest.values()}
    )
    parts = [f"::: {path}\n{head}" for _, path in sorted(names.items()) if path not in shared]
    seen = [f"- `{name}`: [{shared[path]}]({shared[path]}.md)" for name, path in sorted(names.items()) if path in shared]
    return f"# {package}\n\n{summary}\n\n" + "\n".join([*seen, "", *parts]) + "\n"


def examples_page() -> str:
    """Markdown of all examples, one heading a file."""
    files = sorted((ROOT / "examples").glob("*.py")) + sorted((ROOT / "examples").glob("*.xml"))
    parts = [f"## {path.name}\n\n```{path.suffix[1:]}\n{path.read_text(encoding='utf-8').strip()}\n```" for path in files]
    return "# Examples\n\nOne file a question. Each is run by a test.\n\n" + "\n\n".join(parts) + "\n"


def generated() -> dict[str, str]:
    """Text of every page that is no file of ``docs``, by its path in the site."""
    pages = {f"{PACKAGES}/{name}.md": package_page(name, names) for name, names in packages().items()}
    pages[EXAMPLES] = examples_page()
    for source, target in OUTSIDE.items():
        if target != "index.md":
            pages[target] = (ROOT / source).read_text(encoding="utf-8")
    return pages


def source_of(page: str) -> str:
    """Path in the repository of a page of the site."""
    return next((source for source, target in OUTSIDE.items() if target == page and page != "index.md"), f"docs/{page}")


def relink(text: str, page: str) -> str:
    """The text of a page with its links as they are in the site; a file that the site lacks loses its link."""

    def link(match: re.Match[str]) -> str:
        image, label, target = match.groups()
        name, _, anchor = target.partition("#")
        if not name or re.match(r"[a-z]+:", target):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source_of(page)), name))
        if path in OUTSIDE:
            place = OUTSIDE[path]
        elif path in ("examples", "examples/README.md"):
            place, anchor = EXAMPLES, ""
        elif path.startswith("examples/"):
            place, anchor = EXAMPLES, re.sub(r"[^\w-]", "", posixpath.basename(path))
        elif path.startswith("docs/"):
            place = path.removeprefix("docs/")
        else:
            return label
        relative = posixpath.relpath(place, posixpath.dirname(page) or ".")
        return f"{image}[{label}]({relative}{'#' + anchor if anchor else ''})"

    blocks = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else LINK.sub(link, part) for part in blocks)


def filled(markdown: str) -> str:
    """The text of a page with what its markers stand for."""
    if "<!-- generated: command line -->" in markdown:
        markdown = markdown.replace("<!-- generated: command line -->", command_line())
    if "<!-- generated: packages -->" in markdown:
        listed = [
            f"- [`{name}`](python/{name}.md): {', '.join(f'`{public}`' for public in sorted(names))}"
            for name, names in packages().items()
        ]
        markdown = markdown.replace("<!-- generated: packages -->", "\n".join(listed))
    return markdown


def write(folder: Path) -> None:
    """Write all pages of the site, and copy pictures and notebooks, into ``folder``, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(
        DOCS, folder, ignore=lambda path, names: {"build"} if Path(path) == DOCS else {"__pycache__", ".ipynb_checkpoints"}
    )
    for name, text in generated().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    for path in folder.rglob("*.md"):
        text = relink(filled(path.read_text(encoding="utf-8")), path.relative_to(folder).as_posix())
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
