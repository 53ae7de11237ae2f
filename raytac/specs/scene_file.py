"""Reads a scene of either kind: a press or a task."""

from __future__ import annotations

from pathlib import Path

from raytac.errors import SpecError
from raytac.specs.files import available, find_file
from raytac.specs.press import PressScene
from raytac.specs.press_file import load_press
from raytac.specs.task import TaskScene
from raytac.specs.task_file import load_task
from raytac.specs.toml import read_toml

__all__ = ["load_scene"]


def load_scene(name_or_path: str | Path) -> PressScene | TaskScene:
    """Read and check a press scene or a task scene: by its shipped name, or by the path of a file, where ``[robot]`` makes a task.

    Raises:
        SpecError: a name that neither has (the message lists all); as ``load_press`` and ``load_task``.
        MeshError: an object's mesh cannot be used.
    """
    presses, tasks = available("press scene"), available("task scene")
    text = str(name_or_path)
    if isinstance(name_or_path, str) and not text.endswith(".toml") and not set(text) & {"/", "\\"}:
        if text not in (*presses, *tasks):
            rule = "no shipped press or task of this name, and not a path to a .toml file"
            raise SpecError(rule, key="scene", value=text, choices=(*presses, *tasks))
        return load_task(text) if text in tasks else load_press(text)
    path = find_file("press scene", name_or_path)
    return load_task(path) if "robot" in read_toml(path).data else load_press(path)
