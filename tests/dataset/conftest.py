"""A sweep so small that its shards take moments: two objects, Phong's images, a coarse grid."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from raytac.dataset import ShardRenderer, ShardResult
from raytac.specs import PressRanges, SweepSpec, load_press, load_sensor


@pytest.fixture(scope="session")
def sweep() -> SweepSpec:
    return SweepSpec(
        name="tiny",
        sensors=(load_sensor("gelsight_mini_9x11"),),
        objects=(load_press("sphere"), load_press("edge")),
        count=10,
        ranges=PressRanges(
            depth=(0.3e-3, 0.9e-3), x=(-3e-3, 3e-3), y=(-2e-3, 2e-3), yaw=(-3.0, 3.0), tilt=(0.0, 0.2), shear=(0.0, 0.3e-3)
        ),
        shard_size=4,
        seed=5,
        optics="phong",
        outputs=("rgb", "height", "contact", "wrench"),
        markers="fots",
        resolution=(32, 24),
        pitch=0.4e-3,
        randomization={"exposure": 0.1, "noise": 2.0},
        marker_perturbation={"noise_px": 0.2, "dropout": 0.1, "shift": 0.05e-3},
    )


@contextmanager
def interrupted_at(interrupted: int) -> Iterator[None]:
    """Ctrl-C when a shard is to be rendered."""
    render = ShardRenderer.render

    def stop(renderer: ShardRenderer, shard: int) -> ShardResult:
        if shard == interrupted:
            raise KeyboardInterrupt
        return render(renderer, shard)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ShardRenderer, "render", stop)
        yield
