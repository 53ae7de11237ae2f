"""State of B copies of one pad's coat and of what touches it, on the solver's device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import ipc
from raytac.physics.soft import reading_kernels as kernels
from raytac.physics.soft.bodies import SceneBody, ScenePad
from raytac.physics.soft.undersides import Touched
from raytac.shapes.part import Part


@dataclass(frozen=True)
class ContactObject:
    """One object that B pads may touch, in NumPy; pad frame."""

    parts: Sequence[Part]
    """Exact shape of a rigid object, object frame; empty for a soft one."""
    poses: np.ndarray
    """``pad_from_object``, (B, 4, 4)."""
    surface: tuple[np.ndarray, np.ndarray] | None = None
    """Present vertices (B, n, 3) [m] and faces of a soft object."""
    touching: np.ndarray | None = None
    """Mask (B,) of the environments in which it touches, else it may lie behind; None: all."""
    friction: float | None = None
    """Coulomb's coefficient on the pad; None: not known, friction is shown as the mesh has it."""


@dataclass(frozen=True)
class CoatState:
    """The solver's state of B copies of one pad's coat; pad frame."""

    vertices: wp.array
    """Vertices of the coat [m], (B, V) of ``vec3d``."""
    forces: wp.array
    """Contact force on each of them [N], (B, V) of ``vec3d``."""
    objects: Touched

    @classmethod
    def of(
        cls, vertices: np.ndarray, forces: np.ndarray, objects: Sequence[ContactObject] = (), device: Any = "cpu"
    ) -> CoatState:
        """From NumPy: vertices and forces (B, V, 3), and objects."""
        ordered = sorted(objects, key=lambda one: one.surface is not None)
        count, batch = len(ordered), len(vertices)
        poses, touching = np.zeros((batch, count, 4, 4)), np.ones((batch, count), bool)
        for k, one in enumerate(ordered):
            poses[:, k] = one.poses
            if one.touching is not None:
                touching[:, k] = one.touching
        friction = [np.nan if one.friction is None or one.surface is not None else one.friction for one in ordered]
        surfaces = tuple(
            (wp.array(one.surface[0], dtype=wp.vec3d, device=device), wp.array(one.surface[1], dtype=wp.vec3i, device=device))
            for one in ordered
            if one.surface is not None
        )
        touched = Touched(
            tuple(one.parts for one in ordered if one.surface is None),
            wp.array(poses, dtype=wp.mat44d, device=device),
            wp.array(touching, dtype=wp.bool, device=device),
            wp.array(np.array(friction, float), dtype=wp.float64, device=device),
            surfaces,
        )
        return cls(wp.array(vertices, dtype=wp.vec3d, device=device), wp.array(forces, dtype=wp.vec3d, device=device), touched)

    def update(self, vertices: np.ndarray, forces: np.ndarray, poses: np.ndarray, surface: np.ndarray | None = None) -> None:
        """Write the present state of a pad with one object, from NumPy, as of ``of``."""
        self.vertices.assign(vertices)
        self.forces.assign(forces)
        self.objects.poses.assign(poses[:, None])
        if surface is not None:
            self.objects.surfaces[0][0].assign(surface)


