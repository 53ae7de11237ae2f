"""Kernels of ``ContactHistory``: connected contacts, and the object's motion at each."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import math
from typing import Any

import warp as wp

from raytac.markers.contacts import TWIST_SLIP
from raytac.physics.rigid.motion_kernels import is_finite, turn_of
from raytac.physics.rigid.world_kernels import Shear

wp.set_module_options({"enable_backward": False, "fast_math": False})

_TWIST_SLIP = wp.constant(wp.float64(TWIST_SLIP))
_B = wp.constant(wp.float64(1.0 / TWIST_SLIP**2))
_PI = wp.constant(wp.float64(math.pi))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_12 = wp.constant(wp.float64(12.0))
_NAN = wp.constant(wp.float64(float("nan")))
_LEAST_DEPTH = wp.constant(wp.float64(1e-9))
"""Weight of a cell that is touched without depth [m]."""
_TINY = wp.constant(wp.float64(1e-12))
_LIMIT_STEPS = 6
"""Newton steps of ``kept_shares`` in double precision."""


@wp.struct
class Pad:
    """Grid and cells of a pad, and the law of its contacts."""

    first: wp.vec2d
    """Centre of the first cell along x and y [m]."""
    pitch: wp.vec2d
    """Of cells [m]."""
    nodes: wp.vec2i
    """Nodes of a cell along x and y."""
    node_first: wp.vec2d
    node_pitch: wp.vec2d
    rest: wp.array2d(dtype=wp.float64)
    reach: wp.float64
    slip: wp.float64
    """Negative: contacts never slip."""
    follows_shear: wp.int32


@wp.struct
class Contact:
    """Contact as a row of ``Contacts.table``; ``place``: centre, and height of the pressed gel."""

    active: wp.int32
    place: wp.vec3d
    """Centre, and height of the pressed gel [m]."""
    shear: wp.vec2d
    twist: wp.float64
    ellipse: wp.vec3d
    depth: wp.float64
    radius: wp.float64


@wp.struct
class Moments:
    """Sums over the cells of one contact."""

    weight: wp.float64
    at: wp.vec2d
    count: wp.float64
    first: wp.vec2d
    second: wp.vec3d


@wp.kernel
def pool(
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
    pad: Pad,
    # outputs
    depth: wp.array3d(dtype=wp.float32),
):
    """Mean indentation where a body touches, of each cell; −1 where none touches it."""
    env, row, column = wp.tid()
    kx, ky, total, touched = pad.nodes[0], pad.nodes[1], wp.float32(0.0), wp.int32(0)
    for n in range(ky):
        j = row * ky + n
        for m in range(kx):
            i = column * kx + m
            if j < height.shape[1] and i < height.shape[2]:
                if contact[env, j, i] != wp.uint8(0):
                    touched = wp.int32(1)
                    total += wp.max(wp.float32(pad.rest[j, i]) - height[env, j, i], wp.float32(0.0))
    depth[env, row, column] = wp.where(touched == 1, total / wp.float32(kx * ky), wp.float32(-1.0))


@wp.func
def root_of(parent: wp.array2d(dtype=wp.int32), env: wp.int32, cell: wp.int32) -> wp.int32:
    at = wp.int32(cell)
    while parent[env, at] != at:
        at = parent[env, at] + 0
    return at


@wp.func
def join(parent: wp.array2d(dtype=wp.int32), env: wp.int32, a: wp.int32, b: wp.int32):
    """Join two pieces; the first cell of both is the root (Rosenfeld and Pfaltz 1966)."""
    one, two = root_of(parent, env, a), root_of(parent, env, b)
    if one < two:
        parent[env, two] = one
    else:
        parent[env, one] = two


@wp.func
def kept_shares(x: Any, y: Any, steps: wp.int32):
    """Shares of a shear and of a twist that stick, by both over their limits.

    They are those of the closest point of the ellipsoid, in energy, by Newton's method on 1 / √(x² + y²) = 1. This is a straight line in
    γ for b = 1, from where the larger of the two alone would be; b as in ``fots``.
    """
    b, one, none = type(x)(_B), type(x)(1.0), type(x)(0.0)
    gamma = wp.max(wp.max(x - one, (y - one) / b), none)
    for _ in range(steps):
        p, q = one + gamma, one + b * gamma
        xp, yq = x / p, y / q
        n = wp.sqrt(xp * xp + yq * yq)
        gamma = gamma + n * n * wp.max(n - one, none) / wp.max(xp * xp / p + b * yq * yq / q, type(x)(1e-12))
    return one / (one + gamma), one / (one + b * gamma)


@wp.func
def contact_of(m: Moments, pad: Pad) -> Contact:
    """A contact without history from the sums over its cells."""
    result = Contact()
    dx, dy = pad.pitch[0], pad.pitch[1]
    area = m.count * dx * dy / _PI
    x, y = m.first[0] / m.count, m.first[1] / m.count
    xx = (m.second[0] / m.count - x * x + _1 / _12) * dx * dx
    xy = (m.second[1] / m.count - x * y) * dx * dy
    yy = (m.second[2] / m.count - y * y + _1 / _12) * dy * dy
    scale = area / wp.sqrt(xx * yy - xy * xy)
    at_x, at_y = m.at[0] / m.weight, m.at[1] / m.weight
    i = wp.min(wp.int32(wp.rint((at_x - pad.node_first[0]) / pad.node_pitch[0])), pad.rest.shape[1] - 1)
    j = wp.min(wp.int32(wp.rint((at_y - pad.node_first[1]) / pad.node_pitch[1])), pad.rest.shape[0] - 1)
    result.active = 1
    result.depth = m.weight / m.count
    result.place = wp.vec3d(at_x, at_y, pad.rest[j, i] - result.depth)
    result.ellipse = wp.vec3d(scale * xx, scale * xy, scale * yy)
    result.radius = wp.sqrt(area)
    return result


@wp.func
def slipped(contact: Contact, slip: wp.float64) -> Contact:
    """Contact with the shear and twist that it keeps, by ``kept_shares``."""
    result = contact
    determinant = contact.ellipse[0] * contact.ellipse[2] - contact.ellipse[1] * contact.ellipse[1]
    radius = wp.sqrt(wp.sqrt(wp.max(determinant, wp.float64(1e-24))))
    shear_max, twist_max = slip * contact.depth * radius, _TWIST_SLIP * slip * contact.depth
    x, y = wp.length(contact.shear) / wp.max(shear_max, _TINY), wp.abs(contact.twist) / wp.max(twist_max, _TINY)
    if x * x + y * y > _1:
        sheared, turned = kept_shares(x, y, _LIMIT_STEPS)
        result.shear = sheared * contact.shear
        result.twist = turned * contact.twist
    return result


@wp.kernel
def detect(
    depth: wp.array3d(dtype=wp.float32),
    windows: wp.array(dtype=wp.vec4i),
    pad: Pad,
    # work
    parent: wp.array2d(dtype=wp.int32),
    moments: wp.array2d(dtype=Moments),
    # outputs
    box: wp.array(dtype=wp.vec4i),
    contacts: wp.array2d(dtype=Contact),
    most: wp.array(dtype=wp.int32),
):
    """Contacts of every environment, 8-connected, by their first cells, without history.

    ``windows``: columns from, to and rows from, to, beyond which no cell is looked at; ``box``: the same of the cells in contact. ``most``:
    greatest number of contacts of an environment so far; those beyond the memory are left out.
    """
    env = wp.tid()
    rows, columns, room, window = depth.shape[1], depth.shape[2], contacts.shape[1], windows[env]
    c0, c1, r0, r1 = wp.int32(columns), wp.int32(0), wp.int32(rows), wp.int32(0)
    for row in range(window[2], window[3]):
        for column in range(window[0], window[1]):
            cell = row * columns + column
            parent[env, cell] = -1
            if depth[env, row, column] >= wp.float32(0.0):
                c0, c1 = wp.min(c0, column), wp.max(c1, column + 1)
                r0, r1 = wp.min(r0, row), wp.max(r1, row + 1)
                parent[env, cell] = cell
                if column > window[0]:
                    if parent[env, cell - 1] >= 0:
                        join(parent, env, cell, cell - 1)
                if row > window[2]:
                    for k in range(3):
                        other = column + k - 1
                        if other >= window[0] and other < window[1]:
                            if parent[env, cell - columns + k - 1] >= 0:
                                join(parent, env, cell, cell - columns + k - 1)
    for k in range(room):
        contacts[env, k].active = 0
        moments[env, k] = Moments()
    if c1 == 0:
        box[env] = wp.vec4i(0, 0, 0, 0)
        return
    box[env] = wp.vec4i(c0, c1, r0, r1)
    # Roots come before the other cells of their pieces; each is replaced by minus its number less 2.
    count = wp.int32(0)
    for row in range(r0, r1):
        for column in range(c0, c1):
            cell = row * columns + column
            if parent[env, cell] < 0:
                continue
            root, number = root_below(parent, env, cell), wp.int32(0)
            if root == cell:
                number = count
                count += 1
                parent[env, cell] = -2 - number
            else:
                number = -2 - parent[env, root]
            if number < room:
                w = wp.max(wp.float64(depth[env, row, column]), _LEAST_DEPTH)
                x, y = pad.first[0] + wp.float64(column) * pad.pitch[0], pad.first[1] + wp.float64(row) * pad.pitch[1]
                i, j = wp.float64(column - c0) + wp.float64(0.5), wp.float64(row - r0)
                m = moments[env, number]
                m.weight = m.weight + w
                m.at = m.at + w * wp.vec2d(x, y)
                m.count = m.count + _1
                m.first = m.first + wp.vec2d(i, j)
                m.second = m.second + wp.vec3d(i * i, i * j, j * j)
                moments[env, number] = m
    wp.atomic_max(most, 0, count)
    for k in range(wp.min(count, room)):
        contacts[env, k] = contact_of(moments[env, k], pad)


@wp.func
def root_below(parent: wp.array2d(dtype=wp.int32), env: wp.int32, cell: wp.int32) -> wp.int32:
    """The root of a cell, which has a number already unless it is the cell itself."""
    at = wp.int32(cell)
    up = parent[env, at] + 0
    while up >= 0 and up != at:
        at = wp.int32(up)
        up = parent[env, at] + 0
    return at


@wp.kernel
def choose_object(
    poses: wp.array3d(dtype=wp.mat44d),
    pad: wp.int32,
    depths: wp.array2d(dtype=wp.float64),
    sound: wp.array(dtype=wp.bool),
    shear: Shear,
    # state
    pressed_before: wp.array(dtype=wp.int32),
    # outputs
    pose: wp.array(dtype=wp.mat44d),
    centre: wp.array(dtype=wp.vec3d),
    stretch: wp.array(dtype=wp.vec3d),
):
    """Pose of each pad's object and shear of the gel under it, for ``follow``; else NaN and 0.

    ``poses`` (B, pads, bodies + pads): ``pad_from_body``; ``depths`` (B, bodies): overlap of each with the pad, of which the deepest is
    the object.
    """
    env = wp.tid()
    pressed, deepest = wp.int32(-1), wp.float64(0.0)
    for body in range(depths.shape[1]):
        depth = depths[env, body] + _0
        if sound[env] and depth > deepest:
            pressed, deepest = wp.int32(body), wp.float64(depth)
    last = pressed_before[env] + 0
    pose[env] = poses[env, pad, 0] * _NAN
    centre[env] = wp.vec3d()
    if pressed >= 0:
        # From one body to another is no motion of either.
        if pressed == last or last < 0:
            pose[env] = poses[env, pad, pressed]
        if shear.load[env, pad, pressed][0] > _0:
            centre[env] = shear.centre[env, pad, pressed]
            stretch[env] = shear.mean[env, pad, pressed]
    pressed_before[env] = wp.where(sound[env], pressed, last)


@wp.kernel
def follow(
    envs: wp.array(dtype=wp.int32),
    poses: wp.array(dtype=wp.mat44d),
    centres: wp.array(dtype=wp.vec3d),
    stretches: wp.array(dtype=wp.vec3d),
    pad: Pad,
    contacts: wp.array2d(dtype=Contact),
    # state
    before: wp.array2d(dtype=Contact),
    pose_before: wp.array(dtype=wp.mat44d),
    # outputs
    table: wp.array3d(dtype=wp.float64),
):
    """Add the object's motion to contacts that go on, or take the physics' shear.

    ``envs``: of each row; ``poses``: ``pad_from_object`` of each, NaN where it is not known; ``stretches``: displacement along x and y
    and rotation of the gel at the ``centres``, which are 0 or NaN where it is not known. ``before``, ``pose_before``: of every
    environment.
    """
    row = wp.tid()
    env, room, pose = envs[row] + 0, contacts.shape[1], poses[row]
    old = pose_before[env]
    d, x, y, angle = wp.identity(n=3, dtype=wp.float64), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    if is_finite(pose) and is_finite(old):
        d = turn_of(pose) * wp.transpose(turn_of(old))
        x = pose[0, 3] - d[0, 0] * old[0, 3] - d[0, 1] * old[1, 3] - d[0, 2] * old[2, 3]
        y = pose[1, 3] - d[1, 0] * old[0, 3] - d[1, 1] * old[1, 3] - d[1, 2] * old[2, 3]
        angle = wp.atan2(d[1, 0] - d[0, 1], d[0, 0] + d[1, 1])
    for k in range(room):
        now = contacts[row, k]
        if now.active == 1:
            nearest, chosen, least = wp.int32(-1), wp.vec2d(), wp.float64(1e30)
            for n in range(room):
                was = before[env, n]
                if was.active == 1:
                    place = wp.vec2d(
                        d[0, 0] * was.place[0] + d[0, 1] * was.place[1] + d[0, 2] * was.place[2] + x,
                        d[1, 0] * was.place[0] + d[1, 1] * was.place[1] + d[1, 2] * was.place[2] + y,
                    )
                    distance = wp.length(wp.vec2d(now.place[0], now.place[1]) - place)
                    if distance < least:
                        nearest, chosen, least = wp.int32(n), place, distance + _0
            if nearest >= 0:
                was = before[env, nearest]
                if least <= wp.max(now.radius, was.radius) + pad.reach:
                    now.shear = was.shear + chosen - wp.vec2d(was.place[0], was.place[1])
                    now.twist = was.twist + angle
                    if pad.slip >= _0:
                        now = slipped(now, pad.slip)
            contacts[row, k] = now
    if pad.follows_shear == 1:
        set_shear(row, centres[row], stretches[row], pad, contacts)
    for k in range(room):
        now = contacts[row, k]
        before[env, k] = now
        for n in range(table.shape[2]):
            table[row, k, n] = _0
        if now.active == 1:
            table[row, k, 0] = _1
            table[row, k, 1] = now.place[0]
            table[row, k, 2] = now.place[1]
            table[row, k, 3] = now.shear[0]
            table[row, k, 4] = now.shear[1]
            table[row, k, 5] = now.twist
            for n in range(3):
                table[row, k, 6 + n] = now.ellipse[n]
            table[row, k, 9] = now.depth
            table[row, k, 10] = now.radius
            table[row, k, 11] = now.place[2]
    pose_before[env] = pose


@wp.func
def set_shear(row: wp.int32, centre: wp.vec3d, stretch: wp.vec3d, pad: Pad, contacts: wp.array2d(dtype=Contact)):
    """Give the physics' shear to the contact at its place."""
    total = centre[0] + centre[1] + centre[2] + stretch[0] + stretch[1] + stretch[2]
    if not wp.isfinite(total) or (centre[0] == _0 and centre[1] == _0 and centre[2] == _0):
        return
    nearest, least = wp.int32(-1), wp.float64(1e30)
    for k in range(contacts.shape[1]):
        if contacts[row, k].active == 1:
            place = contacts[row, k].place
            distance = wp.length(wp.vec2d(place[0], place[1]) - wp.vec2d(centre[0], centre[1]))
            if distance < least:
                nearest, least = wp.int32(k), distance + _0
    if nearest >= 0:
        one = contacts[row, nearest]
        if least <= one.radius + pad.reach:
            one.shear = wp.vec2d(stretch[0], stretch[1])
            one.twist = stretch[2] + _0
            contacts[row, nearest] = one


@wp.kernel
def forget(
    mask: wp.array(dtype=wp.bool),
    # outputs
    before: wp.array2d(dtype=Contact),
    pose_before: wp.array(dtype=wp.mat44d),
):
    """Drop the history of the environments of a mask (B,)."""
    env = wp.tid()
    if mask[env]:
        pose_before[env] = pose_before[env] * _NAN
        for k in range(before.shape[1]):
            before[env, k].active = 0


@wp.kernel
def forget_object(mask: wp.array(dtype=wp.bool), pressed_before: wp.array(dtype=wp.int32)):
    """Drop which body was the object in the environments of a mask (B,)."""
    env = wp.tid()
    if mask[env]:
        pressed_before[env] = -1
