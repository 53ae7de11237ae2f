"""Kernels of ``FrictionCorrection``: stick and slip of the contacts of B pads on a grid.

A row of nodes is computed by one thread, and joined with the others of its pad by another, in their order.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.soft.correction.force_kernels import Unknowns
from raytac.physics.soft.correction.plane_kernels import (
    Lines,
    Moments,
    PlaneMotion,
    displaced,
    fit,
    follow,
    moments,
    node_at,
    sampled,
)

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_ZERO = wp.constant(wp.float32(0.0))


@wp.struct
class Contact:
    """State of the search for stick and slip in B pads."""

    chosen: wp.array(dtype=wp.int32)
    """1 where friction is corrected."""
    active: wp.array(dtype=wp.int32)
    """1 while an environment is searched."""
    failed: wp.array(dtype=wp.int32)
    """1 where no contact can be made of what moves."""
    rows: wp.array(dtype=wp.vec2i)
    """Window, from and to, outside which there is no traction."""
    columns: wp.array(dtype=wp.vec2i)
    goal: wp.array(dtype=PlaneMotion)
    """Mean motion of the contact to reach."""
    motion: wp.array(dtype=PlaneMotion)
    """Motion of the object that is tried."""
    mean: wp.array(dtype=PlaneMotion)
    """Mean motion that it gives."""
    friction: wp.array(dtype=wp.float64)
    least: wp.array(dtype=wp.float64)
    """Pressure below which a node is not loaded [Pa]."""
    size: wp.array(dtype=wp.float64)
    """Greatest compliance [m/Pa]."""
    t: wp.array(dtype=wp.float64)
    """t of the accelerated gradients, and the share of the step before that is added."""
    share: wp.array(dtype=wp.float32)
    count: wp.array(dtype=wp.int32)


@wp.kernel
def choose_contacts(
    touched: wp.array(dtype=wp.int32), touching: wp.array2d(dtype=wp.int32), objects: wp.array2d(dtype=wp.bool),
    friction: wp.array(dtype=wp.float64), load: wp.array2d(dtype=wp.float64), dragged: wp.array2d(dtype=wp.float64),
    rest: wp.array(dtype=wp.vec3d), can_move: wp.array(dtype=wp.int32), tolerance: wp.float64,
    # outputs
    s: Contact,
    unknowns: Unknowns,
):  # fmt: skip
    """Pads whose friction is corrected.

    Those that one rigid object touches, whose coefficient is known. ``dragged``: displacements of the vertices by friction, x and
    then y (B, 2 V) [m].
    """
    env = wp.tid()
    s.chosen[env] = 0
    s.active[env] = 0
    s.failed[env] = 0
    s.count[env] = 0
    s.rows[env] = wp.vec2i(0, 0)
    s.columns[env] = wp.vec2i(0, 0)
    unknowns.count[env] = 0
    mu, count = wp.float64(0.0), wp.int32(0)
    for k in range(objects.shape[1]):
        if objects[env, k]:
            count += 1
            mu = friction[k] + _0
    if touched[env] == 0 or count != 1 or not (mu > _0):
        return
    vertices = len(rest)
    total, free = Moments(), wp.int32(0)
    for v in range(vertices):
        if touching[env, v] != 0:
            place = wp.vec2d(rest[v][0], rest[v][1])
            total += moments(load[env, v], place, wp.vec2d(dragged[env, v], dragged[env, vertices + v]))
    if not (total[0] > _0):
        return
    goal = fit(total)
    s.goal[env] = goal
    s.motion[env] = goal
    s.friction[env] = mu
    s.chosen[env] = 1
    most = wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            d = displaced(goal, wp.vec2d(rest[v][0], rest[v][1]))
            most = wp.max(most, wp.max(wp.abs(d[0]), wp.abs(d[1])))
    for n in range(2 * vertices):
        if touching[env, n % vertices] != 0 and can_move[n] != 0:
            unknowns.index[env, free] = n
            free += 1
    unknowns.count[env] = free
    if most > tolerance:
        s.active[env] = 1


@wp.kernel
def greatest_pressure(p: wp.array3d(dtype=wp.float32), active: wp.array(dtype=wp.int32), rows: wp.array2d(dtype=wp.float32)):
    env, row = wp.tid()
    most = wp.float32(0.0)
    if active[env] != 0:
        for i in range(p.shape[2]):
            most = wp.max(most, p[env, row, i])
    rows[env, row] = most


@wp.kernel
def least_pressure(rows: wp.array2d(dtype=wp.float32), share: wp.float64, s: Contact):
    env = wp.tid()
    most = wp.float32(0.0)
    for row in range(rows.shape[1]):
        most = wp.max(most, rows[env, row])
    s.least[env] = share * wp.float64(most)


@wp.kernel
def load_nodes(
    s: Contact, fine: Lines, p: wp.array3d(dtype=wp.float32), nodes: Lines,
    # outputs
    loaded: wp.array3d(dtype=wp.int32),
    bound: wp.array3d(dtype=wp.float32),
    near: wp.array2d(dtype=wp.vec2i),
    moved: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Coulomb's limit [Pa] and the loaded nodes along a row, where the mean motion takes them."""
    env, row = wp.tid()
    if s.active[env] == 0:
        return
    from_, to, far = nodes.count[0], wp.int32(0), wp.float64(0.0)
    for i in range(nodes.count[0]):
        place = node_at(nodes, row, i)
        d = displaced(s.goal[env], place)
        pressure = sampled(p, env, fine, place + d)
        mark = wp.int32(0)
        if pressure > s.least[env]:
            mark = wp.int32(1)
            from_, to = wp.min(from_, i), wp.max(to, i + 1)
            far = wp.max(far, wp.max(wp.abs(d[0]), wp.abs(d[1])))
        loaded[env, row, i] = mark
        bound[env, row, i] = wp.float32(s.friction[env] * pressure)
    near[env, row] = wp.vec2i(from_, to)
    moved[env, row] = far


