"""Gymnasium environments over ``TaskBatch``: single ones, vectors, and their pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Unpack

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from raytac.envs.batch import StepResult, TaskBatch, TaskOptions
from raytac.envs.task_rules import Task
from raytac.envs.vector_checks import check_open, env_seeds
from raytac.errors import InputError
from raytac.gel.surface import chosen_envs
from raytac.observe import gymnasium_space
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_check import view_edges

_RENDER_MODES = ("rgb_array",)
_GAIN = 4.0
"""Length of a drawn arrow over the marker's displacement, and of the difference from rest."""
_PAPER, _INK, _DOT, _PLAIN = (250, 250, 250), (20, 60, 130), (90, 90, 90), 190
"""Colours of a panel of markers, and the grey level of no difference."""


class _TaskEnv:
    """Common part of single environments and vectors: the batch, its pictures, and closing."""

    task: ClassVar[type[Task]]
    metadata: dict[str, Any] = {"render_modes": list(_RENDER_MODES)}  # noqa: RUF012 (Gymnasium reads it from the class)
    closed = False

    def _compose(self, num_envs: int, render_mode: str | None, options: TaskOptions) -> None:
        """Make the batch; raises ``InputError`` for an unknown mode, and as ``TaskBatch``."""
        if render_mode is not None and render_mode not in _RENDER_MODES:
            raise InputError("render_mode", value=render_mode, rule="must be None or a known mode", choices=_RENDER_MODES)
        self.render_mode = render_mode
        self.batch = TaskBatch(self.task(), num_envs=num_envs, **options)
        self.metadata = {"render_modes": list(_RENDER_MODES), "render_fps": 1.0 / self.batch.control_timestep}
        self._observation: dict[str, np.ndarray] | None = None
        self._picture: EnvironmentPicture | None = None

    def _spaces(self) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Box]:
        """Observations and actions of one environment."""
        size = self.batch.control.size
        return gymnasium_space(self.batch.arrays), gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)

    def _pictures(self) -> tuple[np.ndarray, ...] | None:
        """Pictures of all environments; None without a render mode."""
        check_open(self.closed)
        if self.render_mode is None:
            return None
        if self._observation is None:
            raise InputError("environment", value=0, rule="must be reset before it is drawn")
        if self._picture is None:
            self._picture = EnvironmentPicture(self.batch)
        return tuple(self._picture.draw(b, self._observation) for b in range(self.batch.num_envs))

    def _free(self) -> None:
        """Free the renderer, if there is one."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None


class TactileEnv(_TaskEnv, gymnasium.Env):
    """One environment of a task; subclasses name the task, and their docstring specifies it.

    Keyword arguments are those of ``TaskBatch`` without ``num_envs``. ``info`` holds ``reward_terms`` (name to value, their sum is the
    reward), ``success`` and ``failed``.
    """

    def __init__(self, *, render_mode: str | None = None, **options: Unpack[TaskOptions]) -> None:
        """Compose the world of ``TaskBatch``, raising as it; ``render_mode``: None or ``rgb_array``."""
        self._compose(1, render_mode, options)
        self.observation_space, self.action_space = self._spaces()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; a seed makes this and later ones repeatable, noise included.

        ``options`` are ignored.
        Raises ``InputError`` after ``close``.
        """
        check_open(self.closed)
        super().reset(seed=seed)
        if seed is not None:
            self.batch.reseed([0], [seed])
        self._observation = self.batch.reset([0], [self.np_random])
        return _row(self._observation), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take one control step.

        Raises ``InputError`` for an action of another shape, outside of [−1, 1] or not finite, or after ``close``.
        """
        check_open(self.closed)
        out = self.batch.step(np.asarray(action)[None])
        self._observation = out.observation
        info = {
            "reward_terms": {name: float(term[0]) for name, term in out.terms.items()},
            "success": bool(out.success[0]),
            "failed": bool(out.failed[0]),
        }
        return _row(out.observation), float(out.reward[0]), bool(out.terminated[0]), bool(out.truncated[0]), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """8-bit picture (H, W, 3) of scene, green goal and sensors; None without a render mode.

        Raises:
            InputError: before the first ``reset``.
            BackendError: MuJoCo has no OpenGL to draw with (see ``SceneCamera``).
        """
        pictures = self._pictures()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free the renderer, if there is one; the environment cannot be used after that."""
        self.closed = True
        self._free()


