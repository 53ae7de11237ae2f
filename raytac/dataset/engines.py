"""Where shards are rendered: in this process. Ray is in ``ray_engine``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from raytac.dataset.renderer import RenderJob, ShardRenderer, ShardResult

__all__ = ["ENGINES", "render_here"]

ENGINES = ("local", "ray")
"""Names that ``engine=`` accepts."""


def render_here(job: RenderJob, shards: Sequence[int]) -> Iterator[ShardResult]:
    """Render shards one after the other in this process."""
    renderer = ShardRenderer(job)
    for shard in shards:
        yield renderer.render(shard)
