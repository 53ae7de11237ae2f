"""What the first pages say, typed by a newcomer: does every command run, and how long until a part of one's own is pressed?

    python experiments/newcomer.py --out runs/newcomer
    python experiments/newcomer.py --pages README.md docs/guide/own-part.md --keep

The last commit of this checkout is cloned into a temporary folder, which is removed afterwards. Its pages are read, and their shell and
Python blocks run there as written, in order: the environment is the one that the pages tell to make, and the home folder is empty, so that
every kernel is compiled and every table is baked. A command that is on two pages runs once. The Python blocks of a page run as one program
after its commands. The files that the pages take for granted are made: a screw as ``part.stl``, in metres as ``metres.stl``,
without its end as ``scan.ply``, and the page's own scene file. ``SKIPPED`` lists what is left out, with reasons.

``newcomer.minutes_to_first_own_press`` is the time of all commands from the clone to the end of the first press of ``part.stl``,
installation and compilation included, reading not. ``newcomer.compare_minutes`` is that of ``raytac compare``. Other work on the machine
lengthens both: ``newcomer.load_per_core`` is its load over the number of cores when the run began. ``steps.json`` has each command with
its time, and ``output.txt`` what it printed. A command that fails is named with its last lines, and the exit status is 1.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from experiments.running import recorded, run
from raytac.checks import check_known
from raytac.errors import InputError, RaytacError
from raytac.io import CommonOptions, Metric

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/guide/first-steps.md", "docs/guide/own-part.md", "docs/guide/compare.md")
SKIPPED = {
    r"git clone ADDRESS\b": "the checkout is cloned already",
    r"raytac view\b": "serves until it is interrupted",
    r"raytac compare\b.*--device cuda": "needs a GPU",
    r"raytac compare\b.*--(markers|level|full)": "takes longer than a first run, and says so",
    r"raytac compare\b.*--(modes|quick)": "is contained in the comparison before it",
}
"""Commands that do not run, as regular expressions, and reasons."""
INSTALLS = r"python3 -m venv|pip install"
"""Commands after whose failure nothing else can run."""
OWN_PRESS, COMPARE = r"raytac press part\.", r"raytac compare(\s|$)"
BLOCK = re.compile(r"(?:<!-- needs: ([\w ]+) -->\n)?^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LAST_LINES = 12


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Do what the first pages say, in a fresh environment, and time it."""

    pages: tuple[str, ...] = PAGES
    """Pages to follow, in order; the first must install."""
    limit_min: float = 45.0
    """Minutes after which a command is stopped and counts as failed."""
    keep: bool = False
    """Keep the temporary folder and name it."""


@dataclass(frozen=True)
class Step:
    """A command of a page; ``code`` is a program of Python if it is not empty, ``skipped`` the reason for leaving it out."""

    page: str
    command: str
    code: str = ""
    skipped: str = ""


@dataclass(frozen=True)
class Outcome:
    """Page, command, time, exit status and the last lines of output of a step that ran."""

    page: str
    command: str
    seconds: float
    status: int
    last_lines: tuple[str, ...]


def blocks(text: str, language: str) -> list[str]:
    """Code blocks of a page in one language, without those that need a package or a device of their own."""
    return [code for needs, name, code in BLOCK.findall(text) if name == language and not needs]


def commands(block: str) -> list[str]:
    """Commands of a shell block, without comments; a line that ends in a backslash goes on."""
    lines = block.replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*$", "", line).strip())]


def steps_of(pages: Sequence[tuple[str, str]]) -> list[Step]:
    """Steps of pages, each a name and a text, in order; a command that was on an earlier page is not repeated."""
    steps: dict[str, Step] = {}
    for page, text in pages:
        for command in (command for block in blocks(text, "sh") for command in commands(block)):
            reason = next((why for pattern, why in SKIPPED.items() if re.search(pattern, command)), "")
            steps.setdefault(command, Step(page, command, skipped=reason))
        if code := "\n".join(blocks(text, "python")):
            program = f"python {Path(page).stem.lower().replace('-', '_')}_page.py"
            steps[program] = Step(page, program, code=code)
    return list(steps.values())