@wp.kernel
def choose_windows(near: wp.array2d(dtype=wp.vec2i), moved: wp.array2d(dtype=wp.float64), nodes: Lines, s: Contact):
    """Window around the loaded nodes, as wide as the skin around them moves."""
    env = wp.tid()
    if s.active[env] == 0:
        return
    columns, rows, far = wp.vec2i(2147483647, 0), wp.vec2i(near.shape[1], 0), wp.float64(0.0)
    for row in range(near.shape[1]):
        line = near[env, row]
        if line[1] > line[0]:
            columns = wp.vec2i(wp.min(columns[0], line[0]), wp.max(columns[1], line[1]))
            rows = wp.vec2i(wp.min(rows[0], row), row + 1)
            far = wp.max(far, moved[env, row])
    if rows[1] == 0:
        s.active[env] = 0
        s.failed[env] = 1
        return
    margin = 2 + wp.int32(wp.float64(0.3) * far / nodes.pitch[0])
    s.rows[env] = wp.vec2i(wp.max(rows[0] - margin, 0), wp.min(rows[1] + margin, nodes.count[1]))
    s.columns[env] = wp.vec2i(wp.max(columns[0] - margin, 0), wp.min(columns[1] + margin, nodes.count[0]))


@wp.func
def is_in(s: Contact, env: wp.int32, row: wp.int32):
    return s.active[env] != 0 and row >= s.rows[env][0] and row < s.rows[env][1]