class TactileVectorEnv(_TaskEnv, gymnasium.vector.VectorEnv):
    """B environments of a task in one world, stepped together and sensed in one call.

    Subclasses name the task. Keyword arguments are those of ``TaskBatch``. ``infos`` hold arrays (B,): ``reward_terms`` (name to array),
    ``success``, ``failed``; environments that are reset in the same step also have ``final_obs`` and ``final_info`` (arrays of objects),
    as in Gymnasium's own vectors. Environment b is seeded with seed + b and behaves as the single environment of that seed, noise of
    cameras and markers included.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        **options: Unpack[TaskOptions],
    ) -> None:
        """Compose the world.

        Args:
            num_envs: number of environments B.
            autoreset_mode: when an environment that has ended is reset: in the same step, in the next one (which ignores its action and
                gives reward 0), or only by ``reset``.
            render_mode: None, or ``rgb_array``.
            options: of ``TaskBatch``.

        Raises:
            InputError: a value out of its choices.
        """
        self._mode = checked_mode(autoreset_mode)
        self._compose(num_envs, render_mode, options)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = self._spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata["autoreset_mode"] = self._mode
        self._rngs = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin episodes: of all environments, or of those in ``options["reset_mask"]`` (B,).

        Raises ``InputError``: seeds of another number than environments, a mask of another shape, or after ``close``.
        """
        check_open(self.closed)
        mask = (options or {}).get("reset_mask")
        envs = chosen_envs(mask, self.num_envs)
        seeds = env_seeds(seed, self.num_envs)
        seeded = {b: one for b in envs if (one := seeds[b]) is not None}
        for b, one in seeded.items():
            self._rngs[b] = seeding.np_random(one)[0]
        if seeded:
            self.batch.reseed(list(seeded), list(seeded.values()))
        self._ended[envs] = False
        self._observation = self._reset(envs)
        return self._observation, {}

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one control step; actions of environments that are reset in it are ignored.

        Raises ``InputError`` for actions of another shape, outside of [−1, 1] or not finite, naming the environment; or after ``close``.
        """
        check_open(self.closed)
        # Those that are reset in place of this step.
        waiting = np.flatnonzero(self._ended) if self._mode is AutoresetMode.NEXT_STEP else np.zeros(0, int)
        actions = np.asarray(actions)
        if len(waiting) and actions.ndim and len(actions) == self.num_envs:
            actions = actions.copy()
            actions[waiting] = 0.0
        out = self.batch.step(actions, np.isin(np.arange(self.num_envs), waiting) if len(waiting) else None)
        observation, terms, reward = out.observation, out.terms, out.reward
        terminated, truncated, success, failed = out.terminated, out.truncated, out.success, out.failed
        if len(waiting):
            observation = self._reset(waiting)
            for values in (reward, terminated, truncated, success, failed, *terms.values()):
                values[waiting] = 0
        infos = _infos(np.ones(self.num_envs, bool), {"reward_terms": terms, "success": success, "failed": failed})
        self._ended = terminated | truncated
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            ended = np.flatnonzero(self._ended)
            infos |= self._final(out, ended)
            observation = self._reset(ended)
            self._ended[:] = False
        self._observation = observation
        return observation, reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """A picture of each environment, as ``TactileEnv.render``; None without a render mode."""
        return self._pictures()

    def close_extras(self, **kwargs: Any) -> None:
        """Free the renderer, if there is one."""
        self._free()

    def _reset(self, envs: Sequence[int] | np.ndarray) -> dict[str, np.ndarray]:
        return self.batch.reset([int(b) for b in envs], [self._rngs[b] for b in envs])

    def _final(self, out: StepResult, ended: np.ndarray) -> dict[str, Any]:
        """Entries ``final_obs`` and ``final_info`` of the environments that ended."""
        last, has_ended = np.full(self.num_envs, None, object), np.zeros(self.num_envs, bool)
        for b in ended:
            last[b] = {name: values[b].copy() for name, values in out.observation.items()}
        has_ended[ended] = True
        terms = {name: np.where(has_ended, term, 0.0) for name, term in out.terms.items()}
        final = {"reward_terms": terms, "success": out.success & has_ended, "failed": out.failed & has_ended}
        info = _infos(has_ended, final)
        return {"final_obs": last, "_final_obs": has_ended, "final_info": info, "_final_info": has_ended.copy()}


def checked_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """``AutoresetMode`` of a name; ``InputError`` with the choices for one that there is not."""
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        choices = [mode.value for mode in AutoresetMode]
        raise InputError("autoreset_mode", value=mode, rule="must be a known mode", choices=choices) from error


class EnvironmentPicture:
    """Pictures of a batch: the scene, and beside it what each sensor observes.

    Of the modalities the image is shown, and markers with arrows of 4 times their displacement over 4 times the image's difference from
    rest. Both are turned as the image is, x to the right and y down.
    """

    def __init__(self, batch: TaskBatch, *, height: int = 240) -> None:
        """Open a renderer of the scene for pictures of a ``height`` [px]. Raises as ``SceneCamera``."""
        from raytac.world.scene_camera import SceneCamera

        self._batch, self._height = batch, height
        self._rest: dict[str, np.ndarray] = {}
        """Images at rest by sensor, which differences are from."""
        # Near enough to see a pad of two centimetres, far enough that tool and body, a long pole too, stay in view; over a tool that
        # looks down there is room for the hand. From this side both fingers of a gripper are seen, and what is between them.
        tool, body = batch.start_tool[:3, 3], batch.start_body[:3, 3]
        distance = 0.5 + 1.5 * float(np.linalg.norm(tool - body))
        middle = 0.5 * (tool + body) + np.array([0.0, 0.0, 0.05 * max(0.0, -float(batch.start_tool[2, 2]))])
        self._camera = SceneCamera(
            batch.world, resolution=(4 * height // 3, height), distance=distance, azimuth=150.0, lookat=middle
        )

    def draw(self, env: int, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """8-bit picture (H, W, 3) of an environment with the goal and its last observation."""
        columns = [self._camera.draw(env, [self._batch.goal[env]])]
        for name in self._batch.observers:
            panels = []
            image = observation[f"{name}_rgb"][env][..., -3:] if f"{name}_rgb" in observation else None
            if image is not None:
                panels.append(_enlarged(image, self._height))
            if f"{name}_markers" in observation:
                panels.append(self._markers(name, env, observation[f"{name}_markers"][env], image))
            if panels:
                columns.append(_column(panels, self._height))
        return np.concatenate(columns, axis=1)

    def close(self) -> None:
        """Free the renderer."""
        self._camera.close()

    def _markers(self, name: str, env: int, values: np.ndarray, seen: np.ndarray | None) -> np.ndarray:
        """Panel of a sensor's markers, the last of a stack, over the image that is seen."""
        sensor, difference = self._batch.world.sensors[name], None
        if seen is not None:
            if name not in self._rest:
                self._rest[name] = _resized(sensor.rest().rgb[0], seen.shape[1], seen.shape[0])
            difference = magnified_difference(seen, self._rest[name])
        rest = sensor.marker_tracker.pattern.rest
        rest = rest[env if len(rest) > 1 else 0][:, :2]
        scale = self._batch.observers[name].settings.scale("markers")
        displacement = values.reshape(-1, *rest.shape)[-1] * np.asarray(scale)
        return marker_panel(sensor.spec, rest, displacement, self._height, behind=difference)


