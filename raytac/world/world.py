"""``TactileWorld``: a task scene or a user's MuJoCo model, with pads and sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, cast

import mujoco
import numpy as np

from raytac.checks import MOST_ENVIRONMENTS, check_known, check_numbers, check_whole
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import chosen_envs
from raytac.markers.config import SurfaceMarkers
from raytac.markers.pattern import MarkerPattern
from raytac.markers.registry import markers_config
from raytac.physics.base import PhysicsConfig
from raytac.physics.configs import Ipc
from raytac.physics.registry import PHYSICS, checked_physics, scene_physics
from raytac.robots.arm import Arm
from raytac.se3 import rigid_poses
from raytac.sensor import TactileSensor
from raytac.specs.task import COUPLINGS, TaskScene
from raytac.specs.task_file import load_task
from raytac.world.c_states import CStates
from raytac.world.compose import compose
from raytac.world.engine.choice import WarpEngine, checked_engine
from raytac.world.environment_models import Variation
from raytac.world.forbidden_overlap import check_start
from raytac.world.pads import WORLD_PADS
from raytac.world.sensor_frames import SensorFrames
from raytac.world.world_model import WorldModel, compiled_model, own_world_model
from raytac.world.world_state import Control, WorldState

if TYPE_CHECKING:
    from raytac.markers import MarkersConfig
    from raytac.optics.base import OpticalMode, OpticsConfig
    from raytac.physics.soft.scene import SoftScene
    from raytac.robots.mount import SensorChoice
    from raytac.world.soft_pads import SoftPads
    from raytac.world.touched import TouchChoice
    from raytac.world.warp_frame import WarpFrame
    from raytac.world.warp_soft_states import WarpSoftStates
    from raytac.world.warp_states import WarpStates

_BEYOND = 1e-2
"""Greatest excess of joints over their range at the start [rad or m].

MuJoCo's limits are soft, and a start may be recorded at one."""


