"""Sessions of ``raytac view`` that play: presses of a data set, and policies."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_known
from raytac.dataset import PressDataset
from raytac.errors import InputError, RaytacError
from raytac.gel.surface import PadGrid
from raytac.observe import ObservationSettings
from raytac.physics.objects import object_parts
from raytac.shapes.triangulate import object_surface
from raytac.specs import SensorSpec, available, load_press, load_sensor
from raytac.view.recording import Stage, StatesSession
from raytac.view.sensor_view import grid_faces, places, sensor_lines, sensor_solids, strided
from raytac.view.session import CameraPlace, Control, Handle, HandlePlace, Pad, PadView, Session, Snapshot, Solid
from raytac.view.world_session import WorldSession
from raytac.world.world_state import WorldState

SCRIPTED = "scripted"
"""Policy that is written by hand for a task."""
_GREY = (150, 156, 166)
_SAG = 1e-5
"""Largest depth of the drawn facets below a curved object's true surface [m]."""
_KEPT = 8
"""Presses that stay in memory."""
_FIRST_SEED = 2**31
"""Of the first episode: training counts from 0 and has not seen it."""


def dataset_session(folder: Path) -> StatesSession:
    """The presses of a data set, one state each; of several sensors those of the first.

    Raises ``InputError`` for what is no data set, as ``PressDataset``.
    """
    whole = PressDataset(folder, verify=False)
    data = PressDataset(folder, sensor=next(iter(whole.description["sensors"])), verify=False)
    if not len(data):
        raise InputError("data set", value=str(folder), rule="must have a sound press")
    presses = _Presses(data)
    return StatesSession(presses.stage, presses, unit="press")


class _Presses(Sequence[Snapshot]):
    """Presses of one sensor as states; an object is drawn if its scene is shipped."""

    def __init__(self, data: PressDataset) -> None:
        self._data, shared = data, data.shared(0)
        self._full = PadGrid(shared["grid_x"], shared["grid_y"], shared["rest_height"])
        self._grid, self._rest = strided(self._full), shared.get("rest_rgb")
        self._objects: list[str] = data.manifest["object"].to_pylist()
        self._sensor: str = data.manifest["sensor"].to_pylist()[0]
        try:
            self._spec: SensorSpec | None = load_sensor(self._sensor)
        except RaytacError:
            self._spec = None  # a file that is not here: its gel is drawn all the same
        solids = [] if self._spec is None else list(sensor_solids(self._spec))
        shapes = {name: solid for name in dict.fromkeys(self._objects) if (solid := _object(name)) is not None}
        self._shapes = {name: solid.name for name, solid in shapes.items()}
        quantities = ("indentation", *(("pressure", "shear") if "traction" in data.description["arrays"] else ()))
        size = float(max(np.ptp(self._full.x), np.ptp(self._full.y)))
        self.stage = Stage(
            title=f"{Path(data.folder).name} · {self._sensor} · {len(data)} presses",
            units_per_metre=100.0,
            camera=CameraPlace((0.9 * size, -1.75 * size, 1.35 * size), (0.0, 0.0, -0.15 * size)),
            solids=(*solids, *shapes.values()),
            lines=() if self._spec is None else sensor_lines(self._spec),
            pads=(Pad(self._sensor, grid_faces(self._grid), quantities),),
        )
        self._state = lru_cache(_KEPT)(self._read)

    def __len__(self) -> int:
        return len(self._data)

    def __getitem__(self, k: Any) -> Snapshot:
        return self._state(k)

    def _read(self, k: int) -> Snapshot:
        press, at, name = self._data[k], places(self._full, self._grid), self._objects[k]
        height = press["height"][at].astype(float) if "height" in press else self._grid.rest
        x, y = np.meshgrid(self._grid.x, self._grid.y)
        values = {"indentation": (self._grid.rest - height).ravel()}
        if "traction" in press:
            traction = press["traction"][at].reshape(-1, 3)
            values["pressure"], values["shear"] = -traction[:, 2], np.hypot(traction[:, 0], traction[:, 1])
        depth = press.get("depth")
        view = PadView(
            world_from_pad=np.eye(4),
            vertices=np.stack([x.ravel(), y.ravel(), height.ravel()], axis=1),
            values=values,
            rgb=press.get("rgb"),
            markers_px=(press["markers_rest_px"], press["markers_px"]) if "markers_px" in press else None,
            wrench=press.get("wrench"),
            rest_rgb=self._rest,
            height=None if depth is None or self._spec is None else depth + self._spec.camera.position[2],
            normals=press.get("normals"),
        )
        row = {name: values[0] for name, values in self._data.manifest.slice(k, 1).to_pydict().items()}
        facts = {"object": name, "depth": f"{1e3 * row['press_depth']:.3f} mm", "seed": str(row["seed"])}
        shown = self._shapes.get(name)
        poses = {} if shown is None else {shown: press["pad_from_object"]}
        hidden = tuple(other for other in self._shapes.values() if other != shown)
        return Snapshot({self._sensor: view}, poses=poses, hidden=hidden, facts=facts)


def _object(name: str) -> Solid | None:
    """The object of a shipped press scene; None of another scene, or without a closed surface."""
    if name not in available("press scene"):
        return None
    parts = [part for part in object_parts(load_press(name).object) if part.kind != "plane"]
    if not parts:
        return None
    surface = object_surface(parts, _SAG)
    return Solid(f"object_{name}", surface.vertices, surface.faces, _GREY, hides_pads=True)