def screw(*, closed: bool = True) -> np.ndarray:
    """Triangles (T, 3, 3) of an M4 socket head screw [mm], its head towards -z; without ``closed`` the end of its shank is missing."""
    angle = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
    hexagon = np.cos(np.pi / 6) / np.cos(angle % (np.pi / 3) - np.pi / 6)
    profile = ((0.0, 2.0), (1.73, 2.0), (1.73, 0.0), (3.3, 0.0), (3.5, 0.2), (3.5, 4.0), (2.0, 4.0), (2.0, 12.0), (0.0, 12.0))
    rings = []
    for k, (radius, z) in enumerate(profile):
        r = radius * hexagon if k in (1, 2) else np.full(angle.size, radius)
        rings.append(np.stack((r * np.cos(angle), r * np.sin(angle), np.full(angle.size, z)), axis=1))
    faces = []
    for low, high in zip(rings, rings[1:] if closed else rings[1:-1], strict=False):
        a, b, c, d = low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high
        faces += [np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)]
    triangles = np.concatenate(faces)
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    return triangles[area > 1e-9]


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """Write a binary STL file."""
    facets = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    facets["corners"] = triangles
    path.write_bytes(b"a newcomer's part".ljust(80) + np.uint32(len(triangles)).tobytes() + facets.tobytes())


def write_ply(path: Path, triangles: np.ndarray) -> None:
    """Write an ASCII PLY file, each vertex once."""
    vertices, faces = np.unique(triangles.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n{properties}element face {len(triangles)}\n"
    rows = [" ".join(f"{value:g}" for value in vertex) for vertex in vertices]
    rows += ["3 " + " ".join(map(str, face)) for face in faces.reshape(-1, 3)]
    path.write_text(f"{header}property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n", encoding="ascii")


def prepare(checkout: Path, pages: Sequence[tuple[str, str]]) -> None:
    """Write what the pages take for granted: the part, its scan, and the page's scene file beside a copy of a sensor file."""
    (checkout / "my").mkdir()
    for folder in (checkout, checkout / "my"):
        write_stl(folder / "part.stl", screw())
    write_stl(checkout / "metres.stl", 1e-3 * screw())
    write_ply(checkout / "scan.ply", screw(closed=False))
    shutil.copy(checkout / "scenes/sensors/gelsight_mini.toml", checkout / "my/sensor.toml")
    scenes = [block for _, text in pages for block in blocks(text, "toml") if "[object]" in block]
    if scenes:
        (checkout / "my/scene.toml").write_text(scenes[0], encoding="utf-8")


def environment(checkout: Path, home: Path) -> dict[str, str]:
    """Variables of a newcomer's shell: an empty home, and the checkout's environment on the path once it is made."""
    own = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "XDG_CACHE_HOME", "WARP_CACHE_PATH"}
    path = [entry for entry in os.environ.get("PATH", os.defpath).split(os.pathsep) if Path(entry) != Path(sys.prefix) / "bin"]
    kept = {name: value for name, value in os.environ.items() if name not in own}
    return {**kept, "HOME": str(home), "PATH": os.pathsep.join([str(checkout / ".venv/bin"), *path])}