def magnified_difference(image: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """``_GAIN`` times an 8-bit image's difference from that at rest, about a light grey."""
    change = _GAIN * (image.astype(float) - rest)
    return np.clip(_PLAIN + change, 0, 255).astype(np.uint8)


def marker_panel(
    sensor: SensorSpec, rest: np.ndarray, displacement: np.ndarray, height: int, *, behind: np.ndarray | None = None
) -> np.ndarray:
    """8-bit picture (H, W, 3) of a pad with its markers, turned as the camera's image is.

    Args:
        sensor: gives the pad's size and the camera's view.
        rest, displacement: places of the markers and their displacements, pad frame [m], (M, 2); arrows are ``_GAIN`` times as long.
        height: of the picture [px], or its width if the pad is wider than high.
        behind: 8-bit image (h, w, 3) of the camera's view, to show behind them; None is paper.
    """
    from PIL import Image, ImageDraw

    size = np.array(sensor.gelpad.size)
    px_per_m = height / float(size.max())
    width, height = (int(n) for n in np.ceil(px_per_m * size))
    image = Image.new("RGB", (width, height), _PAPER)
    draw = ImageDraw.Draw(image)

    def pixel(point: np.ndarray) -> tuple[float, float]:
        return width / 2 + px_per_m * float(point[0]), height / 2 + px_per_m * float(point[1])

    if behind is not None:
        corners = np.array(view_edges(sensor)).T  # left top, right bottom
        (left, top), (right, bottom) = ((round(u), round(v)) for u, v in map(pixel, corners))
        image.paste(Image.fromarray(_resized(behind, right - left, bottom - top)), (left, top))
    for start, arrow in zip(rest, displacement, strict=True):
        x, y = pixel(start)
        draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_DOT)
        draw.line([(x, y), pixel(start + _GAIN * arrow)], fill=_INK, width=2)
    return np.asarray(image)


def _enlarged(image: np.ndarray, height: int) -> np.ndarray:
    """The image scaled to ``height`` [px]."""
    return _resized(image, max(1, round(image.shape[1] * height / len(image))), height)


def _resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The image at another size [px]."""
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))


def _column(panels: list[np.ndarray], height: int) -> np.ndarray:
    """Panels of equal width one above the other, scaled to ``height`` [px]."""
    from PIL import Image

    width = max(panel.shape[1] for panel in panels)
    sized = [Image.fromarray(p).resize((width, max(1, round(p.shape[0] * width / p.shape[1])))) for p in panels]
    return _enlarged(np.concatenate([np.asarray(image) for image in sized]), height)


def _row(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: values[0] for name, values in observation.items()}


def _infos(having: np.ndarray, values: dict[str, Any]) -> dict[str, Any]:
    """Entries with the masks of Gymnasium's vectors; ``having`` (B,): environments with one."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        result[name] = _infos(having, value) if isinstance(value, dict) else value
        result[f"_{name}"] = having.copy()
    return result
