"""What an environment looks like: the scene, and beside it what its sensors observe."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from raytac.envs.batch import TaskBatch

__all__ = ["EnvironmentPicture"]

_GAIN = 4.0
"""Length of a drawn arrow over the marker's way."""
_PAPER, _INK, _DOT = (250, 250, 250), (43, 108, 176), (120, 120, 120)


class EnvironmentPicture:
    """Draws environments of a batch. Of each sensor it shows the modalities that are observed: the image, and markers with arrows
    of 4 times their displacement, pad frame with x to the right and y up."""

    def __init__(self, batch: TaskBatch, *, height: int = 240) -> None:
        """Open a renderer of the scene; ``height`` of the picture [px]. Raises as ``SceneCamera``."""
        from raytac.world.scene_camera import SceneCamera

        self._batch, self._height = batch, height
        # Near enough to see a pad of two centimetres, far enough that tool and body, a long pole too, stay in view.
        tool, body = batch._start_tool[:3, 3], batch._start_body[:3, 3]
        distance = 0.45 + 1.5 * float(np.linalg.norm(tool - body))
        self._camera = SceneCamera(
            batch.world, resolution=(4 * height // 3, height), distance=distance, lookat=0.5 * (tool + body)
        )

    def draw(self, env: int, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """8-bit picture (H, W, 3) of an environment, the goal in green; ``observation`` (B, …) is what the batch gave last."""
        columns = [self._camera.draw(env, [self._batch._goal[env]])]
        for name in self._batch.observers:
            panels = []
            if f"{name}_rgb" in observation:
                panels.append(_enlarged(observation[f"{name}_rgb"][env][..., -3:], self._height))
            if f"{name}_markers" in observation:
                panels.append(self._markers(name, env, observation[f"{name}_markers"][env]))
            if panels:
                columns.append(_column(panels, self._height))
        return np.concatenate(columns, axis=1)

    def close(self) -> None:
        """Free the renderer."""
        self._camera.close()

    def _markers(self, name: str, env: int, seen: np.ndarray) -> np.ndarray:
        from PIL import Image, ImageDraw

        sensor = self._batch.world.sensors[name]
        rest = sensor.marker_tracker.pattern.rest
        rest = rest[env if len(rest) > 1 else 0][:, :2]
        scale = self._batch.observers[name].settings.scale("markers")
        moved = seen.reshape(-1, *rest.shape)[-1] * np.asarray(scale)  # the last of a stack [m]
        size = np.array(sensor.spec.gelpad.size[:2])
        factor = self._height / float(size.max())
        width, height = (int(n) for n in np.ceil(factor * size))
        image = Image.new("RGB", (width, height), _PAPER)
        draw = ImageDraw.Draw(image)

        def at(point: np.ndarray) -> tuple[float, float]:
            return width / 2 + factor * float(point[0]), height / 2 - factor * float(point[1])

        for start, way in zip(rest, moved, strict=True):
            x, y = at(start)
            draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_DOT)
            draw.line([(x, y), at(start + _GAIN * way)], fill=_INK, width=2)
        return np.asarray(image)


def _enlarged(image: np.ndarray, height: int) -> np.ndarray:
    from PIL import Image

    width = max(1, round(height * image.shape[1] / image.shape[0]))
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))


def _column(panels: list[np.ndarray], height: int) -> np.ndarray:
    """Panels of equal width one above the other, as high as asked."""
    from PIL import Image

    width = max(panel.shape[1] for panel in panels)
    sized = [Image.fromarray(p).resize((width, max(1, round(p.shape[0] * width / p.shape[1])))) for p in panels]
    stacked = np.concatenate([np.asarray(image) for image in sized])
    width = max(1, round(width * height / len(stacked)))
    return np.asarray(Image.fromarray(stacked).resize((width, height), Image.Resampling.BILINEAR))