def perform(step: Step, folder: Path, variables: dict[str, str], limit_s: float) -> tuple[Outcome, str]:
    """Run a step and return its outcome and all that it printed; one that takes too long is stopped with its children."""
    if step.code:
        (folder / shlex.split(step.command)[1]).write_text(step.code, encoding="utf-8")
    call = ["timeout", "--kill-after=10", f"{limit_s:g}", "bash", "-c", step.command]
    start = time.perf_counter()
    process = subprocess.run(
        call, cwd=folder, env=variables, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    seconds = time.perf_counter() - start
    text = process.stdout.decode("utf-8", "replace")
    lines = [line for line in text.splitlines() if line.strip()][-LAST_LINES:]
    if process.returncode == 124:
        lines.append(f"(stopped after {limit_s:g} s)")
    return Outcome(step.page, step.command, seconds, process.returncode, tuple(lines)), text


def follow(steps: Sequence[Step], folder: Path, home: Path, limit_s: float) -> Iterator[tuple[Outcome, str]]:
    """Run steps in order, one line each on standard output; a failed installation ends it."""
    variables = environment(folder, home)
    for step in steps:
        print(f"{step.page}: {step.command}", end="", flush=True)
        if step.skipped:
            print(f"   left out: {step.skipped}", flush=True)
            continue
        outcome, text = perform(step, folder, variables, limit_s)
        print(f"   {outcome.seconds:.1f} s{'' if outcome.status == 0 else f', FAILED ({outcome.status})'}", flush=True)
        yield outcome, text
        if outcome.status and re.search(INSTALLS, step.command):
            return


def figures(outcomes: Sequence[Outcome]) -> dict[str, Metric]:
    """Metrics of a run; a time is left out if its command failed or was not reached."""
    result: dict[str, Metric] = {
        "newcomer.commands": len(outcomes),
        "newcomer.failures": sum(outcome.status != 0 for outcome in outcomes),
    }
    own = next((k for k, outcome in enumerate(outcomes) if re.match(OWN_PRESS, outcome.command)), None)
    if own is not None and not any(outcome.status for outcome in outcomes[: own + 1]):
        result["newcomer.minutes_to_first_own_press"] = sum(outcome.seconds for outcome in outcomes[: own + 1]) / 60
    compared = [outcome for outcome in outcomes if re.match(COMPARE, outcome.command)]
    if compared and not any(outcome.status for outcome in compared):
        result["newcomer.compare_minutes"] = sum(outcome.seconds for outcome in compared) / 60
    return result


def failure_report(outcomes: Sequence[Outcome]) -> str:
    """The commands that failed, each with its page, exit status and last lines; empty if none did."""
    failed = [outcome for outcome in outcomes if outcome.status]
    parts = [
        f"{o.page}: {o.command} (exit status {o.status})\n" + "\n".join(f"    {line}" for line in o.last_lines) for o in failed
    ]
    return "\n".join([f"{len(failed)} of {len(outcomes)} commands failed", *parts]) if failed else ""


def main(args: Args) -> None:
    for page in args.pages:
        check_known("pages", page, PAGES)
    if not args.limit_min > 0:
        raise InputError("limit_min", value=args.limit_min, rule="must be more than 0 minutes")
    outcomes: list[Outcome] = []
    with recorded(args, "newcomer", device="cpu") as (folder, metrics):
        metrics["newcomer.load_per_core"] = os.getloadavg()[0] / (os.cpu_count() or 1)
        place = Path(tempfile.mkdtemp(prefix="raytac_newcomer_"))
        try:
            home, checkout = place / "home", place / "raytac"
            home.mkdir()
            clone = Step("(checkout)", f"git clone --quiet {shlex.quote(str(ROOT))} raytac")
            printed = []
            for outcome, text in follow([clone], place, home, 60 * args.limit_min):
                outcomes.append(outcome)
                printed.append(f"$ {outcome.command}\n{text}")
            if outcomes[0].status:
                raise RaytacError(failure_report(outcomes))
            pages = [(page, (checkout / page).read_text(encoding="utf-8")) for page in args.pages]
            prepare(checkout, pages)
            for outcome, text in follow(steps_of(pages), checkout, home, 60 * args.limit_min):
                outcomes.append(outcome)
                printed.append(f"$ {outcome.command}\n{text}")
        finally:
            if args.keep:
                print(f"kept: {place}")
            else:
                shutil.rmtree(place)
        metrics |= figures(outcomes)
        (folder / "output.txt").write_text("\n".join(printed), encoding="utf-8")
        (folder / "steps.json").write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1), encoding="utf-8")
    for name in ("commands", "failures", "minutes_to_first_own_press", "compare_minutes", "load_per_core"):
        if (key := f"newcomer.{name}") in metrics:
            print(f"{key} {metrics[key]:.4g}" if isinstance(metrics[key], float) else f"{key} {metrics[key]}")
    if report := failure_report(outcomes):
        raise RaytacError(report)


if __name__ == "__main__":
    run(main, Args)
