"""Shipped policies: files of ``raytac train``, one a task that PPO alone has solved."""

from __future__ import annotations

from pathlib import Path


def shipped_policies() -> dict[str, Path]:
    """Files of the shipped policies by name."""
    return {path.stem: path for path in sorted(Path(__file__).resolve().parent.glob("*.pt"))}
