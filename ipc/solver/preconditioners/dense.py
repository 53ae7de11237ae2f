"""Dense positive definite matrices, factored and solved by a block of threads each.

A = Uᵀ U is computed by panels of ``PANEL`` rows (a left-looking Cholesky factorisation), of which two share their sums over the rows above.
A thread works on columns, two at a time, and keeps these sums in registers while it runs down the rows, ``TOGETHER`` at a time: memory is
what it waits for. Threads side by side read numbers side by side, and all of them the same few of the panel. Matrices stay in global
memory: 1.4 MB for 140 contact nodes are too many for a block's own.

Matrices are (B, n, n) arrays of which an environment uses the first ``size`` rows, a multiple of ``PAIR``. On a CPU a block is a thread.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray2d, FloatArray3d
from ipc.blocks import wait_for_block

wp.set_module_options({"enable_backward": False})

PANEL = 6
"""Rows that are factored together."""
PAIR = 2 * PANEL
"""Rows that are read together."""
TOGETHER = 3
"""Rows above that are read at once."""
_WARP = 32

vec6d = wp.types.vector(length=PANEL, dtype=wp.float64)

mat62d = wp.types.matrix(shape=(PANEL, 2), dtype=wp.float64)
mat122d = wp.types.matrix(shape=(PAIR, 2), dtype=wp.float64)
mat32d = wp.types.matrix(shape=(TOGETHER, 2), dtype=wp.float64)
mat36d = wp.types.matrix(shape=(TOGETHER, PANEL), dtype=wp.float64)
mat312d = wp.types.matrix(shape=(TOGETHER, PAIR), dtype=wp.float64)
mat66d = wp.types.matrix(shape=(PANEL, PANEL), dtype=wp.float64)


@wp.func
def panel_sums(
    u: FloatArray3d, y: FloatArray3d, env: wp.int32, row: wp.int32, c: wp.int32, d: wp.int32, first: wp.int32, last: wp.int32
) -> mat62d:
    """Σ u[k, i] y[k, j] over ``first`` <= k < ``last``; rows i of a panel, columns j = c, d.

    The rows above, k, are whole panels.
    """
    sums = mat62d()
    for top in range(first, last, TOGETHER):
        v, w = mat36d(), mat32d()
        for k in range(TOGETHER):
            w[k, 0] = y[env, top + k, c]
            w[k, 1] = y[env, top + k, d]
            for i in range(PANEL):
                v[k, i] = u[env, top + k, row + i]
        for k in range(TOGETHER):
            for i in range(PANEL):
                for j in range(2):
                    sums[i, j] = sums[i, j] + v[k, i] * w[k, j]
    return sums


@wp.func
def pair_sums(
    u: FloatArray3d, y: FloatArray3d, env: wp.int32, row: wp.int32, c: wp.int32, d: wp.int32, first: wp.int32, last: wp.int32
) -> mat122d:
    """The same for rows i of two panels."""
    sums = mat122d()
    for top in range(first, last, TOGETHER):
        v, w = mat312d(), mat32d()
        for k in range(TOGETHER):
            w[k, 0] = y[env, top + k, c]
            w[k, 1] = y[env, top + k, d]
            for i in range(PAIR):
                v[k, i] = u[env, top + k, row + i]
        for k in range(TOGETHER):
            for i in range(PAIR):
                for j in range(2):
                    sums[i, j] = sums[i, j] + v[k, i] * w[k, j]
    return sums


@wp.func
def panel_of(pair: mat122d, odd: wp.int32) -> mat62d:
    """The first or, if ``odd`` is 1, the second panel of two."""
    panel = mat62d()
    for i in range(PANEL):
        for j in range(2):
            panel[i, j] = wp.where(odd == 1, pair[PANEL + i, j], pair[i, j])
    return panel


@wp.func
def factored_panel(a: FloatArray3d, env: wp.int32, row: wp.int32) -> mat66d:
    """U of a block on the diagonal, with the inverses of its own diagonal.

    One of these is 0 where a pivot is not positive.
    """
    u = mat66d()
    for i in range(PANEL):
        for j in range(i, PANEL):
            s = a[env, row + i, row + j]
            for k in range(i):
                s -= u[k, i] * u[k, j]
            if i == j:
                if s > wp.float64(0.0):
                    u[i, i] = wp.float64(1.0) / wp.sqrt(s)
            else:
                u[i, j] = s * u[i, i]
    return u


@wp.func
def substitute(u: mat66d, x: mat62d) -> mat62d:
    """U⁻ᵀ x of a block on the diagonal."""
    y = mat62d()
    for i in range(PANEL):
        a, b = x[i, 0], x[i, 1]
        for k in range(i):
            a -= u[k, i] * y[k, 0]
            b -= u[k, i] * y[k, 1]
        y[i, 0] = u[i, i] * a
        y[i, 1] = u[i, i] * b
    return y


@wp.func
def read_panel(a: FloatArray3d, env: wp.int32, row: wp.int32, c: wp.int32, d: wp.int32) -> mat62d:
    x = mat62d()
    for i in range(PANEL):
        x[i, 0] = a[env, row + i, c]
        x[i, 1] = a[env, row + i, d]
    return x


@wp.func
def write_panel(x: mat62d, a: FloatArray3d, env: wp.int32, row: wp.int32, c: wp.int32, d: wp.int32):
    for i in range(PANEL):
        a[env, row + i, c] = x[i, 0]
        a[env, row + i, d] = x[i, 1]


@wp.func
def factor(a: FloatArray3d, env: wp.int32, size: wp.int32, lane: wp.int32, lanes: wp.int32) -> wp.bool:
    """U takes the place of a, whose lower half is not read outside blocks on the diagonal.

    U has the inverses of its diagonal there. All threads get the same result: False where a pivot is not positive.
    """
    wait_for_block()
    for p in range(size / PANEL):
        row = PANEL * p
        for c in range(row + lane, size, 2 * lanes):
            d = wp.where(c + lanes < size, c + lanes, c)
            if p % 2 == 0:
                sums = pair_sums(a, a, env, row, c, d, 0, row)
                write_panel(read_panel(a, env, row, c, d) - panel_of(sums, 0), a, env, row, c, d)
                second = row + PANEL
                write_panel(read_panel(a, env, second, c, d) - panel_of(sums, 1), a, env, second, c, d)
            else:
                write_panel(read_panel(a, env, row, c, d) - panel_sums(a, a, env, row, c, d, row - PANEL, row), a, env, row, c, d)
        wait_for_block()
        u = factored_panel(a, env, row)
        for i in range(PANEL):
            if u[i, i] == wp.float64(0.0):
                return False
        wait_for_block()
        for c in range(row + PANEL + lane, size, 2 * lanes):
            d = wp.where(c + lanes < size, c + lanes, c)
            write_panel(substitute(u, read_panel(a, env, row, c, d)), a, env, row, c, d)
        if lane == 0:
            for i in range(PANEL):
                for j in range(i, PANEL):
                    a[env, row + i, row + j] = u[i, j]
        wait_for_block()
    return True


@wp.func
def factor_block(u: FloatArray3d, env: wp.int32, row: wp.int32) -> mat66d:
    block = mat66d()
    for i in range(PANEL):
        for j in range(i, PANEL):
            block[i, j] = u[env, row + i, row + j]
    return block


@wp.func
def solve(u: FloatArray3d, b: FloatArray2d, y: FloatArray2d, env: wp.int32, size: wp.int32, lane: wp.int32, lanes: wp.int32):
    """b becomes (Uᵀ U)⁻¹ b, and y U⁻ᵀ b."""
    for p in range(size / PANEL):
        row = PANEL * p
        block, x = factor_block(u, env, row), vec6d()
        for i in range(PANEL):
            total = b[env, row + i]
            for k in range(i):
                total -= block[k, i] * x[k]
            x[i] = block[i, i] * total
        for c in range(row + PANEL + lane, size, lanes):
            total = b[env, c]
            for i in range(PANEL):
                total -= u[env, row + i, c] * x[i]
            b[env, c] = total
        if lane == 0:
            for i in range(PANEL):
                y[env, row + i] = x[i]
        wait_for_block()
    for p in range(size / PANEL):
        row = size - PANEL * (p + 1)
        block, x = factor_block(u, env, row), vec6d()
        for j in range(PANEL):
            i = PANEL - 1 - j
            total = y[env, row + i]
            for k in range(i + 1, PANEL):
                total -= block[i, k] * x[k]
            x[i] = block[i, i] * total
        for r in range(lane, row, lanes):
            total = y[env, r]
            for i in range(PANEL):
                total -= u[env, r, row + i] * x[i]
            y[env, r] = total
        if lane == 0:
            for i in range(PANEL):
                b[env, row + i] = x[i]
        wait_for_block()


@wp.func
def solve_identity(u: FloatArray3d, y: FloatArray3d, env: wp.int32, size: wp.int32, lane: wp.int32, lanes: wp.int32):
    """y = U⁻ᵀ, zero above its diagonal."""
    one = wp.float64(1.0)
    for c in range(lane, size, 2 * lanes):
        d = wp.where(c + lanes < size, c + lanes, c)
        first, sums = c - c % PANEL, mat122d()
        for p in range(size / PANEL):
            row = PANEL * p
            x = mat62d()
            if row >= first:
                if p % 2 == 0:
                    sums = pair_sums(u, y, env, row, c, d, first, row)
                    x = -panel_of(sums, 0)
                else:
                    x = -panel_of(sums, 1) - panel_sums(u, y, env, row, c, d, wp.max(first, row - PANEL), row)
                for i in range(PANEL):
                    if row + i == c:
                        x[i, 0] = x[i, 0] + one
                    if row + i == d:
                        x[i, 1] = x[i, 1] + one
                x = substitute(factor_block(u, env, row), x)
            write_panel(x, y, env, row, c, d)
    wait_for_block()


@wp.func
def gram(y: FloatArray3d, out: FloatArray3d, env: wp.int32, size: wp.int32, lane: wp.int32, lanes: wp.int32):
    """out = yᵀ y of a lower triangular y.

    Warps take chunks of columns in turn.
    """
    width = wp.min(_WARP, lanes)
    groups, group = lanes / width, lane / width
    task = wp.int32(0)
    for p in range(size / PAIR):
        row = PAIR * p
        for start in range(row, size, 2 * width):
            c = start + lane % width
            if task % groups == group and c < size:
                d = wp.where(c + width < size, c + width, c)
                x = pair_sums(y, y, env, row, c, d, c - c % PANEL, size)
                for i in range(PAIR):
                    if c >= row + i:
                        out[env, row + i, c] = x[i, 0]
                        out[env, c, row + i] = x[i, 0]
                    if d >= row + i:
                        out[env, row + i, d] = x[i, 1]
                        out[env, d, row + i] = x[i, 1]
            task += 1
    wait_for_block()


@wp.func
def invert(a: FloatArray3d, y: FloatArray3d, env: wp.int32, size: wp.int32, lane: wp.int32, lanes: wp.int32) -> wp.bool:
    """A⁻¹ = U⁻¹ U⁻ᵀ takes the place of A, of which the upper half counts; y becomes U⁻ᵀ.

    All threads get the same result: False where a pivot is not positive.
    """
    if not factor(a, env, size, lane, lanes):
        return False
    solve_identity(a, y, env, size, lane, lanes)
    gram(y, a, env, size, lane, lanes)
    return True
