"""Response of velocities to forces on the rows of gels, about a solution of MuJoCo's.

MuJoCo's solver minimises ½ (a − a₀)ᵀ M (a − a₀) + s(J a − a*) over accelerations a. A force Δp on the gels' rows J_g, while those of
all other constraints J_o may follow, then changes the velocities of the rows by the step's end by

    Δv = W Δp,   W = Δt J_g (M + J_oᵀ H J_o)⁻¹ J_gᵀ = Y Yᵀ

with H the second derivative of s where the solution lies: 1/R of a row that is active, that of the elliptic cone where a contact slides,
else 0 (E. Todorov, Convex and analytically-invertible dynamics with contacts and constraints, ICRA 2014; MuJoCo's documentation,
"Computation"). With M + J_oᵀ H J_o = L Lᵀ the rows of Y are √Δt L⁻¹ J_gᵀ.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.world_kernels import ROWS

wp.set_module_options({"enable_backward": False, "fast_math": False})

vec6d = wp.types.vector(length=ROWS, dtype=wp.float64)
mat66d = wp.types.matrix(shape=(ROWS, ROWS), dtype=wp.float64)

ACTIVE = wp.constant(wp.int32(1))
"""State of a constraint row whose cost is quadratic, in MuJoCo's ``mjtConstraintState``."""
ON_CONE = wp.constant(wp.int32(4))
"""State of a contact's rows on the border of the cone."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.struct
class Response:
    """Matrices of n environments, each of K contacts of gels and nv degrees of freedom."""

    mass: wp.array3d(dtype=wp.float64)
    """M + J_oᵀ H J_o, then L, (n, nv, nv)."""
    rows: wp.array3d(dtype=wp.float64)
    """J_g, then Y, (n, 6 K, nv)."""
    other: wp.array3d(dtype=wp.float64)
    """Rows of one other constraint, (n, 6, nv)."""
    own: wp.array2d(dtype=mat66d)
    """W between the rows of each contact, (n, K)."""
    state: wp.array2d(dtype=wp.float64)
    """Yᵀ p, (n, nv)."""


@wp.func
def add_row(response: Response, i: wp.int32, weight: wp.float64, j: wp.int32, k: wp.int32):
    """Add ``weight`` times the outer product of rows ``j`` and ``k`` of the other constraint.

    The lower half counts.
    """
    for m in range(response.mass.shape[1]):
        value = weight * response.other[i, j, m]
        if value != _0:
            for n in range(m + 1):
                response.mass[i, m, n] = response.mass[i, m, n] + value * response.other[i, k, n]


@wp.func
def add_cone(
    response: Response, i: wp.int32, count: wp.int32, stiffness: wp.float64, cone: wp.float64, friction: vec6d, residual: vec6d
):
    """Add a contact that slides, on the border of MuJoCo's cone.

    Args:
        count: rows of the contact.
        stiffness: 1/R of its first row.
        cone: μ of the cone, ``mjContact.mu``.
        friction: μ, then the coefficient of each other row.
        residual: J a − a*.

    With U = (cone residual₀, friction_j residual_j), N = U₀ and T the length of the others, s = D/2 (N − cone T)².
    """
    square = wp.float64(0.0)
    for j in range(1, count):
        square += friction[j] * friction[j] * residual[j] * residual[j]
    along = wp.sqrt(square)
    if not along > _0:
        add_row(response, i, stiffness, 0, 0)
        return
    whole, normal = stiffness / (cone * cone * (_1 + cone * cone)), cone * residual[0]
    for j in range(count):
        for k in range(count):
            value = wp.float64(1.0)
            if j == 0 and k > 0:
                value = -cone * friction[k] * residual[k] / along
            if k == 0 and j > 0:
                value = -cone * friction[j] * residual[j] / along
            if j > 0 and k > 0:
                value = cone * normal / (along * square) * friction[j] * residual[j] * friction[k] * residual[k]
                if j == k:
                    value += cone * cone - cone * normal / along
            value *= whole * wp.where(j == 0, cone, friction[j]) * wp.where(k == 0, cone, friction[k])
            add_row(response, i, value, j, k)


@wp.func
def factorise(response: Response, i: wp.int32, count: wp.int32, step: wp.float64) -> wp.bool:
    """L of ``mass`` and Y of the first ``count`` rows, in place.

    Returns False where the mass is not positive definite.
    """
    nv = response.mass.shape[1]
    for k in range(nv):
        for m in range(k, nv):
            value = response.mass[i, m, k] + _0
            for n in range(k):
                value -= response.mass[i, m, n] * response.mass[i, k, n]
            if m == k:
                if not (value > _0 and wp.isfinite(value)):
                    return False
                response.mass[i, k, k] = wp.sqrt(value)
            else:
                response.mass[i, m, k] = value / response.mass[i, k, k]
    root = wp.sqrt(step)
    for row in range(count):
        for m in range(nv):
            value = root * response.rows[i, row, m]
            for n in range(m):
                value -= response.mass[i, m, n] * response.rows[i, row, n]
            value /= response.mass[i, m, m]
            response.rows[i, row, m] = value
    return True


@wp.func
def own_response(response: Response, i: wp.int32, first: wp.int32) -> mat66d:
    """W between the rows of the contact whose first row is ``first``."""
    result, values = mat66d(), vec6d()
    for m in range(response.rows.shape[2]):
        for j in range(ROWS):
            values[j] = response.rows[i, first + j, m]
        result += wp.outer(values, values)
    return result


@wp.func
def velocity_by(response: Response, i: wp.int32, row: wp.int32) -> wp.float64:
    """Velocity of a row by the forces on all rows."""
    result = wp.float64(0.0)
    for m in range(response.state.shape[1]):
        result += response.rows[i, row, m] * response.state[i, m]
    return result


@wp.func
def add_force(response: Response, i: wp.int32, row: wp.int32, force: wp.float64):
    """Add a force on a row to the state."""
    for m in range(response.state.shape[1]):
        response.state[i, m] = response.state[i, m] + force * response.rows[i, row, m]