class TactileWorld:
    """A robot with tactile sensors among bodies; B environments of one model.

    .. code-block:: python

        world = TactileWorld("ball_rolling", markers="fots", optics="taxim")
        for _ in range(100):
            state = world.step(world.hold)
        frame = world.observe()["sensor"]  # only now are images and markers computed

        mount(spec, "gelsight_mini", site="left_tip", name="left")  # on a MuJoCo model of your own
        world = TactileWorld(spec, touches=["cube"], control_timestep=0.02, num_envs=8)

    A MuJoCo model that is given keeps its options, and moves to the bit as MuJoCo alone moves it while no pad is touched. Only MuJoCo's
    automatic reset is disabled, since an environment that breaks down is marked in ``failed``. The model is copied.

    Attributes:
        scene: the task scene; None if a MuJoCo model was given.
        physics: configuration that is used.
        model: MuJoCo's model of the scene.
        engine: settings of MuJoCo Warp; None is C MuJoCo.
        models: the model of every environment: the scene's own, or another one after a ``reset`` with a variation.
        arm: the joints that move the robot's site; None without joints.
        composed: names and indices of the scene's parts in the model.
    """

    def __init__(
        self,
        scene: str | Path | TaskScene | mujoco.MjSpec | mujoco.MjModel,
        *,
        sensors: SensorChoice | None = None,
        touches: TouchChoice | None = None,
        control_timestep: float | None = None,
        keyframe: str | None = None,
        allow_overlap: Sequence[str] = (),
        physics: str | PhysicsConfig | None = None,
        coupling: str | None = None,
        outputs: Sequence[str] | str = ("rgb", "wrench"),
        markers: str | MarkersConfig | None = None,
        optics: str | OpticsConfig[OpticalMode] = "raytrace",
        resolution: tuple[int, int] | str | None = None,
        num_envs: int = 1,
        engine: str | WarpEngine = "mujoco",
        device: str = "auto",
        seed: int = 0,
        pitch: float | None = None,
        noise: bool = False,
    ) -> None:
        """Compose the scene and put it at its start; sensors are made on first use.

        Their settings are checked here.

        Args:
            scene: name of a shipped task scene, path of a scene file, or a scene; or a ``MjSpec`` or ``MjModel`` with sensors that
                ``raytac.mount`` put on it. The next five are of such a model.
            sensors: names of sensors, results of ``mount``, or a mapping of names to sensors, which a model needs whose sensors were
                mounted as specifications; None is every sensor that the model says it has.
            touches: names of bodies that pads touch, or of single geoms; a mapping has their friction coefficients against gel. None is
                every body with a free joint and a geom that collides. Of a body, and of what is fixed to it, the geoms that collide in
                MuJoCo are sensed; meshes as they are, not their hulls.
            control_timestep: of one ``step`` [s], a whole multiple of the model's timestep; None is one timestep.
            keyframe: name of the keyframe that is the start; None is ``qpos0``.
            allow_overlap: names of geoms in which a gel may lie at the start.
            physics: name or configuration, as ``TactileSensor`` takes it; None is as the scene says, else ``rigid``.
            coupling: ``two_way`` or ``one_way``; None is as the scene says. A rigid pad acts both ways always.
            outputs, markers, optics, resolution, device: of every sensor, as ``TactileSensor`` takes them.
            num_envs: number of environments B.
            engine: ``mujoco``, or ``mujoco_warp`` with all states and contacts on ``device``; a ``WarpEngine`` has the sizes of its
                memory.
            seed: of every random number.
            pitch, noise: spacing of the pads' grids [m], grain of images, as of ``TactileSensor``.

        Raises:
            InputError: a value out of its choices, bodies that overlap at the start, or a model that MuJoCo refuses. Of a model of one's
                own also: no sensor, nothing to touch, a mesh that is not closed, a gel inside the robot, a pyramidal friction cone or
                the integrator ``RK4``, with which a pad's contact would not follow the gel's law (see ``own_world_model``).
            SpecError: the scene breaks a rule.
            BackendError: the solver or a renderer is not installed.
        """
        asked = checked_physics(physics)
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        self.engine = checked_engine(engine)
        if coupling is not None:
            check_known("coupling", coupling, COUPLINGS)
        is_own = isinstance(scene, (mujoco.MjSpec, mujoco.MjModel))
        _check_scene(
            scene,
            sensors=sensors,
            touches=touches,
            control_timestep=control_timestep,
            keyframe=keyframe,
            allow_overlap=allow_overlap or None,
        )
        self.scene = None if is_own else scene if isinstance(scene, TaskScene) else load_task(scene)
        self.physics = (asked or PHYSICS.config("rigid")) if self.scene is None else scene_physics(asked, self.scene)
        name = PHYSICS.name_of(self.physics)
        if name not in WORLD_PADS.names:
            raise InputError("physics", value=name, rule="has pads for presses only, none for worlds", choices=WORLD_PADS.names)
        if is_own and self.physics.is_simulated:
            rule = "needs a task scene: in other MuJoCo models pads are rigid"
            raise InputError("physics", value=name, rule=rule, choices=("rigid",))
        if coupling == "one_way" and not self.physics.is_simulated:
            raise InputError(
                "coupling", value=coupling, rule="is for soft pads: a rigid pad acts both ways", choices=("two_way",)
            )
        self.coupling = coupling or (self.scene.coupling if self.scene is not None and self.physics.is_simulated else "two_way")
        self.num_envs, self.device, self.seed = num_envs, device, seed
        self.composed: WorldModel
        if isinstance(scene, (mujoco.MjSpec, mujoco.MjModel)):
            model = copy(compiled_model(scene))
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
            self.composed = own_world_model(
                model,
                sensors=sensors,
                touches=touches,
                control_timestep=control_timestep,
                keyframe=keyframe,
                allow_overlap=allow_overlap,
                spec=scene if isinstance(scene, mujoco.MjSpec) else None,
            )
        else:
            assert self.scene is not None
            self.composed = compose(self.scene, "ipc" if self.physics.is_simulated else "rigid")
        self._frames = SensorFrames(
            self.composed.sensors,
            num_envs=num_envs,
            seed=seed,
            outputs=outputs,
            markers=markers,
            optics=optics,
            resolution=resolution,
            device=device,
            physics=self.physics,
            pitch=pitch,
            noise=noise,
        )
        self._markers = None if markers is None else markers_config(markers)
        self.model = self.composed.model
        self.arm: Arm | None = self.composed.arm
        needs_height = markers is not None or "height" in ((outputs,) if isinstance(outputs, str) else outputs)
        self._states = self._make_states(needs_height=needs_height)
        self.models, self._pads = self._states.models, self._states.pads
        self._step_lock = Lock()
        check_start(self.composed, self._states.first(), self._pads.overlap(0))

    def _make_states(self, *, needs_height: bool) -> CStates | WarpStates | WarpSoftStates:
        """States of all environments and their pads, by engine and physics.

        ``needs_height``: gel surfaces are read on the device; only MuJoCo Warp with rigid pads prepares that.
        """
        engine, physics = self.engine, self.physics
        if engine is None:
            pad_class = WORLD_PADS.config_class(PHYSICS.name_of(physics))
            pads = partial(pad_class, physics=physics, coupling=self.coupling, device=self.device)
            return CStates(self.composed, self.num_envs, pads)
        if isinstance(physics, Ipc):
            from raytac.world.warp_soft_states import WarpSoftStates

            return WarpSoftStates(self.composed, self.num_envs, engine, self.device, physics=physics, coupling=self.coupling)
        from raytac.world.warp_states import WarpStates

        grids = {name: sensor.grid for name, sensor in self._frames.sensors.items()} if needs_height else {}
        return WarpStates(self.composed, self.num_envs, engine, self.device, grids=grids, markers=self._markers)

    def __repr__(self) -> str:
        name, sensors = "own model" if self.scene is None else repr(self.scene.name), ", ".join(self.sensor_names)
        touched = ", ".join(self.composed.bodies)
        return f"TactileWorld({name}, sensors: {sensors}; bodies: {touched}; {self.num_envs} environments, {self.physics.label})"

    def _repr_html_(self) -> str:
        """Card for notebooks; nothing is computed for it."""
        from raytac.io.html import card

        rows = {
            "sensors": ", ".join(self.sensor_names) or "none",
            "touched bodies": ", ".join(self.composed.bodies) or "none",
            "joints, actuators": f"{self.model.njnt}, {self.model.nu}",
            "control step": f"{1e3 * self.control_timestep:g} ms of {1e3 * self.model.opt.timestep:g} ms steps",
            "physics": self.physics.label,
            "engine": "MuJoCo" if self.engine is None else "MuJoCo Warp",
            "environments": self.num_envs,
        }
        return card(f"TactileWorld · {'own model' if self.scene is None else self.scene.name}", rows)

    def __reduce__(self) -> Any:
        """Raise ``InputError``: MuJoCo's states and recorded kernels belong to one process."""
        raise InputError("world", value=self, rule="cannot be copied or pickled: build one in each process")

    def __enter__(self) -> TactileWorld:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Do nothing, any number of times: memory goes with the last reference, nothing is held."""

    @property
    def data(self) -> tuple[mujoco.MjData, ...]:
        """MuJoCo's state in every environment.

        Raises ``InputError`` with MuJoCo Warp, whose states lie on a device.
        """
        return self._states.data

    @property
    def sensors(self) -> dict[str, TactileSensor]:
        """Every sensor by its name, made on first use."""
        return self._frames.sensors

    @property
    def soft(self) -> SoftScene | None:
        """The contact solver's scene, with everything that it knows; None with the rigid pad."""
        return self._pads.soft

    @property
    def control_timestep(self) -> float:
        """Time of one ``step`` [s]."""
        return self.composed.control_timestep

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors, without making them."""
        return self._frames.names

    def reset(
        self,
        envs: np.ndarray | list[int] | None = None,
        *,
        joints: np.ndarray | None = None,
        bodies: Mapping[str, np.ndarray] | None = None,
        variation: Variation | None = None,
    ) -> WorldState:
        """Put environments back to the start: joints, bodies, pads, markers and time.

        Args:
            envs: n environments: a mask (B,), a list, or None for all.
            joints: other starts of the arm's joints (n, joints) [rad or m].
            bodies: other starts of free bodies and of mocap bodies: name to ``world_from_body`` (n, 4, 4).
            variation: differences of these environments from the scene from now on. None keeps the present ones, ``Variation()`` removes
                them.

        Raises:
            InputError: an environment or a body that does not exist, a start of the wrong shape, not finite or not rigid, joints out of
                their range, or a variation that is not possible (see ``EnvironmentModels.check``).
            OverlapError: with soft pads, bodies that overlap at a start that is given. With the rigid pad a start may be in contact, as it
                was recorded, but no body may lie beyond a gel's bonded face. After an error nothing has changed.
        """
        chosen = chosen_envs(envs, self.num_envs)
        starts = {
            name: self._checked_start(f"bodies[{name!r}]", poses, (len(chosen), 4, 4)) for name, poses in (bodies or {}).items()
        }
        placed = [name for name, body in self.composed.bodies.items() if body.is_placed]
        for name in starts:
            if name not in placed:
                raise InputError("bodies", value=name, rule="must be the name of a free rigid body", choices=placed)
            rigid_poses(f"bodies[{name!r}]", starts[name], len(chosen))
        if joints is not None:
            joints = self._checked_start("joints", joints, (len(chosen), 0 if self.arm is None else len(self.arm)))
            self._check_joints(joints, chosen)
        if variation is not None:
            self.models.check(variation, len(chosen), rigid=not self.physics.is_simulated)
        self._states.reset(chosen, joints, starts, variation)
        self._frames.reset(chosen)
        return self.state()

    def _check_joints(self, joints: np.ndarray, envs: Sequence[int]) -> None:
        arm = self.arm
        if arm is None:
            return
        outside = np.argwhere((joints < arm.range[:, 0] - _BEYOND) | (joints > arm.range[:, 1] + _BEYOND))
        if len(outside):
            row, i = (int(k) for k in outside[0])
            rule = f"of environment {envs[row]} must be within {arm.joints[i]}'s {arm.range[i].tolist()} rad or m"
            raise InputError("joints", value=float(joints[row, i]), rule=rule)

    @staticmethod
    def _checked_start(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        values = check_numbers(name, value, shape)
        if not np.isfinite(values).all():
            bad = int(np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))[0])
            raise InputError(name, value=values[bad].tolist(), rule=f"must be finite; row {bad} is not")
        return values

    def step(self, control: Control | None = None) -> WorldState:
        """Advance every environment by the control timestep of the scene or the model.

        Args:
            control: controllers of the actuators (see ``Control``); None is ``hold``.

        Raises:
            InputError: another thread steps this world, MuJoCo's timestep or cone were changed, or controls of the wrong shape or number,
                or not finite. With soft pads also a motion near a contact that is too fast to be resolved, if there is one environment,
                which has failed then. Of several environments the one that moves so fast is marked in ``failed``, with a
                ``RuntimeWarning``.
        """
        holding = control is None or (callable(control) and control == self.hold)
        if not self._step_lock.acquire(blocking=False):
            rule = "must be stepped by one thread at a time; each thread may have a world of its own"
            raise InputError("world", value="stepped by another thread", rule=rule)
        try:
            self._states.step(None if holding else control)
        finally:
            self._step_lock.release()
        return self.state()

    @property
    def failed(self) -> np.ndarray:
        """Environments whose physics broke down, (B,), bool."""
        return self._states.failed.copy()

    def hold(self, data: mujoco.MjData, time: float) -> None:
        """Controller that keeps a scene's robot at its start, and another model's controls."""
        self._states.hold(data)

    def state(self) -> WorldState:
        """Present state of all environments."""
        values, failed = self._states.values(), self._states.failed
        wrench = {name: self._pads.wrench(name) for name in self.sensor_names}
        time = values.pop("time")
        if failed.any():
            for array in (*values.values(), *wrench.values()):
                array[failed] = np.nan
        pads = {name: values[f"pad {name}"] for name in self.sensor_names}
        bodies = {name: values[f"body {name}"] for name in self.composed.bodies}
        return WorldState(time, values.get("joints"), pads, bodies, wrench, failed.copy(), dict(self._pads.report))

    def observe(
        self, sensors: Sequence[str] | str | None = None, envs: np.ndarray | list[int] | None = None
    ) -> dict[str, TactileFrame]:
        """Frames of the sensors named (all if None), of all environments at once.

        Images and markers are computed here. Markers that depend on a contact's history (``fots``) use only the states that are observed:
        observe them in every control step.

        ``envs`` (a mask (B,) or a list) gives frames with one row for each environment named; one that is named twice has two equal rows.
        For the others no noise is drawn and no history is written.

        Raises ``InputError``: an unknown sensor or environment, or no environment at all; as ``TactileSensor.update``.
        """
        failed = self._states.failed.copy()
        try:
            return self._frames.observe(
                lambda name, grid, rows: self._pads.reading(name, grid, failed, rows), failed, sensors, envs
            )
        finally:
            self._states.fail(failed)

    def read(self, name: str) -> WarpFrame:
        """Readings of one sensor with MuJoCo Warp or soft pads: arrays on the device.

        They are those after the last step or reset, and nothing is copied. With MuJoCo Warp the height is there if ``outputs`` or markers
        ask for it, and another gel that presses is not in it, as it is in the frames of ``observe``. A soft pad has height, contact and
        traction, and the displacements of ``surface`` markers; the next reading overwrites them.

        Raises ``InputError`` for an unknown sensor, or of rigid pads with C MuJoCo.
        """
        if name not in self.sensor_names:
            raise InputError("sensor", value=name, rule="must be a sensor of the world", choices=self.sensor_names)
        if self._pads.soft is None:
            return self._states.read(name)
        sensor, pads, marker_rest = self._frames.sensors[name], cast("SoftPads", self._pads), None
        if isinstance(self._markers, SurfaceMarkers):
            if self._markers.perturbation is not None:
                raise InputError("perturbation", value=self._markers.perturbation, rule="must be None on the device")
            marker_rest = MarkerPattern.of(sensor.spec).rest[0, :, :2]
        return pads.arrays(name, sensor.grid, self._states.failed.copy(), marker_rest)

    def mesh(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Present surface of a body or soft pad: vertices (B, n, 3) [m], world, and faces (F, 3).

        Raises ``InputError`` for an unknown name, or a half-space, which is unbounded.
        """
        if self._pads.soft is not None and name in self._pads.meshes:
            return self._pads.soft.mesh(name)
        body = self.composed.bodies.get(name)
        if body is None or body.is_plane:
            bounded = [n for n, b in self.composed.bodies.items() if not b.is_plane]
            bounded += self._pads.meshes
            rule = "must be the name of a body or a soft pad, and no half-space"
            raise InputError("name", value=name, rule=rule, choices=list(dict.fromkeys(bounded)))
        from raytac.shapes.triangulate import object_surface

        surface = object_surface(body.parts)
        poses = self.state().world_from_body[name]
        return np.einsum("bij,nj->bni", poses[:, :3, :3], surface.vertices) + poses[:, None, :3, 3], surface.faces


def _check_scene(scene: object, **of_model: object) -> None:
    """Raise ``InputError`` for what is no scene, or a file of another kind.

    ``of_model``: arguments that only a MuJoCo model takes, by name; with a task scene they must be None.
    """
    if not isinstance(scene, (str, Path, TaskScene, mujoco.MjSpec, mujoco.MjModel)):
        rule = "must be a task scene, its name or path, a mujoco.MjSpec or a mujoco.MjModel"
        raise InputError("scene", value=type(scene).__name__, rule=rule)
    if isinstance(scene, (str, Path)) and Path(scene).suffix.lower() in (".xml", ".mjcf", ".urdf", ".mjb"):
        rule = "is no task scene: give a MuJoCo model as mujoco.MjSpec.from_file(path), with sensors by raytac.mount"
        raise InputError("scene", value=scene, rule=rule)
    if isinstance(scene, (mujoco.MjSpec, mujoco.MjModel)):
        return
    for name, value in of_model.items():
        if value is not None:
            raise InputError(name, value=value, rule="is for a MjSpec or MjModel: a task scene says this itself")