class EpisodeDriver:
    """Plays episodes of a task, one after the other; there is nothing to steer."""

    controls: tuple[Control, ...] = ()
    handle: Handle | None = None
    place: HandlePlace | None = None

    def __init__(
        self, batch: Any, begin: Callable[[int], None], act: Callable[[], Mapping[str, float]], missing: str = ""
    ) -> None:
        """Remember what to play; ``reset`` begins the first episode.

        Args:
            batch: a ``TaskBatch`` of one environment.
            begin: begins the episode of a seed.
            act: takes one step and returns its ``reward``, and ``success``, ``failed`` and ``ended`` as 0 or 1.
            missing: why nothing can be played; empty if it can.
        """
        self._batch, self._begin, self._act, self.missing = batch, begin, act, missing
        self.facts: Mapping[str, str] = {}
        self._episode, self._has_ended, self._return = 0, False, 0.0

    @property
    def asked(self) -> dict[str, float]:
        """Nothing: a policy steers."""
        return {}

    def aim(self, targets: Mapping[str, float]) -> None:
        """Do nothing: there are no controls."""

    def reset(self) -> WorldState:
        """The first episode again."""
        return self._start(0)

    def resume(self) -> None:
        """Begin the next episode if one has ended."""
        if self._has_ended:
            self._start(self._episode + 1)

    def step(self) -> WorldState | None:
        """One control step of the policy; None at the end of an episode."""
        if self._has_ended or self.missing:
            return None
        result = self._act()
        self._return += result["reward"]
        self._has_ended = bool(result["ended"])
        end = (
            "running"
            if not self._has_ended
            else "success"
            if result["success"]
            else "failed"
            if result["failed"]
            else "out of time"
        )
        self.facts = {"episode": f"{self._episode}, {end}", "return": f"{self._return:.2f}"}
        return self._batch.world.state()

    def _start(self, episode: int) -> WorldState:
        self._episode, self._has_ended, self._return = episode, False, 0.0
        self._begin(_FIRST_SEED + episode)
        self.facts = {"episode": f"{episode}, at its start"}
        return self._batch.world.state()


def scripted_session(task: str, *, shown: ObservationSettings, device: str, physics: Any) -> Session:
    """Episodes of a task by its scripted policy.

    Raises ``InputError`` for a task without one.
    """
    from raytac import envs

    check_known("task", task, tuple(envs.SCRIPTED))
    batch = envs.TaskBatch(getattr(envs, task)(), tactile=shown, device=device, physics=physics)
    policy = envs.SCRIPTED[task]

    def begin(seed: int) -> None:
        batch.reseed([0], [seed])
        batch.reset([0], [np.random.default_rng(seed)])

    def act() -> Mapping[str, float]:
        # The sensors are read when a state is shown: the policy does not need them.
        step = batch.step(np.clip(policy(batch), -1.0, 1.0), np.array([True]))
        ended = step.terminated[0] or step.truncated[0]
        return _result(step.reward, step.success, step.failed, ended)

    driver = EpisodeDriver(batch, begin, act)
    return WorldSession(batch.world, driver=driver, title=f"{task} · scripted policy")


def policy_session(path: Path, *, shown: ObservationSettings, device: str, physics: Any) -> Session:
    """Episodes of a task by a policy of ``raytac train``.

    One of ``train_ppo.py`` needs PyTorch: its task is shown, and the page says why nothing moves.

    Raises ``InputError`` for a file that is no policy.
    """
    from raytac import envs

    if not envs.FlatPolicy.is_one(path):
        task, missing = _task_of_checkpoint(path), _why_not(path)
        batch = envs.TaskBatch(getattr(envs, task)(), tactile=shown, device=device, physics=physics)

        def begin(seed: int) -> None:
            batch.reset([0], [np.random.default_rng(seed)])

        return WorldSession(batch.world, driver=EpisodeDriver(batch, begin, dict, missing), title=f"{task} · {path.name}")
    policy = envs.FlatPolicy(path)
    every = tuple(dict.fromkeys((*policy.felt, *shown.modalities)))
    hidden = [name for name in every if name not in policy.felt]
    wanted = ObservationSettings(every, resolution=shown.resolution, optics=shown.optics)
    vector = policy.vector(1, hidden=hidden, tactile=wanted, device=device, physics=physics or policy.physics)
    seen = vector.buffers

    def play() -> Mapping[str, float]:
        seen["action"][:] = policy(seen["actor"])
        vector.step()
        ended = seen["terminated"][0] or seen["truncated"][0]
        return _result(seen["reward"], seen["success"], seen["failed"], ended)

    driver = EpisodeDriver(vector.env.batch, vector.reset, play)
    return WorldSession(vector.env.batch.world, driver=driver, title=f"{policy.task} · {path.name}")


def _result(reward: Any, success: Any, failed: Any, ended: Any) -> Mapping[str, float]:
    return {"reward": float(reward[0]), "success": float(success[0]), "failed": float(failed[0]), "ended": float(ended)}


def _task_of_checkpoint(path: Path) -> str:
    from raytac import envs

    saved = envs.read_tensors(path)
    try:
        task = str(saved["recipe"]["task"])
    except (KeyError, TypeError) as error:
        raise InputError("policy", value=str(path), rule="must be a policy of raytac train or train_ppo") from error
    return check_known("policy's task", task, tuple(envs.SCRIPTED))


def _has_torch() -> bool:
    return importlib.util.find_spec("torch") is not None


def _why_not(path: Path) -> str:
    if not _has_torch():
        return f"{path.name} was trained by train_ppo: it needs PyTorch, which is not installed (pip install 'raytac[rl]')."
    return (
        f"{path.name} was trained by train_ppo, whose policies experiments/play.py plays; this page plays those of raytac train."
    )
