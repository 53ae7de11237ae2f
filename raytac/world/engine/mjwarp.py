"""MuJoCo Warp under rigid pads: B worlds in one state, on the CPU or on CUDA.

The contacts of gels are in its contact list. Nothing in a step waits for the device, so that a step can be recorded as one CUDA graph
(``capture``). All worlds take as many steps, each of its own length. None can be left out of one: a world that is not active, has done
the scene's step already, or breaks down, is put back to where the step began.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import BackendError, InputError
from raytac.physics.rigid.gel_contact import GelContact
from raytac.physics.rigid.world_kernels import ROWS
from raytac.robots.states import Numbers, body_pose, site_pose
from raytac.warp_runtime import start_warp
from raytac.world.engine import mjwarp_kernels as kernels
from raytac.world.engine.mjwarp_lift_kernels import correct_lifts
from raytac.world.engine.number_reader import NumberReader
from raytac.world.environment_models import EnvironmentModels
from raytac.world.hard_contacts import box_sizes
from raytac.world.implicit_damping import ImplicitDamping
from raytac.world.pad_contact import PadIndices, last_dofs
from raytac.world.world_state import LARGEST_SPEED

_SLIDES = 2
"""Solves for the lift of a slide that begins or ends, before that of the step."""
_TOLERANCE = 1e-8
"""Gain of an iteration at which the solver stops, over the trace of the mass matrix.

An arm makes that trace large, so that MuJoCo Warp's own 1e-6 is coarse for a light body beside it."""
_VARIED = (
    "body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0", "body_pos",
    "body_quat", "geom_friction",
)  # fmt: skip
"""Members of MuJoCo's model that a variation changes, with those derived from them."""


