"""Records that a world returns: reports of steps, contacts, forces and motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class StepReport:
    """One step of every environment; each array has shape (B,).

    Attributes:
        converged: Newton met its tolerance and the driven bodies reached their targets or are blocked.
        failed: a number was not finite; the environment stays where the step, or its last part, began until its state is set again.
        stalled: no step lowered the energy although the tolerance was not met.
        halved: the step did not converge as a whole, and was made in halves, or quarters; other fields are of all of them. Contact forces
            are those of the last part: over the step they do not add up to the change of momentum.
        blocked: share of the commanded motion that could not be made, 0 if all of it was, 1 where the environment failed.
        min_gap: least distance between surfaces over all accepted states [m]; inf if none was below d̂.
        min_det: least det F over all accepted states [-].
        newton, linear, line_search, relags: iterations.
        projected: the Hessian had to be made positive semi-definite in some iteration.
        ccd: least share of a Newton step that continuous collision detection allowed.
        speed: largest unknown's speed in the last Newton step [m/s], to compare with the tolerance; of parts, the largest.
        pairs: number of contact pairs at the end.
        kappa: barrier stiffness [Pa].
        elastic, kinetic, barrier: energies at the end [J].
    """

    converged: Flags
    failed: Flags
    stalled: Flags
    halved: Flags
    blocked: Floats
    min_gap: Floats
    min_det: Floats
    newton: Ints
    linear: Ints
    line_search: Ints
    relags: Ints
    projected: Flags
    ccd: Floats
    speed: Floats
    pairs: Ints
    kappa: Floats
    elastic: Floats
    kinetic: Floats
    barrier: Floats


@dataclass(frozen=True)
class ContactPairs:
    """The contacts of one environment, C pairs.

    Attributes:
        bodies: names of the two bodies of each pair.
        vertices: up to four world vertex numbers, −1 unused, shape (C, 4): a point and a triangle, two edges, or a point alone.
        weights: c_i; Σ c_i x_i is the separation vector of the closest points, shape (C, 4).
        normal: unit vector from the closest point of the second to that of the first, world frame, shape (C, 3).
        gap: distance [m], shape (C,).
        force: size of the normal force [N], shape (C,).
    """

    bodies: tuple[tuple[str, str], ...]
    vertices: NDArray[np.int32]
    weights: Floats
    normal: Floats
    gap: Floats
    force: Floats


@dataclass(frozen=True)
class PairForces:
    """Forces on the first of two bodies by the second, world frame.

    Attributes:
        normal: sum of the normal forces [N], shape (B, 3).
        place: their mean point of action [m], shape (B, 3); NaN where the two do not touch.
        wrench: all forces, friction included [N], and their torque about ``place`` [N m], shape (B, 6).
    """

    normal: Floats
    place: Floats
    wrench: Floats


@dataclass(frozen=True)
class Wrench:
    """Force and torque on a body, world frame.

    Attributes:
        force: [N], shape (B, 3).
        torque: about the body's frame origin [N m], shape (B, 3); about the world's origin for a body without a frame of its own.
    """

    force: Floats
    torque: Floats


@dataclass(frozen=True)
class PatchMotion:
    """A patch of a bonded body that moves as a whole, in one environment, world frame.

    Attributes:
        mass: of the patch and of what moves with it [kg].
        inertia: about ``centre`` [kg m²], shape (3, 3).
        centre: mean of its nodes [m], shape (3,).
        velocity: of the centre [m/s] and about it [rad/s], shape (6,).
        stiffness: of its support by the body, about ``centre`` [N/m], [N m/rad], shape (6, 6), symmetric.
    """

    mass: float
    inertia: Floats
    centre: Floats
    velocity: Floats
    stiffness: Floats


@dataclass(frozen=True)
class RigidMotion:
    """A body as if it moved as a whole, world frame.

    Attributes:
        mass: [kg].
        centre: centre of mass [m], shape (B, 3).
        inertia: about it [kg m²], shape (B, 3, 3).
        velocity: of the centre of mass [m/s], shape (B, 3).
        spin: angular velocity with the same angular momentum [rad/s], shape (B, 3).
    """

    mass: float
    centre: Floats
    inertia: Floats
    velocity: Floats
    spin: Floats
