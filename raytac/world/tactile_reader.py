"""``TactileReader``: frames from MuJoCo states that the user steps, by MuJoCo's contacts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import mujoco
import numpy as np

from raytac.checks import MOST_ENVIRONMENTS, check_known, check_whole
from raytac.frame import TactileFrame
from raytac.gel.surface import chosen_envs
from raytac.physics.base import PadReading
from raytac.physics.registry import rigid_physics
from raytac.physics.rigid.contacts import LoadTables
from raytac.physics.rigid.pierced import BondedFaces
from raytac.physics.rigid.search import PadSearch
from raytac.robots.frames import body_poses, site_poses
from raytac.robots.mount import MountedSensor
from raytac.se3 import inverse
from raytac.world.pad_surfaces import PadSurfaces
from raytac.world.sensor_frames import SensorFrames
from raytac.world.world_model import checked_states, own_world_model

if TYPE_CHECKING:
    from raytac.gel.surface import PadGrid
    from raytac.physics.base import PhysicsConfig
    from raytac.robots.mount import SensorChoice
    from raytac.sensor import SensorSettings
    from raytac.world.touched import TouchChoice

DEPTHS = ("force", "geometry")
"""Depths of an imprint: where the load law gives MuJoCo's force, or MuJoCo's overlap."""
_HALVINGS = 50
"""Steps of the bisection for the depth of a load: more than float64 can tell apart."""


class TactileReader:
    """Frames of B states that are only looked at.

    .. code-block:: python

        raytac.mount(spec, "gelsight_mini", site="left_tip", name="left", collide=True)
        model = spec.compile()
        reader = TactileReader(model, touches=["cube"], outputs=("rgb", "wrench"))
        mujoco.mj_step(model, data)  # by anybody
        frame = reader.read(data)["left"]

    Forces are those of MuJoCo's contacts of the gel's geom, with whatever touches it. MuJoCo's contacts are harder or softer than the gel,
    as masses and contact points have it, so their penetration says little about the imprint. With ``depth="force"`` each body that touches
    the gel is moved along the pad's z for the picture, until the load law of its shape at this place and angle gives MuJoCo's normal force.
    A body without a force is moved out of the gel. With ``depth="geometry"`` bodies are shown where they are.

    After ``mj_step`` MuJoCo's forces and poses are those of the beginning of that step; after ``mj_forward`` those of the present state.

    Attributes:
        model: the model, which is not changed.
        failed: states in which a number is not finite or a body is beyond a gel's bonded face, at the last ``read``, (B,), bool.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        sensors: SensorChoice | None = None,
        touches: TouchChoice | None = None,
        depth: str = "force",
        num_envs: int = 1,
        allow_overlap: Sequence[str] = (),
        keyframe: str | None = None,
        physics: str | PhysicsConfig | None = None,
        seed: int = 0,
        **settings: Unpack[SensorSettings],
    ) -> None:
        """Find sensors and bodies in the model.

        Args:
            model: model with sensors that ``raytac.mount`` put on it with ``collide=True``. Any integrator and friction cone will do.
            sensors, touches: as of ``TactileWorld``; only bodies of ``touches`` leave an imprint.
            depth: one of ``DEPTHS``.
            num_envs: number of states B that are read together.
            allow_overlap, keyframe: as of ``TactileWorld``: at this start, or ``qpos0``, no gel may lie in a geom that is not touched.
            physics: name or configuration of rigid pads; None is ``rigid``.
            seed: of every random number.
            settings: ``outputs``, ``markers``, ``optics``, ``resolution``, ``device``, ``pitch`` and ``noise`` of every sensor.

        Raises:
            InputError: no sensor, a gel that does not collide, and what ``TactileWorld`` refuses of bodies, or soft pads.
        """
        config = rigid_physics(physics)
        check_known("depth", depth, DEPTHS)
        check_whole("num_envs", num_envs, 1, MOST_ENVIRONMENTS)
        self.model, self.depth = model, depth
        self.composed = own_world_model(
            model, sensors=sensors, touches=touches, keyframe=keyframe, allow_overlap=allow_overlap, own_contact=False
        )
        self.failed = np.zeros(num_envs, bool)
        pads, bodies = self.composed.sensors, self.composed.touched
        self._frames = SensorFrames(pads, num_envs=num_envs, seed=seed, physics=config, **settings)
        shapes = [body.parts for body in bodies]
        self._surfaces = PadSurfaces({mounted.name: mounted.spec.gelpad for mounted in pads}, shapes, num_envs)
        self._faces = {mounted.name: BondedFaces.on_cpu([mounted.spec.gelpad], shapes) for mounted in pads}
        self._body_index = np.array([body.index for body in bodies], int)
        # Entries of one body move together: MuJoCo's force is on the body.
        self._groups = {int(index): np.flatnonzero(self._body_index == index) for index in np.unique(self._body_index)}
        self._group_of = {
            member: group for group, entries in enumerate(self._groups.values()) for member in bodies[entries[0]].members
        }
        self._search = {
            mounted.name: PadSearch(
                [mounted.spec.gelpad],
                [tuple(part for i in group for part in shapes[i]) for group in self._groups.values()],
                num_envs=num_envs,
            )
            for mounted in pads
        }

    def reset(self, envs: np.ndarray | list[int] | None = None) -> None:
        """Forget markers' history in states (mask (B,), list, None for all), for an episode.

        Raises ``InputError`` for a state that does not exist.
        """
        chosen = chosen_envs(envs, len(self.failed))
        self._surfaces.reset(chosen)
        self._frames.reset(chosen)

    def read(
        self,
        datas: mujoco.MjData | Sequence[mujoco.MjData],
        sensors: Sequence[str] | str | None = None,
        envs: np.ndarray | list[int] | None = None,
    ) -> dict[str, TactileFrame]:
        """Frames of the sensor or sensors named (all if None), a row for each state.

        ``envs`` (a mask (B,) or a list): rows of these states alone, as of ``TactileWorld.observe``; all states are given, and the others
        keep their ``failed``.

        Raises ``InputError``: another number of states, states of another model, an unknown sensor or state; as ``TactileSensor.update``.
        """
        states = checked_states(self.model, self.model, datas, len(self.failed))
        for b in chosen_envs(envs, len(states)):
            self.failed[b] = not np.isfinite(states[b].qpos.sum() + states[b].qvel.sum())
        pads = {mounted.name: mounted for mounted in self.composed.sensors}
        return self._frames.observe(
            lambda name, grid, rows: self._reading(pads[name], grid, states, rows), self.failed, sensors, envs
        )

    def _reading(
        self, mounted: MountedSensor, grid: PadGrid, states: Sequence[mujoco.MjData], envs: Sequence[int] | None
    ) -> PadReading:
        """Reading of one sensor, a row for each of ``envs`` (None: all states)."""
        rows = np.arange(len(states)) if envs is None else np.asarray(envs)
        datas, failed = [states[b] for b in rows.tolist()], self.failed[rows]
        world_from_pad = site_poses(datas, int(self.model.site(mounted.site).id))
        pad_from_body = inverse(world_from_pad)[:, None] @ body_poses(datas, self._body_index)
        wrench, load = self._forces(mounted, datas, world_from_pad)
        failed |= self._faces[mounted.name].pierced(pad_from_body[:, None]).any(axis=(1, 2))
        if self.depth == "force":
            self._settle(mounted, pad_from_body, load, failed)
        return self._surfaces.reading(mounted.name, grid, pad_from_body, wrench, failed, rows)

    def _forces(
        self, mounted: MountedSensor, datas: Sequence[mujoco.MjData], world_from_pad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Wrench (B, 6) of all contacts on the gel, pad frame, and the normal loads (B, groups) [N]."""
        gel, groups = int(self.model.geom(mounted.gel).id), len(self._groups)
        wrench, load, local = np.zeros((len(datas), 6)), np.zeros((len(datas), groups)), np.zeros(6)
        for b, data in enumerate(datas):
            if not data.ncon:
                continue
            geoms = data.contact.geom[: data.ncon]
            rotation, origin = world_from_pad[b, :3, :3], world_from_pad[b, :3, 3]
            for k in np.flatnonzero((geoms == gel).any(axis=1)).tolist():
                mujoco.mj_contactForce(self.model, data, k, local)
                contact = data.contact[k]
                gel_is_first = int(geoms[k, 0]) == gel
                # MuJoCo's force is on the second geom.
                axes = contact.frame.reshape(3, 3) * (-1.0 if gel_is_first else 1.0)
                force, torque = local[:3] @ axes, local[3:] @ axes
                torque = torque + np.cross(contact.pos - origin, force)
                on_pad = np.concatenate([force @ rotation, torque @ rotation])
                wrench[b] += on_pad
                group = self._group_of.get(int(self.model.geom_bodyid[geoms[k, 1 if gel_is_first else 0]]))
                if group is not None:
                    load[b, group] -= on_pad[2]
        return wrench, load

    def _settle(self, mounted: MountedSensor, pad_from_body: np.ndarray, load: np.ndarray, failed: np.ndarray) -> None:
        """Move bodies along z, in place, until the law gives their loads (B, groups) [N]."""
        sound, gelpad = np.flatnonzero(~failed), mounted.spec.gelpad
        firsts = [int(group[0]) for group in self._groups.values()]
        poses = pad_from_body[sound][:, None, firsts]
        contacts = self._search[mounted.name].contacts(poses, sound, gelpad.thickness)
        target = np.maximum(load[contacts.env, contacts.body], 0.0)
        law = LoadTables(contacts, np.full(len(contacts), gelpad.thickness))
        low, high = np.zeros(len(contacts)), np.maximum(contacts.depth + contacts.clearance, 0.0)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            is_above = law.force(middle)[0] > target
            low, high = np.where(is_above, low, middle), np.where(is_above, middle, high)
        lift = np.where(target > 0.0, contacts.depth - low, np.maximum(contacts.depth, 0.0))
        for group, entries in enumerate(self._groups.values()):
            of_group = contacts.body == group
            for i in entries:
                pad_from_body[contacts.env[of_group], i, 2, 3] += lift[of_group]
