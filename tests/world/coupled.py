"""Small MuJoCo models coupled to a soft scene, without the rest of a task scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import warp as wp

from raytac.physics.soft.bodies import SceneBody, ScenePad
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.physics.soft.scene import SoftScene
from raytac.specs import load_sensor
from raytac.world.c_coupling import CCoupling
from raytac.world.coupling_inputs import CouplingInputs

SENSOR = load_sensor("gelsight_mini")
MESH = pad_mesh(SENSOR.gelpad, PadLevel(3e-3, 2, 1.5, 1.5, 5e-5))


def pose(rotation=None, position=(0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.eye(4)
    if rotation is not None:
        matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


@dataclass(frozen=True)
class Contact:
    """A contact as ``set_interval`` writes it; ``side`` and ``other`` as of ``coupling_kernels.Contacts``."""

    side: int
    stiffness: np.ndarray
    place: np.ndarray
    other: int = -1
    normal: np.ndarray | None = None
    """None: never opens."""
    wrench: np.ndarray | None = None
    """None: ``normal`` alone."""


def set_interval(
    coupling: CCoupling, wrench: np.ndarray, contacts: Sequence[Contact] = (), bodies: Sequence[Mapping[str, object]] = ()
) -> None:
    """Begin an interval of the only environment with these contacts and bodies of the solver."""
    law = coupling.law
    law.wrench.numpy()[0], law.contacts.count.numpy()[0] = wrench, len(contacts)
    fields = {
        name: getattr(law.contacts, name).numpy()[0]
        for name in ("side", "stiffness", "place", "normal", "opens", "force", "torque")
    }
    for k, one in enumerate(contacts):
        normal = np.zeros(3) if one.normal is None else one.normal
        share = np.append(normal, np.zeros(3)) if one.wrench is None else one.wrench
        fields["side"][k], fields["stiffness"][k], fields["place"][k] = (one.side, one.other), one.stiffness, one.place
        fields["opens"][k], fields["normal"][k] = one.normal is not None, normal
        fields["force"][k], fields["torque"][k] = share[:3], share[3:]
    for s, body in enumerate(bodies):
        for name, value in body.items():
            getattr(law.solver_bodies, name).numpy()[0, s] = value
    coupling.update([0])


class Coupled:
    """Bodies of one MuJoCo model that carry pads (their frames are the pads'), and bodies of a soft scene; one environment."""

    def __init__(
        self,
        xml: str,
        pads: list[str],
        bodies: list[SceneBody],
        places: Mapping[str, np.ndarray],
        *,
        led: list[str] | None = None,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        interval: float = 0.01,
        law: bool = True,
        two_way: bool = True,
        speed: float = 0.0,
    ) -> None:
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.data.qvel[0] = speed
        mujoco.mj_forward(self.model, self.data)
        self.pads, self.led, self.interval, self.law, self.two_way = pads, led or [], interval, law, two_way
        self.links = {name: int(self.model.body(name).id) for name in [*pads, *self.led]}
        self.scene = SoftScene(
            [ScenePad(name, SENSOR, MESH, 0.2e-3) for name in pads], bodies, self.cases(), places, gravity=gravity, dt=interval
        )
        self.inputs = CouplingInputs(self.scene, list(self.links))
        room, count = self.inputs.contacts, self.inputs.solver_bodies
        self.coupling = CCoupling([self.model], [self.data], list(self.links.values()), contacts=room, solver_bodies=count)
        self.wrench = np.zeros((len(self.links), 6))

    def at(self, name: str) -> np.ndarray:
        index = self.model.body(name).id
        return pose(self.data.xmat[index].reshape(3, 3), self.data.xpos[index])

    def cases(self) -> np.ndarray:
        return np.stack([self.at(name) for name in self.pads])

    def run(self, seconds: float, control: Callable[[mujoco.MjData], None] | None = None) -> list[float]:
        """The energy of both simulators after every exchange [J], without that of controls."""
        h, energies = self.model.opt.timestep, []
        per, done, steps = round(self.interval / h), 0, round(seconds / h)
        while done < steps:
            for k in range(1, per + 1):
                mujoco.mj_step1(self.model, self.data)
                if control is not None:
                    control(self.data)
                self.coupling.apply([0])
                mujoco.mj_step2(self.model, self.data)
                mujoco.mj_kinematics(self.model, self.data)
                if k == per or not self.scene.is_small(self.cases(), self._led()):
                    break
            done += k
            mujoco.mj_comPos(self.model, self.data)
            report = self.scene.step(self.cases(), self._led(), dt=k * h)
            assert not report.failed[0] and report.min_gap[0] > 0.0 and report.min_det[0] > 0.0
            self.inputs.gather(self.coupling.law, wp.ones(1, dtype=wp.int32, device="cpu"))
            self.wrench = self.coupling.law.wrench.numpy()[0].copy()
            if not self.law or not self.two_way:
                self.coupling.law.contacts.count.zero_()
            if not self.two_way:
                self.coupling.law.wrench.zero_()
            self.coupling.update([0])
            mujoco.mj_energyPos(self.model, self.data)
            mujoco.mj_energyVel(self.model, self.data)
            energies.append(float(self.data.energy.sum() + report.elastic[0] + report.barrier[0]))
        return energies

    def _led(self) -> dict[str, np.ndarray]:
        return {name: self.at(name) for name in self.led}
