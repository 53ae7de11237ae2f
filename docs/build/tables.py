"""Fill the tables of the pages from committed metrics, or say which pages disagree with them.

    python docs/build/tables.py             # writes the tables into the pages (`make tables`)
    python docs/build/tables.py --check     # writes nothing; exit code 1 if a page is not as its metrics say
    python docs/build/tables.py --add runs/contact_depth/metrics.json contact_depth "python experiments/contact_depth.py --device cpu"

A table stands in a page between a comment, which names a file of ``docs/measurements/metrics`` and how a row is made, and ``<!-- end -->``:

    <!-- table: compare_physics
    | scene | force [N] | height |
    | sphere, coin = coin (relief) | {*.rigid.force_n:.2f} | {*.rigid.beyond_um:.0f} µm |
    -->
    <!-- end -->

The first line is the heading. Each other line makes one row for every name in its first cell, joined by commas: ``*`` in the other cells
stands for the name, and ``name = text`` shows another text. A line without ``*`` is one row. ``{key:format}`` is a value of the file; of
several files, ``table: ONE TWO``, keys begin with the file's name, as in ``{ONE.key}``.
Above the table goes the command, the machine and the date, which ``--add`` keeps in the file beside the run's own keys.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs"
METRICS = PAGES / "measurements" / "metrics"
BLOCK = re.compile(r"(<!-- table: (\w+(?: \w+)*)\n(.*?)\n-->\n)(.*?)(<!-- end -->)", re.DOTALL)
VALUE = re.compile(r"\{([\w.*+-]+)(:[^{}]*)?\}")
COMMAND, DATE = "measured.command", "measured.date"

Values = Mapping[str, object]


class TableError(ValueError):
    """A table that its metrics cannot fill; the message names the file and the key."""


def filled(text: str, folder: Path = METRICS) -> str:
    """The page with all its tables filled from the files of ``folder``."""

    def table(match: re.Match[str]) -> str:
        files = {name: read(folder / f"{name}.json") for name in match[2].split()}
        values = dict(next(iter(files.values())))
        if len(files) > 1:
            values = {f"{name}.{key}": value for name, one in files.items() for key, value in one.items()}
        said = "; ".join(dict.fromkeys(source(one) for one in files.values()))
        return f"{match[1]}\n{said}\n\n{rows(match[3].splitlines(), values, match[2])}\n\n{match[5]}"

    return BLOCK.sub(table, text)


def read(path: Path) -> dict[str, object]:
    """Metrics with the command and date of their run. Raises ``TableError`` without these."""
    if not path.is_file():
        raise TableError(f"{path.name}: there is no such file in {path.parent}")
    values = json.loads(path.read_text(encoding="utf-8"))
    check(values, path)
    return values


def check(values: Values, path: Path) -> None:
    """Raise ``TableError`` for metrics that do not say how they were measured."""
    for key in (COMMAND, DATE, "device", "wall_s"):
        if key not in values:
            raise TableError(f"{path.name}: must have the key {key!r}: add it with --add")


def source(values: Values) -> str:
    """Line of command, machine and date."""
    cpu, gpu = str(values.get("machine.cpu", "")), values.get("machine.gpu")
    machine = str(gpu) if gpu and values["device"] != "cpu" else f"{values.get('machine.cores', '?')}-core {cpu or 'CPU'}"
    return f"`{values[COMMAND]}` · {machine} · {values[DATE]}"


def rows(lines: Sequence[str], values: Values, name: str) -> str:
    """The table in Markdown."""
    heading = cells(lines[0])
    made = [heading, ["---"] * len(heading)]
    for line in lines[1:]:
        first, *others = cells(line)
        if len(others) + 1 != len(heading):
            raise TableError(f"{name}: {line!r} must have {len(heading)} cells, as the heading has")
        if not any("*" in cell for cell in others):
            made.append([shown(cell, values, name) for cell in (first, *others)])
            continue
        for item in first.split(","):
            key, _, text = (part.strip() for part in item.partition("="))
            made.append([text or key, *(shown(cell.replace("*", key), values, name) for cell in others)])
    return "\n".join(f"| {' | '.join(row)} |" for row in made)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def shown(cell: str, values: Values, name: str) -> str:
    """A cell with its values; ``TableError`` for a key that is not there."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            raise TableError(f"{name}.json: there is no {match[1]!r} in it")
        return format(values[match[1]], (match[2] or ":")[1:])

    return VALUE.sub(value, cell)


def pages(root: Path = PAGES) -> list[Path]:
    """Pages that have a table."""
    return [path for path in sorted(root.rglob("*.md")) if BLOCK.search(path.read_text(encoding="utf-8"))]


def add(metrics: Path, name: str, command: str) -> Path:
    """Keep the metrics of a run for a table, with its command and the date of its file."""
    values = json.loads(metrics.read_text(encoding="utf-8"))
    date = datetime.fromtimestamp(metrics.stat().st_mtime, UTC).date().isoformat()
    path, values = METRICS / f"{name}.json", {COMMAND: command, DATE: date} | values
    check(values, metrics)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    return path


def main() -> int:
    parser = argparse.ArgumentParser(description="Fill the tables of the pages from docs/measurements/metrics.")
    parser.add_argument("--check", action="store_true", help="write nothing, and fail if a page differs from its metrics")
    parser.add_argument("--add", nargs=3, metavar=("METRICS", "NAME", "COMMAND"), help="keep a run's metrics.json for a table")
    args = parser.parse_args()
    try:
        if args.add:
            print(add(Path(args.add[0]), args.add[1], args.add[2]))
            return 0
        texts = {path: path.read_text(encoding="utf-8") for path in pages()}
        wrong = {path: new for path, text in texts.items() if (new := filled(text)) != text}
        for path, new in wrong.items() if not args.check else ():  # after all tables could be filled
            path.write_text(new, encoding="utf-8")
    except (TableError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for path in wrong:
        print(f"{path}: {'differs from its metrics: run make tables' if args.check else 'written'}")
    return int(args.check and bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
