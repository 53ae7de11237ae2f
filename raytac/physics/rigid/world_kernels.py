"""Arrays that the kernels of a world's pads share: gels, bodies, differences, slots.

A slot's body is one of the ``bodies`` that pads touch, or another pad's gel: gel k is body ``bodies`` + k. The kernels work on n rows,
the environments of this step, in the order of ``envs``, and skip the rows after these. What lasts from step to step has one entry for
each of all B environments.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

ROWS = 6
"""Constraint rows of a contact: normal, two tangents, spin, two of rolling."""


@wp.struct
class Gels:
    """Gels of the pads, each (pads,)."""

    thickness: wp.array(dtype=wp.float64)
    half: wp.array(dtype=wp.vec2d)
    """Half edges along x and y [m]."""
    rest: wp.array(dtype=wp.vec2d)
    """Greatest slope of the surface at rest, and greatest distance from the origin [m]."""
    modulus: wp.array(dtype=wp.float64)
    """Young's [Pa]."""
    shear: wp.array(dtype=wp.vec2d)
    """Shear stiffness [N/m] over the contact's radius, and over its square."""
    twist: wp.array(dtype=wp.float64)
    """Twist stiffness [N m/rad] of a half-space over the third power of the radius."""
    hysteresis: wp.array(dtype=wp.float64)
    relaxation: wp.array(dtype=wp.float64)
    """Time [s]."""
    case_centre: wp.array(dtype=wp.vec3d)
    """Of the box behind the gel, pad frame."""
    case_half: wp.array(dtype=wp.vec3d)
    carrier: wp.array(dtype=wp.int32)
    """Body of the model that carries the pad: gels of one body do not touch."""


@wp.struct
class Touched:
    """Bodies that pads may touch, then the gels of the pads."""

    bodies: wp.int32
    mass_centre: wp.array(dtype=wp.vec3d)
    """In the frame of the body that carries it, (bodies + pads,)."""
    radius: wp.array(dtype=wp.float64)
    """Of a ball about a body's origin [m], (bodies,); inf of a half-space."""
    first_box: wp.array(dtype=wp.int32)
    """First box of each body, (bodies + 1,). A box holds one part."""
    box_turn: wp.array(dtype=wp.mat33d)
    box_centre: wp.array(dtype=wp.vec3d)
    """Body frame."""
    box_half: wp.array(dtype=wp.vec3d)
    """Half edges [m]; inf of a half-space, which lies behind its centre along z."""


@wp.struct
class Differences:
    """Numbers of B environments."""

    inverse_weight: wp.array2d(dtype=wp.float64)
    """1/m of the model's bodies [1/kg], (B, bodies of the model)."""
    gel_stiffness: wp.array2d(dtype=wp.float64)
    """Factors of the gels' moduli, (B, pads)."""
    gel_friction: wp.array2d(dtype=wp.float64)
    body_friction: wp.array2d(dtype=wp.float64)
    """(B, bodies); NaN where it is the gel's."""
    carrier: wp.array(dtype=wp.int32)
    """Body of the model of everything touched, (bodies + pads,)."""


@wp.struct
class Motion:
    """Poses and velocities relative to pads, of n environments."""

    world_from_pad: wp.array2d(dtype=wp.mat44d)
    pose: wp.array3d(dtype=wp.mat44d)
    """``pad_from_body`` (n, pads, bodies + pads)."""
    velocity: wp.array3d(dtype=wp.vec3d)
    """Of bodies' origins relative to the pad [m/s], pad frame."""
    spin: wp.array3d(dtype=wp.vec3d)
    """Relative to the pad [rad/s]."""
    push: wp.array3d(dtype=wp.float64)
    """Greatest free acceleration of any point of a body against any of the pad [m/s²]."""
    case_step: wp.array2d(dtype=wp.float64)
    """Longest step [s] in which no body's ball enters the case far, (n, pads)."""
    before: wp.array3d(dtype=wp.mat44d)
    """``pose`` of bodies at the last step, (n, pads, bodies)."""
    suspect: wp.array3d(dtype=wp.int32)
    """1 where a body may lie beyond the bonded face or have gone through it, (n, pads, bodies)."""
    near_gel: wp.array3d(dtype=wp.int32)
    """1 where two gels may touch in this step, (n, pads, pads), the first pad before the second."""


