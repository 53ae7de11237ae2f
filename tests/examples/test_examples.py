"""Examples are short, and each runs in a process of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.forked import run_forked

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SAYS = {
    "batch": "load",
    "foreign_depth": "of imprints [0.2 0.4 0.6 0.8] mm deep",
    "depth_map": "as it is: the ball changes",
    "foreign_env": "right: pad pressed by 3.0",
    "foreign_loop": "the ball weighs 0.98",
    "foreign_robosuite": "left: pad pressed by 3.0",
    "gym_env": "return after five random actions",
    "own_mujoco_model": "right: normal force",
    "own_pad_shape": "bent: touches",
    "own_part": "leaning: touches at x = ",
    "own_vector_env": "force on each cube",
    "press": "force",
    "record_lerobot": "data/chunk-000/file-000.parquet",
    "relight": "without blue",
    "ros_messages": "deepest imprint in the cloud: ",
}
"""A word that the last line of an example must hold, or any line where it has several kinds."""


def test_there_are_examples_and_each_has_its_test() -> None:
    assert {path.stem for path in EXAMPLES} >= set(SAYS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_fits_on_a_screen_and_says_how_to_run_it(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    assert f"python examples/{path.name}" in text and text.startswith('"""')


@pytest.mark.parametrize("name", sorted(SAYS))
def test_an_example_runs(name: str, tmp_path: Path) -> None:
    if name in ("foreign_env", "foreign_robosuite", "gym_env", "own_vector_env", "record_lerobot"):
        pytest.importorskip("gymnasium")
    done = run_forked(str(ROOT / "examples" / f"{name}.py"), cwd=tmp_path, env={"CUDA_VISIBLE_DEVICES": ""})
    assert done.returncode == 0, done.stderr
    assert SAYS[name] in done.stdout
