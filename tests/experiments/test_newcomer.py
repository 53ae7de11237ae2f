"""The newcomer's script: commands are read from the pages, and a failing one is named. Nothing is installed."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.newcomer import (
    COMPARE,
    PAGES,
    ROOT,
    SKIPPED,
    Step,
    commands,
    failure_report,
    figures,
    follow,
    screw,
    steps_of,
    write_ply,
    write_stl,
)

PAGE = """
```sh
python3 -m venv .venv && . .venv/bin/activate   # once
pip install -e '.[a,b]'         # Linux; add '[c]' for more
# only a remark
raytac press part.stl \\
    --depth 0.8
raytac view sphere
```

```python
a = 1
```

<!-- needs: cuda -->
```python
a = 0 / 0
```

```python
print(a)
```
"""


def test_commands_come_from_the_blocks_of_a_page_in_order_and_once() -> None:
    steps = steps_of([("guide/own-page.md", PAGE), ("b.md", "```sh\nraytac view sphere\nraytac doctor\n```\n")])
    assert [" ".join(step.command.split()) for step in steps] == [
        "python3 -m venv .venv && . .venv/bin/activate",
        "pip install -e '.[a,b]'",
        "raytac press part.stl --depth 0.8",
        "raytac view sphere",
        "python own_page_page.py",
        "raytac doctor",
    ]
    assert [step.command for step in steps if step.skipped] == ["raytac view sphere"]
    assert steps[4].code == "a = 1\n\nprint(a)\n" and steps[5].page == "b.md"
    assert commands("raytac press a#b.stl  # x") == ["raytac press a#b.stl"]


def test_the_shipped_pages_install_press_a_part_and_compare() -> None:
    steps = steps_of([(page, (ROOT / page).read_text(encoding="utf-8")) for page in PAGES])
    run = [step.command for step in steps if not step.skipped]
    assert run[:2] == ["python3 -m venv .venv && . .venv/bin/activate", "pip install -e ."]
    assert any(re.match("raytac press part.stl", command) for command in run)
    assert sum(re.match(COMPARE, command) is not None for command in run) == 1
    for pattern in SKIPPED:
        assert any(re.search(pattern, step.command) for step in steps), f"no page has it any more: {pattern}"


def test_a_failing_command_is_named_with_its_last_lines_and_a_failed_installation_ends_the_run(tmp_path: Path) -> None:
    fails = "echo early; for k in $(seq 20); do echo line $k; done; echo the reason >&2; exit 3"
    steps = [Step("a.md", "true"), Step("a.md", fails), Step("a.md", "raytac view x", skipped="serves")]
    outcomes = [outcome for outcome, _ in follow(steps, tmp_path, tmp_path, 60.0)]
    report = failure_report(outcomes)
    assert report.startswith("1 of 2 commands failed\na.md: echo early")
    assert "(exit status 3)" in report and report.endswith("    line 20\n    the reason") and "    early" not in report
    assert figures(outcomes) == {"newcomer.commands": 2, "newcomer.failures": 1}
    installs = [Step("a.md", "false || pip install --no-such-option"), Step("a.md", "true")]
    assert len(list(follow(installs, tmp_path, tmp_path, 60.0))) == 1


def test_a_command_that_takes_too_long_is_stopped_and_fails(tmp_path: Path) -> None:
    ((outcome, _),) = follow([Step("a.md", "sleep 30")], tmp_path, tmp_path, 0.2)
    assert outcome.status == 124 and outcome.seconds < 20 and "stopped after 0.2 s" in failure_report([outcome])


def test_times_are_sums_over_what_ran(tmp_path: Path) -> None:
    shim = tmp_path / ".venv/bin/raytac"
    shim.parent.mkdir(parents=True)
    shim.write_text(f"#!{sys.executable}\nimport sys, time\ntime.sleep(0.05)\n", encoding="utf-8")
    shim.chmod(0o755)
    names = ("raytac press coin", "raytac press part.stl", "raytac compare", "raytac doctor", "raytac compare-real x")
    outcomes = [outcome for outcome, _ in follow([Step("a.md", name) for name in names], tmp_path, tmp_path, 60.0)]
    result = figures(outcomes)
    assert result["newcomer.failures"] == 0
    assert result["newcomer.minutes_to_first_own_press"] == pytest.approx(sum(o.seconds for o in outcomes[:2]) / 60)
    assert result["newcomer.compare_minutes"] == pytest.approx(outcomes[2].seconds / 60)


def test_the_part_is_a_solid_and_its_scan_is_open(tmp_path: Path) -> None:
    import trimesh

    write_stl(tmp_path / "part.stl", screw())
    write_ply(tmp_path / "scan.ply", screw(closed=False))
    part, scan = (trimesh.load_mesh(tmp_path / name) for name in ("part.stl", "scan.ply"))
    assert part.is_watertight and part.volume > 0 and np.allclose(part.extents, (7, 7, 12), atol=0.01)
    assert not scan.is_watertight
