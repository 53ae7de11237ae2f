"""The commit of a checkout is what git says of it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from raytac.io.code_digest import git_state


def test_the_commit_is_that_of_this_checkout() -> None:
    here = Path(__file__).parents[2]
    told = subprocess.run(["git", "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    if told.returncode:
        pytest.skip("not a checkout")
    state = git_state()
    assert state["git.commit"] == told.stdout.strip() and isinstance(state["git.changed"], int)