class SceneCoat:
    """Reads a pad's ``CoatState`` out of the arrays of a solver's world, without the host.

    Attributes:
        state: what is read, but for the poses of ``free``.
        free: soft bodies without a frame of their own, and the column of their poses.
    """

    def __init__(
        self,
        world: ipc.World,
        pad: ScenePad,
        others: Sequence[ScenePad],
        bodies: Mapping[str, SceneBody],
        friction: Mapping[str, float],
    ) -> None:
        """Make the arrays.

        Args:
            others: the other pads.
            bodies: rigid and soft ones by name.
            friction: coefficient of each body on the pad.
        """
        self._world, self._name, device, count = world, pad.name, world.device, world.num_envs
        layout, index = world.layout, world.layout.names.index
        mine = index(pad.name)
        near = {int(sum(pair)) - mine for pair in layout.pairs if mine in pair and sum(pair) != 2 * mine}
        self._rigid = [body for body in bodies.values() if not body.is_soft and index(body.name) in near]
        soft = [body for body in bodies.values() if body.is_soft and index(body.name) in near]
        self._soft: list[tuple[str, Any]] = [(body.name, body.skin) for body in soft]
        self._soft += [(other.name, None) for other in others if index(other.name) in near]
        names = [*(body.name for body in self._rigid), *(name for name, _ in self._soft)]
        self.free = {body.name: names.index(body.name) for body in soft if not body.is_driven}
        object_of = np.full(len(layout.pairs), -1)
        for k, name in enumerate(names):
            object_of[[set(pair) == {mine, index(name)} for pair in layout.pairs.tolist()]] = k
        self._object_of = wp.array(object_of, dtype=wp.int32, device=device)
        vertex_of = world.surface(pad.name)[0]
        number = np.full(len(pad.mesh.tets.vertices), -1)
        number[vertex_of] = np.arange(len(vertex_of))
        self._node = wp.array(pad.mesh.coat_vertices, dtype=wp.int32, device=device)
        self._vertex = wp.array(number[pad.mesh.coat_vertices], dtype=wp.int32, device=device)
        vertices, forces = (
            wp.zeros((count, len(number[pad.mesh.coat_vertices])), dtype=wp.vec3d, device=device) for _ in range(2)
        )
        poses = np.tile(np.eye(4), (count, len(names), 1, 1))
        known = [friction.get(body.name, np.nan) for body in self._rigid] + [np.nan] * len(self._soft)
        surfaces = []
        for name, skin in self._soft:
            faces, points = (
                (world.surface(name)[1], len(world.surface(name)[0])) if skin is None else (skin.faces, len(skin.rest))
            )
            own = wp.zeros((count, points), dtype=wp.vec3d, device=device)
            surfaces.append((own, wp.array(faces, dtype=wp.vec3i, device=device)))
        self._skins = [None if skin is None else _skin_arrays(skin, device) for _, skin in self._soft]
        self._corners = {body.name: self._corner(body) for body in self._rigid if not body.is_driven}
        self.state = CoatState(
            vertices,
            forces,
            Touched(
                tuple(body.parts for body in self._rigid),
                wp.array(poses, dtype=wp.mat44d, device=device),
                wp.zeros((count, len(names)), dtype=wp.bool, device=device),
                wp.array(known, dtype=wp.float64, device=device),
                tuple(surfaces),
            ),
        )

    def read(self) -> CoatState:
        """Launch the reading; the state has the same arrays every time."""
        world, state = self._world, self.state
        pad, contacts, count = world.arrays(self._name), world.contact_arrays(), world.num_envs
        frame = [pad.rotation, pad.position]
        coat = [pad.nodes, self._node, pad.forces, self._vertex, pad.rotation, state.vertices, state.forces]
        self._launch(kernels.read_coat, state.vertices.shape, coat)
        touched = state.objects
        self._launch(kernels.read_touching, count, [contacts.count, contacts.pair, self._object_of, touched.touching])
        for k, body in enumerate(self._rigid):
            arrays = world.arrays(body.name)
            if body.is_driven:
                self._launch(kernels.read_driven_pose, count, [*frame, arrays.rotation, arrays.position, k, touched.poses])
            else:
                self._launch(kernels.read_affine_pose, count, [*frame, arrays.nodes, *self._corners[body.name], k, touched.poses])
        for k, ((name, _), skin, (vertices, _)) in enumerate(zip(self._soft, self._skins, touched.surfaces, strict=True)):
            arrays = world.arrays(name)
            if name not in self.free:
                self._launch(
                    kernels.read_driven_pose,
                    count,
                    [*frame, arrays.rotation, arrays.position, len(self._rigid) + k, touched.poses],
                )
            if skin is None:
                self._launch(kernels.read_surface, vertices.shape, [*frame, arrays.vertices, vertices])
            else:
                own = [arrays.rotation, arrays.position, arrays.nodes, *skin]
                self._launch(kernels.read_skin, vertices.shape, [*frame, *own, vertices])
        return state

    def _corner(self, body: SceneBody) -> tuple[wp.array, wp.vec3d]:
        """Gradients of the corners' hat functions, and the first corner at rest, body frame."""
        layout = self._world.layout
        index = layout.names.index(body.name)
        pose = self._world.bodies[index].pose
        turn = ipc.rotation_matrix(np.asarray(pose.rotation, float))
        first = turn.T @ (layout.node_rest[layout.node_start[index]] - np.asarray(pose.position, float))
        gradients = np.asarray(layout.grads[layout.tet_start[index]], float).reshape(4, 3)
        return wp.array(gradients, dtype=wp.vec3d, device=self._world.device), wp.vec3d(*first.tolist())

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._world.device)


def _skin_arrays(skin: Any, device: Any) -> tuple[wp.array, wp.array]:
    vertex, weight = skin.weights
    return wp.array(vertex, dtype=wp.int32, device=device), wp.array(weight, dtype=wp.float64, device=device)