@wp.kernel
def begin(
    s: Contact, bound: wp.array3d(dtype=wp.float32),
    # outputs
    tx: wp.array3d(dtype=wp.float32), ty: wp.array3d(dtype=wp.float32),
    trial_x: wp.array3d(dtype=wp.float32), trial_y: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """No traction, and a trial one on all nodes that may stick, along a row."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    for i in range(s.columns[env][0], s.columns[env][1]):
        one = wp.where(bound[env, row, i] > _ZERO, wp.float32(1.0), _ZERO)
        trial_x[env, row, i] = one
        trial_y[env, row, i] = one
        tx[env, row, i] = _ZERO
        ty[env, row, i] = _ZERO


@wp.kernel
def trial_sums(
    s: Contact, bound: wp.array3d(dtype=wp.float32), dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    trial_x: wp.array3d(dtype=wp.float32), trial_y: wp.array3d(dtype=wp.float32),
    # outputs
    sums: wp.array2d(dtype=Moments),
):  # fmt: skip
    """Squares of response and trial, and the greatest response, along a row."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    response, trial, most = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for i in range(s.columns[env][0], s.columns[env][1]):
        if bound[env, row, i] > _ZERO:
            x, y = wp.float64(dx[env, row, i]), wp.float64(dy[env, row, i])
            response += x * x + y * y
            most = wp.max(most, wp.max(wp.abs(x), wp.abs(y)))
        x, y = wp.float64(trial_x[env, row, i]), wp.float64(trial_y[env, row, i])
        trial += x * x + y * y
    sums[env, row] = Moments(response, trial, most, _0, _0, _0, _0, _0)


@wp.kernel
def trial_sizes(sums: wp.array2d(dtype=Moments), s: Contact):
    """Greatest compliance so far; an environment in which nothing can move is left out."""
    env = wp.tid()
    if s.active[env] == 0:
        return
    response, trial, most = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for row in range(s.rows[env][0], s.rows[env][1]):
        one = sums[env, row]
        response += one[0]
        trial += one[1]
        most = wp.max(most, one[2])
    if not (response > _0):
        s.active[env] = 0
        s.failed[env] = 1
        return
    s.size[env] = wp.sqrt(response / trial)
    s.t[env] = most


@wp.kernel
def next_trial(
    s: Contact, bound: wp.array3d(dtype=wp.float32), dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    # outputs
    trial_x: wp.array3d(dtype=wp.float32), trial_y: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    scale = wp.float32(s.t[env])
    for i in range(s.columns[env][0], s.columns[env][1]):
        inside = bound[env, row, i] > _ZERO
        trial_x[env, row, i] = wp.where(inside, dx[env, row, i] / scale, _ZERO)
        trial_y[env, row, i] = wp.where(inside, dy[env, row, i] / scale, _ZERO)


@wp.func
def project(x: wp.float32, y: wp.float32, bound: wp.float32) -> wp.vec2:
    """Traction shortened to ``bound`` >= 0, in its own direction."""
    size = wp.sqrt(x * x + y * y)
    share = wp.min(wp.float32(1.0), bound / wp.max(size, wp.float32(1e-12)))
    return wp.vec2(x * share, y * share)


@wp.kernel
def begin_gradients(
    s: Contact, bound: wp.array3d(dtype=wp.float32),
    # outputs
    tx: wp.array3d(dtype=wp.float32), ty: wp.array3d(dtype=wp.float32),
    yx: wp.array3d(dtype=wp.float32), yy: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Traction of before within the present limit, along a row."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    if row == s.rows[env][0]:
        s.t[env] = _1
    for i in range(s.columns[env][0], s.columns[env][1]):
        one = project(tx[env, row, i], ty[env, row, i], bound[env, row, i])
        tx[env, row, i] = one[0]
        ty[env, row, i] = one[1]
        yx[env, row, i] = one[0]
        yy[env, row, i] = one[1]


@wp.kernel
def gradient_step(
    s: Contact, nodes: Lines, bound: wp.array3d(dtype=wp.float32),
    dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    yx: wp.array3d(dtype=wp.float32), yy: wp.array3d(dtype=wp.float32),
    tx: wp.array3d(dtype=wp.float32), ty: wp.array3d(dtype=wp.float32),
    # outputs
    new_x: wp.array3d(dtype=wp.float32), new_y: wp.array3d(dtype=wp.float32),
    sums: wp.array2d(dtype=Moments),
):  # fmt: skip
    """Projected gradient step from y, and whether it turns back, along a row."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    step, total = wp.float32(_1 / (wp.float64(1.15) * s.size[env])), wp.float64(0.0)
    for i in range(s.columns[env][0], s.columns[env][1]):
        target = displaced(s.motion[env], node_at(nodes, row, i))
        ax, ay = yx[env, row, i], yy[env, row, i]
        gx = ax - step * (dx[env, row, i] - wp.float32(target[0]))
        gy = ay - step * (dy[env, row, i] - wp.float32(target[1]))
        new = project(gx, gy, bound[env, row, i])
        total += wp.float64((ax - new[0]) * (new[0] - tx[env, row, i]) + (ay - new[1]) * (new[1] - ty[env, row, i]))
        new_x[env, row, i] = new[0]
        new_y[env, row, i] = new[1]
    sums[env, row] = Moments(total, _0, _0, _0, _0, _0, _0, _0)


@wp.kernel
def accelerate(sums: wp.array2d(dtype=Moments), s: Contact):
    """Share of the last step that is added, which begins again where the steps turn back."""
    env = wp.tid()
    if s.active[env] == 0:
        return
    total, t = wp.float64(0.0), s.t[env] + _0
    for row in range(s.rows[env][0], s.rows[env][1]):
        total += sums[env, row][0]
    if total > _0:
        t = wp.float64(1.0)
    t_new = wp.float64(0.5) * (_1 + wp.sqrt(_1 + wp.float64(4.0) * t * t))
    s.share[env] = wp.float32((t - _1) / t_new)
    s.t[env] = t_new


@wp.kernel
def advance(
    s: Contact, new_x: wp.array3d(dtype=wp.float32), new_y: wp.array3d(dtype=wp.float32),
    # outputs
    tx: wp.array3d(dtype=wp.float32), ty: wp.array3d(dtype=wp.float32),
    yx: wp.array3d(dtype=wp.float32), yy: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    share = s.share[env]
    for i in range(s.columns[env][0], s.columns[env][1]):
        x, y = new_x[env, row, i], new_y[env, row, i]
        yx[env, row, i] = x + share * (x - tx[env, row, i])
        yy[env, row, i] = y + share * (y - ty[env, row, i])
        tx[env, row, i] = x
        ty[env, row, i] = y


@wp.kernel
def mean_sums(
    s: Contact, nodes: Lines, bound: wp.array3d(dtype=wp.float32),
    dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    # outputs
    sums: wp.array2d(dtype=Moments),
):  # fmt: skip
    """Moments of the displacement weighted by the limit, along a row."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    total = Moments()
    for i in range(s.columns[env][0], s.columns[env][1]):
        d = wp.vec2d(wp.float64(dx[env, row, i]), wp.float64(dy[env, row, i]))
        total += moments(wp.float64(bound[env, row, i]), node_at(nodes, row, i), d)
    sums[env, row] = total


@wp.kernel
def find_means(sums: wp.array2d(dtype=Moments), s: Contact):
    env = wp.tid()
    if s.active[env] == 0:
        return
    total = Moments()
    for row in range(s.rows[env][0], s.rows[env][1]):
        total += sums[env, row]
    s.mean[env] = fit(total)


@wp.kernel
def slip_sums(
    s: Contact, nodes: Lines, bound: wp.array3d(dtype=wp.float32),
    dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    tx: wp.array3d(dtype=wp.float32), ty: wp.array3d(dtype=wp.float32),
    # outputs
    sums: wp.array2d(dtype=Moments),
):  # fmt: skip
    """Errors and numbers of a row.

    Greatest error of the mean motion, and slip of nodes that stick; their number, that of nodes under load; goal · goal, goal · mean.
    """
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    error, slip, gg, gm = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    sticking, inside = wp.int32(0), wp.int32(0)
    for i in range(s.columns[env][0], s.columns[env][1]):
        limit = bound[env, row, i]
        if limit > _ZERO:
            place = node_at(nodes, row, i)
            goal, mean, target = displaced(s.goal[env], place), displaced(s.mean[env], place), displaced(s.motion[env], place)
            e = goal - mean
            error = wp.max(error, wp.max(wp.abs(e[0]), wp.abs(e[1])))
            inside += 1
            gg += wp.dot(goal, goal)
            gm += wp.dot(goal, mean)
            x, y = tx[env, row, i], ty[env, row, i]
            if wp.float64(wp.sqrt(x * x + y * y)) < wp.float64(0.999) * wp.float64(limit):
                sticking += 1
                d = wp.vec2d(wp.float64(dx[env, row, i]), wp.float64(dy[env, row, i])) - target
                slip = wp.max(slip, wp.length(d))
    sums[env, row] = Moments(error, slip, wp.float64(sticking), wp.float64(inside), gg, gm, _0, _0)


@wp.kernel
def judge(
    sums: wp.array2d(dtype=Moments), motion_tolerance: wp.float64, stick_tolerance: wp.float64, sliding_share: wp.float64,
    most: wp.int32,
    # outputs
    s: Contact,
):  # fmt: skip
    """End of a search that is solved; else the next motion, and friction if all slides."""
    env = wp.tid()
    if s.active[env] == 0:
        return
    total = Moments()
    for row in range(s.rows[env][0], s.rows[env][1]):
        one = sums[env, row]
        error, slip = wp.max(total[0], one[0]), wp.max(total[1], one[1])
        total += one
        total[0] = error
        total[1] = slip
    s.count[env] = s.count[env] + 1
    if s.count[env] >= most or (total[0] < motion_tolerance and total[1] < stick_tolerance):
        s.active[env] = 0
        return
    if total[2] < sliding_share * total[3]:
        s.friction[env] = s.friction[env] * wp.max(total[4] / total[5], _1)
    s.motion[env] = follow(s.motion[env], s.goal[env], s.mean[env])


@wp.kernel
def next_bounds(
    s: Contact, fine: Lines, p: wp.array3d(dtype=wp.float32), nodes: Lines, loaded: wp.array3d(dtype=wp.int32),
    dx: wp.array3d(dtype=wp.float32), dy: wp.array3d(dtype=wp.float32),
    # outputs
    bound: wp.array3d(dtype=wp.float32),
    any_: wp.array2d(dtype=wp.int32),
):  # fmt: skip
    """Coulomb's limit along a row, where the skin has moved to; 1 if any is above 0."""
    env, row = wp.tid()
    if not is_in(s, env, row):
        return
    some = wp.int32(0)
    for i in range(s.columns[env][0], s.columns[env][1]):
        limit = wp.float32(0.0)
        if loaded[env, row, i] != 0:
            d = wp.vec2d(wp.float64(dx[env, row, i]), wp.float64(dy[env, row, i]))
            limit = wp.float32(s.friction[env] * sampled(p, env, fine, node_at(nodes, row, i) + d))
        bound[env, row, i] = limit
        if limit > _ZERO:
            some = wp.int32(1)
    any_[env, row] = some


@wp.kernel
def put(value: wp.int32, flag: wp.array(dtype=wp.int32)):
    """Write one number; a recorded loop takes no copies."""
    flag[0] = value


@wp.kernel
def begin_search(s: Contact, go: wp.array(dtype=wp.int32)):
    """Search if there is an environment to search, after ``go`` was cleared."""
    if s.active[wp.tid()] != 0:
        go[0] = 1


@wp.kernel
def go_on(any_: wp.array2d(dtype=wp.int32), s: Contact, go: wp.array(dtype=wp.int32)):
    env = wp.tid()
    if s.active[env] == 0:
        return
    some = wp.int32(0)
    for row in range(s.rows[env][0], s.rows[env][1]):
        some = wp.max(some, any_[env, row])
    if some == 0:
        s.active[env] = 0
        return
    go[0] = 1


@wp.kernel
def mix(
    active: wp.array(dtype=wp.int32), along: wp.array3d(dtype=wp.float32), across: wp.array3d(dtype=wp.float32),
    both: wp.array3d(dtype=wp.float32),
    # outputs
    x: wp.array3d(dtype=wp.float32),
    y: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Amplitudes of the layer's displacement from those of the traction, in place, along a row."""
    env, row = wp.tid()
    if active[env] == 0:
        return
    for i in range(x.shape[2]):
        a, b = x[env, row, i] + _ZERO, y[env, row, i] + _ZERO  # values, not references: x is written first
        x[env, row, i] = along[0, row, i] * a + both[0, row, i] * b
        y[env, row, i] = both[0, row, i] * a + across[0, row, i] * b


@wp.kernel
def clear_unsolved(s: Contact, x: wp.array3d(dtype=wp.float32), y: wp.array3d(dtype=wp.float32)):
    """No waves where nothing was searched, along a row."""
    env, row = wp.tid()
    if s.count[env] == 0:
        for i in range(x.shape[2]):
            x[env, row, i] = _ZERO
            y[env, row, i] = _ZERO


@wp.kernel
def blend(
    s: Contact, touching: wp.array2d(dtype=wp.int32), load: wp.array2d(dtype=wp.float64), dragged: wp.array2d(dtype=wp.float64),
    layer_x: wp.array3d(dtype=wp.float32), layer_y: wp.array3d(dtype=wp.float32), response: wp.array2d(dtype=wp.float64),
    full: wp.float64, none: wp.float64, small: wp.float64,
    # outputs
    sideways: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Add the layer's response to friction in place of the mesh's, (B, 2 V).

    It is added as far as it explains the motion.
    """
    env = wp.tid()
    if s.chosen[env] == 0 or s.failed[env] != 0:
        return
    vertices, wide = touching.shape[1], layer_x.shape[2]
    error, size, weight = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for v in range(vertices):
        if touching[env, v] != 0:
            u = wp.vec2d(dragged[env, v], dragged[env, vertices + v])
            w = wp.vec2d(wp.float64(layer_x[env, v // wide, v % wide]), wp.float64(layer_y[env, v // wide, v % wide]))
            error += load[env, v] * wp.length_sq(w - u)
            size += load[env, v] * wp.length_sq(u)
            weight += load[env, v]
    missed = wp.sqrt(error / (size + weight * small * small))
    share = wp.clamp((none - missed) / (none - full), _0, _1)
    for v in range(vertices):
        x, y = wp.float64(layer_x[env, v // wide, v % wide]), wp.float64(layer_y[env, v // wide, v % wide])
        sideways[env, v] = sideways[env, v] + share * (x - response[env, v])
        sideways[env, vertices + v] = sideways[env, vertices + v] + share * (y - response[env, vertices + v])