@wp.struct
class Slots:
    """Contacts of this step, (n, pads, bodies + pads), pad frame unless said otherwise."""

    row: wp.array3d(dtype=wp.int32)
    """Row among the results of the search; −1 without a contact that can move."""
    held: wp.array3d(dtype=wp.int32)
    """1 where the contact is one of MuJoCo's."""
    speed: wp.array3d(dtype=wp.float64)
    """At which it closes [m/s]."""
    longest: wp.array3d(dtype=wp.float64)
    """Step that it allows [s]."""
    centre: wp.array3d(dtype=wp.vec3d)
    radius: wp.array3d(dtype=wp.float64)
    """Of contact, as deep as it goes in the step [m]."""
    axes: wp.array3d(dtype=wp.mat33d)
    """Rows: normal and tangents of the constraint."""
    turn: wp.array3d(dtype=wp.vec2d)
    """Cosine and sine of the angle from the pad's tangents to those."""
    place: wp.array3d(dtype=wp.vec3d)
    """World frame."""
    frame: wp.array3d(dtype=wp.mat33d)
    """``axes`` in the world frame."""
    friction: wp.array4d(dtype=wp.float64)
    """MuJoCo's coefficients: two tangents, spin [m], rolling about both tangents [m], (…, 5)."""
    force: wp.array4d(dtype=wp.float64)
    """f₀ [N, N m], (…, ROWS)."""
    regularisation: wp.array4d(dtype=wp.float64)
    """R, (…, ROWS)."""
    bend: wp.array3d(dtype=wp.vec2d)
    """Share of the torque of rolling that builds up per angle about each tangent [1/rad]."""
    lift: wp.array3d(dtype=wp.float64)
    """Normal force that MuJoCo's cone adds, which f₀ is without [N]."""
    wrench: wp.array3d(dtype=wp.spatial_vectord)
    """Force and torque on the pad, about its origin."""
    opposite: wp.array3d(dtype=wp.spatial_vectord)
    """On the other gel, in its frame."""


@wp.struct
class Steps:
    """One step of n environments, each of its own length."""

    envs: wp.array(dtype=wp.int32)
    """Indices among all B; −1 in rows that this step is without."""
    done: wp.array(dtype=wp.int32)
    """Ticks of the scene's step that are done."""
    most: wp.array(dtype=wp.int32)
    """Most steps, with this one, in which the rest of the scene's step is done; 0 is any."""
    ticks: wp.array(dtype=wp.int32)
    """Ticks of this step."""
    length: wp.array(dtype=wp.float64)
    """Δt [s]."""
    lost: wp.array(dtype=wp.int32)
    """1 where physics broke down, and in rows without an environment."""
    contacts: wp.array(dtype=wp.int32)
    """Contacts of gels that are held."""
    slides: wp.array(dtype=wp.int32)
    """1 where a contact may begin or end to slide, so that its lift is not known yet."""
    solves: wp.array(dtype=wp.int32)
    """Solves of MuJoCo's for lifts so far."""


@wp.struct
class Shear:
    """State of the shear of all contacts, (B, pads, bodies + pads); see ``ShearState``."""

    stretch: wp.array4d(dtype=wp.vec3d)
    inner: wp.array4d(dtype=wp.float64)
    width: wp.array3d(dtype=wp.float64)
    mean: wp.array3d(dtype=wp.vec3d)
    stiffness: wp.array3d(dtype=wp.vec2d)
    load: wp.array3d(dtype=wp.vec2d)
    centre: wp.array3d(dtype=wp.vec3d)
    play: wp.array4d(dtype=wp.vec2d)
    moved: wp.array3d(dtype=wp.vec2d)


@wp.func
def total_thickness(gels: Gels, touched: Touched, pad: wp.int32, body: wp.int32) -> wp.float64:
    """Thickness [m] of the gel, or of both gels."""
    result = gels.thickness[pad]
    if body >= touched.bodies:
        result += gels.thickness[body - touched.bodies]
    return result


@wp.func
def softening(vary: Differences, gels: Gels, touched: Touched, env: wp.int32, pad: wp.int32, body: wp.int32) -> wp.float64:
    """Factor of the modulus of the pad's gel; with that of the other gel in series."""
    own = vary.gel_stiffness[env, pad]
    if body >= touched.bodies:
        other = body - touched.bodies
        own /= wp.float64(1.0) + own * gels.modulus[pad] / (vary.gel_stiffness[env, other] * gels.modulus[other])
    return own


@wp.func
def compliance_of(vary: Differences, gels: Gels, env: wp.int32, pad: wp.int32, body: wp.int32) -> wp.float64:
    """1/m [1/kg] of both bodies of a contact; 0 where neither moves."""
    return vary.inverse_weight[env, gels.carrier[pad]] + vary.inverse_weight[env, vary.carrier[body]]


@wp.func
def friction_of(vary: Differences, touched: Touched, env: wp.int32, pad: wp.int32, body: wp.int32) -> wp.float64:
    """Coulomb's coefficient: the body's own against gel, else the gel's."""
    if body < touched.bodies:
        own = vary.body_friction[env, body]
        if not wp.isnan(own):
            return own
    return vary.gel_friction[env, pad]
