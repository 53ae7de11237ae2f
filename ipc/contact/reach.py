"""Candidates out of reach: what the motion that was checked last cannot bring near.

A list of candidates is valid for a while, so most of its pairs are several d̂ apart, and computing the distance of each whenever contacts,
energies or limits of a step are wanted is most of their time. The distance g of every candidate is therefore measured at reference
positions. While no vertex is farther than m from its place there, the distance of the pair is at least g − 2m, which is a number to
compare with. That is the skin of Verlet's neighbour lists (Verlet 1967, Phys. Rev. 159) around pairs instead of vertices. Positions are
measured anew once m exceeds ``DRIFT`` of d̂. Pairs that are more than ``AWAY`` d̂ apart even then are not: their number becomes
g − 2m, which is no longer their distance but not above it. Results are the same: only pairs are left out that would add nothing.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportCallIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, VecArray2d
from ipc.broad_phase.lists import Candidates, Surface, gap_bounds, pair_at, pair_vertices, pairs_of
from ipc.contact.distance import pair_coefficients, separation
from ipc.reduce import MAX, Reducer

wp.set_module_options({"enable_backward": False})

DRIFT = 0.5
"""Displacement of a vertex over d̂ from which distances are measured anew."""
AWAY = wp.constant(wp.float64(5.0))
"""Distance over d̂ down to which a lower bound stands for a candidate's distance.

Until there is a new list.
"""
NEAR = 2.5
"""Distance over d̂ of the candidates that are listed on a CPU.

The others are not even looked at while vertices have moved little.
"""


@wp.kernel
def find_drift(x: VecArray2d, dx: VecArray2d, reference: VecArray2d, active: IntArray, size: FloatArray2d, moved: FloatArray):
    """Largest distance of each vertex from its reference between x and x + dx [m].

    Clears ``moved``.
    """
    env, v = wp.tid()
    if active[env] == 0:
        return
    if v == 0:
        moved[env] = wp.float64(0.0)
    u = x[env, v] - reference[env, v]
    size[env, v] = wp.max(wp.length(u), wp.length(u + dx[env, v]))


@wp.kernel
def choose_far(moved: FloatArray, limit: wp.float64, stale: IntArray, active: IntArray, far: IntArray, any_far: IntArray):
    """Mark environments with new lists, or with a vertex farther away than ``limit`` [m]."""
    env = wp.tid()
    far[env] = 0
    if active[env] != 0 and (stale[env] != 0 or not (moved[env] <= limit)):
        far[env] = 1
        any_far[0] = 1


@wp.kernel
def set_reference(x: VecArray2d, dx: VecArray2d, far: IntArray, reference: VecArray2d, size: FloatArray2d, moved: FloatArray):
    """x becomes the reference."""
    env, v = wp.tid()
    if far[env] == 0:
        return
    if v == 0:
        moved[env] = wp.float64(0.0)
    reference[env, v] = x[env, v]
    size[env, v] = wp.length(dx[env, v])


@wp.kernel
def measure_pairs(
    x: VecArray2d, surface: Surface, ee: wp.bool, far: IntArray, stale: IntArray, threads: wp.int32, candidates: Candidates
):
    """Distances of the candidates at x, or what ``moved`` leaves of the last ones.

    By (environment, thread).
    """
    env, first = wp.tid()
    if far[env] == 0:
        return
    known = stale[env] == 0
    for i in range(first, pairs_of(candidates, ee, env), threads):
        least, _most = gap_bounds(candidates, ee, env, i)
        gap = least + wp.float64(0.0)
        if not (known and least > AWAY * surface.d_hat):
            v = pair_vertices(surface, ee, pair_at(candidates, ee, env, i))
            x0, x1, x2, x3 = x[env, v[0]], x[env, v[1]], x[env, v[2]], x[env, v[3]]
            gap = wp.length(separation(pair_coefficients(ee, x0, x1, x2, x3), x0, x1, x2, x3))
        if ee:
            candidates.ee_gap[env, i] = gap
        else:
            candidates.pt_gap[env, i] = gap


@wp.kernel
def list_near(ee: wp.bool, far: IntArray, candidates: Candidates):
    """List the near candidates in their order, one thread an environment."""
    env = wp.tid()
    if far[env] == 0:
        return
    n = wp.int32(0)
    for i in range(pairs_of(candidates, ee, env)):
        if ee:
            if candidates.ee_gap[env, i] < candidates.near:
                candidates.ee_near[env, n] = i
                n += 1
        else:
            if candidates.pt_gap[env, i] < candidates.near:
                candidates.pt_near[env, n] = i
                n += 1
    candidates.near_count[wp.where(ee, 1, 0), env] = n


class Reach:
    """Reference positions of a batch, and when they are taken.

    Args:
        verts: vertices of an environment, V.
        d_hat: [m].
        threads: most threads that share the pairs of an environment.
    """

    def __init__(self, batch: int, verts: int, d_hat: float, threads: int, device: wp.Device) -> None:
        self.batch, self.device, self._limit, self._threads = batch, device, DRIFT * d_hat, threads
        self._reference = wp.zeros((batch, verts), dtype=wp.vec3d, device=device)
        self._size = wp.zeros((batch, verts), dtype=wp.float64, device=device)
        self._far, self._any_far = (wp.zeros(n, dtype=wp.int32, device=device) for n in (batch, 1))
        self._reduce = Reducer(batch, max(1, verts), device)
        self._reduce.prepare(verts)

    def update(
        self, x: wp.array, dx: wp.array, surface: Surface, candidates: Candidates, stale: wp.array, active: wp.array
    ) -> None:
        """Let the candidates' gaps and ``moved`` hold for positions from x to x + dx (B, V).

        Args:
            stale: mask (B,) of the environments with new lists.
            active: mask (B,).
        """
        self._any_far.zero_()
        self._launch(find_drift, x.shape, [x, dx, self._reference, active], [self._size, candidates.moved])
        self._reduce(self._size, active, MAX, candidates.moved)
        inputs = [candidates.moved, self._limit, stale, active]
        self._launch(choose_far, (self.batch,), inputs, [self._far, self._any_far])
        wp.capture_if(self._any_far, on_true=self._measure, x=x, dx=dx, surface=surface, candidates=candidates, stale=stale)

    def _measure(self, x: wp.array, dx: wp.array, surface: Surface, candidates: Candidates, stale: wp.array) -> None:
        for ee, pairs in ((False, candidates.pt), (True, candidates.ee)):
            threads = min(pairs.shape[1], self._threads)
            self._launch(measure_pairs, (self.batch, threads), [x, surface, ee, self._far, stale, threads], [candidates])
            if not self.device.is_cuda:
                self._launch(list_near, (self.batch,), [ee, self._far], [candidates])
        self._launch(set_reference, x.shape, [x, dx, self._far], [self._reference, self._size, candidates.moved])
        self._reduce(self._size, self._far, MAX, candidates.moved)

    def _launch(self, kernel: object, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