class MujocoWarp:
    """States of B environments in one state of MuJoCo Warp; see ``Engine``.

    They have one model. Row i of a step is environment i.

    Attributes:
        divides, device: as of ``Engine``.
        num_envs: B.
        timestep: of the scene's steps [s].
        elapsed: time since ``advance`` began [s], (B,), which does not lose digits as MuJoCo Warp's clock does.
        active: environments that are stepped (B,), bool; those that break down are no longer.
        model, data: MuJoCo Warp's.
        peaks: most contacts of all environments at once, most pairs of MuJoCo's collision, most rows of one environment, and flags of
            overflow, (4,).
    """

    divides = False

    def __init__(
        self,
        contact: GelContact,
        pads: PadIndices,
        models: EnvironmentModels,
        *,
        timestep: float | None = None,
        contacts: int | None = None,
        rows: int | None = None,
    ) -> None:
        """Make the states, all at ``qpos0``.

        Args:
            pads: what the models call pads and what they touch.
            models: of the environments; a variation may replace one.
            timestep: of the scene's steps [s], which divide into shorter ones; None is the models'.
            contacts, rows: memory for contacts and constraint rows, an environment each; None is a guess. All environments share the
                memory for contacts. Where it is too small, environments are no longer active, and ``prepare`` and ``check_overflow``
                raise an error.

        Raises:
            BackendError: MuJoCo Warp is not installed.
            InputError: an option of the models or a part of them that MuJoCo Warp has not, or with which pads cannot act.
        """
        start_warp()
        self._mjw = mjw = _mujoco_warp()
        self._contact, self._models_now = contact, models
        num_envs = self.num_envs = contact.steps.envs.shape[0]
        self.device = contact.device
        model = _checked(models[0])
        if timestep is not None:
            model.opt.timestep = timestep
        self.timestep = float(model.opt.timestep)
        slots = len(pads.sites), len(pads.geoms)
        self._contacts = 24 + 2 * slots[0] * slots[1] + 4 * slots[1] if contacts is None else contacts
        self._rows = 4 * self._contacts if rows is None else rows
        damping = ImplicitDamping(model)
        self._damped, self._always = damping.matters, int(pads.hard.any())
        self._contact.expect_lifts(_SLIDES, model.nv)
        with wp.ScopedDevice(self.device):
            sizes = {name: num_envs for name in _VARIED if getattr(model, name).size}
            try:
                self.model: Any = mjw.put_model(model, batch_sizes=sizes)
            except (NotImplementedError, ValueError) as error:
                raise InputError(
                    "model", value=model, rule=f"is refused by MuJoCo Warp: {' '.join(str(error).split())}"
                ) from error
            self.data: Any = mjw.make_data(model, nworld=num_envs, nconmax=self._contacts, njmax=self._rows)
            self._use_gel_contacts()
            self._worlds = _worlds(self.model, self.data)
            self._entries = [self.model.M_rownnz, self.model.M_rowadr, self.model.M_colind]
            shape = num_envs, *slots
            self._own: Any = kernels.Own()
            self.active, self._done = wp.full(num_envs, value=True, dtype=wp.bool), wp.zeros(num_envs, dtype=wp.int32)
            self.elapsed = wp.zeros(num_envs, dtype=wp.float64)
            self._own.first = wp.zeros(1, dtype=wp.int32)
            self._own.contact, self._own.scale = wp.full(shape, -1, dtype=wp.int32), wp.zeros(shape, dtype=wp.float64)
            self._saved: Any = kernels.Saved()
            for name in ("time", "qpos", "qvel", "act"):
                setattr(self._saved, name, wp.clone(getattr(self.data, name)))
            self._saved.warmstart = wp.clone(self.data.qacc_warmstart)
            self._mass, self._damped_mass = wp.empty_like(self.data.M), wp.empty_like(self.data.M)
            self.peaks = wp.zeros(4, dtype=wp.int32)
            self._losses = sum(int(flag) for flag in mjw.OverflowType if flag.name in _LOST)
            bodies = np.concatenate([pads.carriers, pads.bodies])
            self._sites, self._bodies, self._last = (_array(values) for values in (pads.sites, bodies, last_dofs(model, bodies)))
            self._share = wp.array(damping.share, dtype=wp.float64)
            self._others, self._hard = _array(pads.geoms), _array(pads.hard)
            self._boxes = wp.array(box_sizes(model), dtype=wp.vec3)
            self._gels = _array(pads.geoms[len(pads.bodies) :])
        self._models = [models[0]] * num_envs
        self._take_models()
        self._poses = self.reader({"pads": site_pose(pads.sites), "bodies": body_pose(pads.bodies)})

    def _use_gel_contacts(self) -> None:
        """Room for contacts of ``ROWS`` rows, and a timestep for each environment.

        The model's own geoms may not have such contacts.
        """
        model, data = self.model, self.data
        if model.nmaxcondim < ROWS:
            model.nmaxcondim, model.nmaxpyramid = ROWS, 2 * (ROWS - 1)
            data.contact.efc_address = wp.full((data.naconmax, model.nmaxpyramid), -1, dtype=wp.int32)
        model.opt.timestep = wp.full(self.num_envs, self.timestep, dtype=wp.float32)
        model.opt.warn_overflow = 0  # check_overflow raises an error
        model.opt.tolerance.fill_(_TOLERANCE)

    def begin_step(self) -> None:
        """As of ``Engine``."""
        mjw, m, d = self._mjw, self.model, self.data
        with wp.ScopedDevice(self.device):
            wp.launch(kernels.save_states, dim=self.num_envs, inputs=[self._worlds, self._saved])
            # Constraints are made once, with those of the gels.
            flags, none = m.opt.disableflags, int(mjw.DisableBit.CONSTRAINT)
            m.opt.disableflags = flags | none
            mjw.fwd_position(m, d)
            m.opt.disableflags = flags
            mjw.collision(m, d)
            mjw.fwd_velocity(m, d)

    def free_acceleration(self) -> None:
        """As of ``Engine``."""
        with wp.ScopedDevice(self.device):
            self._mjw.fwd_actuation(self.model, self.data)
            self._mjw.fwd_acceleration(self.model, self.data)

    def prepare(self) -> None:
        """As of ``Engine``; it waits for the device."""
        self._take_models()
        self.check_overflow()

    def _take_models(self) -> None:
        """Give environments the masses, friction and mounting of models that were replaced."""
        models = [self._models_now[b] for b in range(self.num_envs)]
        if all(one is other for one, other in zip(models, self._models, strict=True)):
            return
        self._models = models
        for name in _VARIED:
            values = np.stack([getattr(one, name) for one in models])
            if values.size:
                array = getattr(self.model, name)
                array.assign(values.astype(np.float32).reshape(array.numpy().shape))

    def invalid(self) -> np.ndarray:
        """As of ``Engine``; it waits for the device."""
        fast = ~(np.abs(self.data.qvel.numpy()) < LARGEST_SPEED).all(axis=1)
        return fast | ~np.isfinite(self.data.qpos.numpy()).all(axis=1)

    def choose(self, *, scene_steps: int = 1, launched: int = 0, launches: int = 1) -> None:
        """Name the next step's environments: active, with steps of the scene to do.

        Args:
            scene_steps: number of these.
            launched: steps that were launched for these before.
            launches: number of all, in which they must be done.
        """
        numbers = [self._contact.ticks, scene_steps, launched, launches]
        self._launch(kernels.choose_worlds, self.num_envs, [self.active, *numbers, self._done, self._contact.steps])

    def read_frames(self) -> None:
        """As of ``Engine``."""
        shape, frames = (self.num_envs, len(self._bodies)), (self._worlds, self._sites, self._bodies, self._last)
        self._launch(kernels.read_frames, shape, [*frames, self._share, self._contact.frames])

    def put_contacts(self, *, own_step: bool = True) -> None:
        """As of ``Engine``, with all constraints; ``prepare`` reports contacts without memory."""
        worlds, own, mjw = self._worlds, self._own, self._mjw
        slots, steps = self._contact.slots, self._contact.steps
        with wp.ScopedDevice(self.device):
            self._launch(kernels.set_timesteps, self.num_envs, [steps, self.model.opt.timestep])
            if self._damped and own_step:
                self._add_damping()
            wp.copy(own.first, self.data.nacon)
            self._launch(kernels.append_contacts, own.contact.shape, [worlds, steps, slots, self._gels, self._others, own])
            mjw.make_constraint(self.model, self.data)
            hard = [worlds, own, self._hard, self._boxes, self.model.opt.timestep]
            self._launch(kernels.write_hard_references, self.data.naconmax, hard)
            self._launch(kernels.write_rows, own.contact.shape, [worlds, steps, slots, own])
            for _ in range(_SLIDES):
                mjw.solve(self.model, self.data)
                lifts = [self._contact.velocity, self._contact.lifts]
                self._launch(correct_lifts, self.num_envs, [worlds, own, steps, slots, *self._entries, *lifts])

    def _add_damping(self) -> None:
        model, data, steps = self.model, self.data, self._contact.steps
        self._mjw.deriv_smooth_vel(model, data, self._damped_mass)
        self._launch(kernels.add_damping, self._mass.shape, [self._worlds, steps, self._always, self._damped_mass, self._mass])
        self._mjw.factor_m(model, data)
        self._mjw.solve_m(model, data, data.qacc_smooth, data.qfrc_smooth)

    def end_step(self) -> None:
        """As of ``Engine``."""
        steps = self._contact.steps
        with wp.ScopedDevice(self.device):
            self._mjw.solve(self.model, self.data)
            if self._damped:
                wp.copy(self.data.M, self._mass)
            self._mjw.implicit(self.model, self.data)
        self._launch(kernels.end_states, self.num_envs, [self._worlds, self._saved, steps, self._losses, self.peaks])
        self._launch(kernels.end_worlds, self.num_envs, [steps, self._done, self.active])

    def read_rows(self) -> None:
        """As of ``Engine``."""
        results = [self._contact.steps, self._contact.force, self._contact.velocity]
        self._launch(kernels.read_rows, self._own.contact.shape, [self._worlds, self._own, *results])

    def advance(self, drive: Callable[[], None] = lambda: None, *, scene_steps: int = 1, launches: int | None = None) -> None:
        """Steps of the scene with the gels' contact, without the host; ``drive`` writes controls.

        All worlds together take ``launches`` steps for them, as many as the scene's if None. With more, a world divides a step in
        which something moves fast near a pad.
        """
        count = scene_steps if launches is None else launches
        if count < scene_steps:
            raise InputError("launches", value=launches, rule=f"must be {scene_steps} or more, one for each of the scene's steps")
        self._done.zero_()
        for k in range(count):
            self._launch(kernels.read_elapsed, self.num_envs, [self._done, self.timestep / self._contact.ticks, self.elapsed])
            self.begin_step()
            drive()
            self.free_acceleration()
            self.choose(scene_steps=scene_steps, launched=k, launches=count)
            self.read_frames()
            self._contact.begin()
            self.put_contacts()
            self.end_step()
            self.read_rows()
            self._contact.end()

    def finish(self) -> None:
        """Poses of the present positions, in the world and in the pads' frames, without the host.

        Environments in which a body has gone through a pad are no longer active.
        """
        self.update_poses()
        self._contact.choose_active(self.active)
        self.read_frames()
        self._contact.move()
        self._launch(kernels.end_worlds, self.num_envs, [self._contact.steps, self._done, self.active])

    def update_poses(self) -> None:
        """As of ``Engine``."""
        with wp.ScopedDevice(self.device):
            self._mjw.kinematics(self.model, self.data)

    def read_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Engine``; it waits for the device."""
        self._poses.read()
        return self._poses.arrays["pads"].numpy().copy(), self._poses.arrays["bodies"].numpy().copy()

    def reader(self, members: Mapping[str, Numbers]) -> NumberReader:
        """Reader of numbers of all environments, which are named as those of C MuJoCo's states."""
        return NumberReader(self.data, members, self.num_envs, self.device)

    def write_controls(self, actuators: wp.array, values: wp.array) -> None:
        """Set the controls of ``actuators`` (n,), int32, to ``values`` (B, n)."""
        self._launch(kernels.write_controls, values.shape, [actuators, values, self.data.ctrl])

    def capture(self, step: Callable[[], None]) -> Callable[[], None]:
        """Graph of what ``step`` launches on CUDA, else ``step``; ``step`` runs once before."""
        step()
        if self.device.is_cpu:
            return step
        with wp.ScopedDevice(self.device), wp.ScopedCapture() as capture:
            step()
        graph: Any = capture.graph
        return lambda: wp.capture_launch(graph)

    def reset(self, chosen: wp.array, qpos: wp.array, ctrl: wp.array) -> None:
        """Put ``chosen`` (B,), bool, to positions (B, nq) and controls (B, nu), at rest, time 0."""
        with wp.ScopedDevice(self.device):
            self._mjw.reset_data(self.model, self.data, reset=chosen)
        self._launch(kernels.place_states, self.num_envs, [chosen, qpos, ctrl, self._worlds, self.active])

    def check_overflow(self) -> None:
        """Raise ``InputError`` if contacts or rows were lost so far; waits for the device."""
        contacts, pairs, rows, overflow = self.peaks.numpy().tolist()
        lost = [one for one in self._mjw.OverflowType if one & overflow and one.name in _LOST]
        if not lost:
            return
        most = max(contacts, pairs)
        if most > self.data.naconmax:
            least = -(-most // self.num_envs)
            raise InputError(
                "contacts", value=self._contacts, rule=f"must be {least} or more: contacts of an environment were lost"
            )
        if rows > self.data.njmax:
            raise InputError(
                "rows", value=self._rows, rule=f"must be {rows} or more: constraint rows of an environment were lost"
            )
        names = ", ".join(str(one.name) for one in lost)
        raise InputError("contacts", value=self._contacts, rule=f"must be more: MuJoCo Warp has lost contacts ({names})")

    def _launch(self, kernel: Any, dim: Any, inputs: Sequence[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device)


_LOST = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "HFIELD")
"""Overflows of MuJoCo Warp by which contacts are lost."""


def _mujoco_warp() -> Any:
    try:
        return importlib.import_module("mujoco_warp")
    except ImportError as error:
        raise BackendError("worlds on a GPU need MuJoCo Warp: pip install 'raytac[gpu]'") from error


def _checked(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model for MuJoCo Warp, which has no automatic reset."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        raise InputError("model.opt.cone", value="pyramidal", rule="must be elliptic, since a gel sticks by its shear")
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        name = mujoco.mjtIntegrator(model.opt.integrator).name[len("mjINT_") :].lower()
        raise InputError("model.opt.integrator", value=name, rule="must be implicitfast on MuJoCo Warp")
    result = copy(model)
    result.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return result


def _worlds(model: Any, data: Any) -> Any:
    """MuJoCo Warp's arrays as the kernels take them."""
    result: Any = kernels.Worlds()
    result.sparse, result.nv = int(model.is_sparse), model.nv
    result.body_rootid, result.dof_parentid = model.body_rootid, model.dof_parentid
    result.impratio_invsqrt = model.opt.impratio_invsqrt
    for name in _DATA:
        setattr(result, name, getattr(data, name))
    for name in _CONTACT:
        setattr(result, name, getattr(data.contact, name))
    for name in ("rownnz", "rowadr", "colind"):
        setattr(result, name, getattr(data.efc, f"J_{name}"))
    for name in ("J", "D", "vel", "aref", "force", "state", "id"):
        setattr(result, name, getattr(data.efc, name))
    result.row_type = data.efc.type
    return result


def _array(values: np.ndarray) -> wp.array:
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32)


_DATA = (
    "time", "qpos", "qvel", "act", "ctrl", "qacc", "qacc_smooth", "qacc_warmstart", "M", "xpos", "xmat", "site_xpos", "site_xmat",
    "geom_xpos", "geom_xmat",
    "subtree_com", "cvel", "cdof", "nacon", "ncollision", "nefc", "overflow",
)  # fmt: skip
_CONTACT = (
    "dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp", "dim", "geom", "flex",
    "efc_address", "worldid", "type", "geomcollisionid", "adhesion", "surfacevel",
)  # fmt: skip
