"""Broad phase: lists and hierarchies find the same pairs, all that come within d̂ on the path, and steps are the same with either."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.bodies import Layout, build_layout
from ipc.broad_phase.trees import TINY, corner_down, corner_up, trees_pay
from ipc.contact import Collision
from ipc.errors import IpcError
from tests.ipc.conftest import bonded_pad, small_pad, unit_cell

D_HAT = 0.02
CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")])
Pairs = set[tuple[int, int, int]]


def bodies() -> list[ipc.Body]:
    """Soft bodies with and without self-contact, affine and kinematic ones, and a half-space, which has no surface."""
    rubber = ipc.Material(1e5)
    return [
        ipc.KinematicBody("tool", ipc.icosphere(0.5, 1)),
        ipc.SoftBody("folded", unit_cell(3), rubber, self_contact=True),
        ipc.HalfSpace("floor"),
        ipc.AffineBody("ball", ipc.icosphere(0.3, 1)),
        ipc.SoftBody("plain", unit_cell(2), rubber),
        ipc.KinematicBody("triangle", ipc.TriMesh(np.eye(3), np.array([[0, 1, 2]]))),
        ipc.SoftBody("second fold", unit_cell(1), rubber, self_contact=True),
    ]


@pytest.fixture(scope="module")
def layout() -> Layout:
    return build_layout(bodies(), 0.0, {}, [("tool", "ball"), ("folded", "plain")])


def look(collision: Collision, x: np.ndarray, dx: np.ndarray, active: np.ndarray | None = None) -> list[tuple[Pairs, Pairs]]:
    """Point-triangle and edge-edge pairs of each environment, with room for all of them."""
    device, batch = collision.device, len(x)
    mask = np.ones(batch, np.int32) if active is None else active.astype(np.int32)
    here, search = (wp.array(a, dtype=wp.vec3d, device=device) for a in (x, dx))
    for _ in range(2):
        collision.refresh(here, search, wp.array(mask, dtype=wp.int32, device=device))
        if collision.overflow.numpy()[0]:
            collision.grow()
    pairs_seen = []
    for env in range(batch):
        kinds = []
        for items, counts in (
            (collision.candidates.pt, collision.candidates.pt_count),
            (collision.candidates.ee, collision.candidates.ee_count),
        ):
            count = int(counts.numpy()[env])
            listed = [(int(a), int(b), int(c)) for a, b, c in items.numpy()[env, :count]]
            assert len(set(listed)) == len(listed) == count  # no pair twice
            kinds.append(set(listed))
        pairs_seen.append((kinds[0], kinds[1]))
    return pairs_seen


def make(layout: Layout, batch: int, search: str, device: str = "cpu", deterministic: bool = False) -> Collision:
    return Collision(layout, batch, D_HAT, D_HAT, deterministic, wp.get_device(device), search)


def soup(layout: Layout, rng: np.random.Generator, batch: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions at random, so that primitives are long and cross everything, and a motion [m] (B, V, 3) each."""
    shape = (batch, len(layout.vert_body), 3)
    return rng.uniform(-size, size, shape), rng.normal(0.0, 0.02 * size, shape)


def scattered(layout: Layout, rng: np.random.Generator, batch: int) -> tuple[np.ndarray, np.ndarray]:
    """Bodies in shape, crumpled a little, each turned and put somewhere near the others."""
    x, dx = soup(layout, rng, batch, 0.02)
    for env in range(batch):
        for body in range(len(layout.names)):
            own = slice(layout.vert_start[body], layout.vert_start[body + 1])
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            x[env, own] += layout.vert_local[own] @ turn + rng.uniform(-0.6, 0.6, 3)
    return x, dx


def near_pairs(layout: Layout, low: np.ndarray, high: np.ndarray) -> tuple[Pairs, Pairs]:
    """Primitives that may touch and whose boxes are within d̂ along every axis: all of them against all, in NumPy."""
    pair_of = np.full((len(layout.names),) * 2, -1)
    for index, (a, b) in enumerate(layout.pairs):
        if not layout.half_space[b]:
            pair_of[a, b] = pair_of[b, a] = index
    body, faces, edges = layout.vert_body, layout.faces, layout.edges

    def near(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        gap = np.maximum(a[0][:, None] - b[1][None], b[0][None] - a[1][:, None])
        return np.all(gap <= D_HAT, axis=-1)

    face_box = low[faces].min(axis=1), high[faces].max(axis=1)
    edge_box = low[edges].min(axis=1), high[edges].max(axis=1)
    vert = np.arange(len(low))
    hit = near((low, high), face_box) & (vert[:, None, None] != faces[None]).all(axis=-1)
    v, f = np.nonzero(hit & (pair_of[body][:, body[faces[:, 0]]] >= 0))
    pt = {(int(i), int(j), int(pair_of[body[i], body[faces[j, 0]]])) for i, j in zip(v, f, strict=True)}
    apart = (edges[:, None, :, None] != edges[None, :, None, :]).all(axis=(-1, -2))
    own = body[edges[:, 0]]
    hit = near(edge_box, edge_box) & apart & (pair_of[own][:, own] >= 0)
    a, b = np.nonzero(np.triu(hit, 1))  # bodies come in the order of their edges, and body pairs name the lower one first
    ee = {(int(i), int(j), int(pair_of[own[i], own[j]])) for i, j in zip(a, b, strict=True)}
    return pt, ee


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("kind", ["soup", "scattered"])
def test_lists_and_hierarchies_find_the_same_pairs(layout: Layout, rng: np.random.Generator, kind: str, device: str) -> None:
    batch = 5
    x, dx = soup(layout, rng, batch, 0.7) if kind == "soup" else scattered(layout, rng, batch)
    by_lists, by_trees = (look(make(layout, batch, search, device), x, dx) for search in ("lists", "bvh"))
    assert by_lists == by_trees
    lower, upper = np.minimum(x, x + dx) - D_HAT, np.maximum(x, x + dx) + D_HAT  # the boxes' margin is d̂ too
    for env in range(batch):
        expected = near_pairs(layout, lower[env], upper[env])
        assert by_trees[env] == expected
        assert min(map(len, expected)) > 100
    pairs_seen = {pair for pt, ee in by_trees for pair in (*{p for _, _, p in pt}, *{p for _, _, p in ee})}
    meshes = {i for i, (_, b) in enumerate(layout.pairs) if not layout.half_space[b]}
    assert pairs_seen == meshes  # every pair of bodies that may touch, selves among them


def to_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of points from segments; (n, 3) each."""
    search = b - a
    share = np.clip(((p - a) * search).sum(axis=1) / (search * search).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(p - a - share[:, None] * search, axis=1)


def point_triangle(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Least of the distances from three sides and, above the inside, from the plane."""
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = np.ones(len(p), bool)
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(v - u, p - u) * normal).sum(axis=1) > 0
    plane = np.where(inside, np.abs(((p - a) * normal).sum(axis=1)), np.inf)
    return np.min([plane, to_segment(p, a, b), to_segment(p, b, c), to_segment(p, c, a)], axis=0)


def edge_edge(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Least of the distances of four ends and, where both feet of the common normal lie inside, of the lines."""
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    size = np.maximum((normal * normal).sum(axis=1), 1e-300)
    s, t = ((np.cross(w, other) * normal).sum(axis=1) / size for other in (v, u))
    inside = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    lines = np.where(inside, np.abs((w * normal).sum(axis=1)) / np.sqrt(size), np.inf)
    return np.min([lines, to_segment(a, c, d), to_segment(b, c, d), to_segment(c, a, b), to_segment(d, a, b)], axis=0)


@pytest.mark.parametrize("search", ["lists", "bvh"])
def test_nothing_within_d_hat_is_missed_anywhere_on_the_way(layout: Layout, rng: np.random.Generator, search: str) -> None:
    """Distances of everything from everything that it may touch, at five moments of a motion."""
    x, dx = scattered(layout, rng, 1)
    pairs_seen = look(make(layout, 1, search), x, dx)[0]
    everything = near_pairs(layout, np.full_like(x[0], -10.0), np.full_like(x[0], 10.0))
    for kind, first, second, distance in (
        (0, np.arange(len(x[0]))[:, None], layout.faces, point_triangle),
        (1, layout.edges, layout.edges, edge_edge),
    ):
        listed = np.array(sorted(everything[kind]))
        close: Pairs = set()
        for moment in np.linspace(0.0, 1.0, 5):
            now = x[0] + moment * dx[0]
            corners = [now[verts] for verts in (*first[listed[:, 0]].T, *second[listed[:, 1]].T)]
            close |= {(int(a), int(b), int(pair)) for a, b, pair in listed[distance(*corners) < D_HAT]}
        assert close <= pairs_seen[kind]
        assert 20 < len(close) < len(pairs_seen[kind])


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_only_stale_environments_are_searched_anew(layout: Layout, rng: np.random.Generator, device: str) -> None:
    batch = 4
    x, dx = scattered(layout, rng, batch)
    moved, _ = scattered(layout, rng, batch)
    collision = make(layout, batch, "bvh", device)
    first = look(collision, x, dx)
    active = np.array([True, False, True, False])
    both = np.where(active[:, None, None], moved, x)
    second = look(collision, both, dx, active)
    expected = look(make(layout, batch, "lists", device), both, dx)
    assert [second[e] for e in (0, 2)] == [expected[e] for e in (0, 2)]
    assert [second[e] for e in (1, 3)] == [first[e] for e in (1, 3)]
    assert second[0] != first[0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300, -1e60])
def test_a_vertex_that_is_nowhere_hides_no_other_pair(layout: Layout, rng: np.random.Generator, bad: float) -> None:
    x, dx = scattered(layout, rng, 2)
    for verts in ((0, 1), (45,)):
        x[0, verts, 1] = bad
    dx[0] = 0.0
    by_lists, by_trees = (look(make(layout, 2, search), x, dx) for search in ("lists", "bvh"))
    assert by_lists == by_trees and len(by_trees[0][1]) > 100


@pytest.mark.parametrize("exponent", [-30, -12, -3, 0, 3, 12])
def test_pairs_agree_to_the_last_bit_of_where_boxes_touch(exponent: int) -> None:
    """Triangles at d̂ from each other, give or take a unit in the last place: what counts is the test in double precision."""
    base = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    tile = ipc.TriMesh(base, np.array([[0, 1, 2]]))
    spread = ipc.SoftBody("soft", unit_cell(1), ipc.Material(1e5))
    layout = build_layout([ipc.KinematicBody("tile", tile), spread], 0.0, {}, [])
    offset, batch = 10.0**exponent, 41
    x = np.zeros((batch, len(layout.vert_body), 3))
    x[:, :3] = base
    x[:, 3:] = base[np.arange(len(layout.vert_body) - 3) % 3]
    height = np.full(batch, offset + 3 * D_HAT)  # two margins and d̂
    for k in range(batch):
        for _ in range(abs(k - batch // 2)):
            height[k] = np.nextafter(height[k], np.inf if k > batch // 2 else -np.inf)
    x[:, :3, 2] = offset
    x[:, 3:, 2] = height[:, None]
    by_lists, by_trees = (look(make(layout, batch, search), x, np.zeros_like(x)) for search in ("lists", "bvh"))
    assert by_lists == by_trees
    assert len({len(pt) > 0 for pt, _ in by_lists}) == 2  # the last places of the height decide it


def test_boxes_are_rounded_outward(rng: np.random.Generator) -> None:
    values = rng.normal(size=(4000, 3)) * 10.0 ** rng.uniform(-42, 39, (4000, 3))
    values[:5] = [
        [0.0, -0.0, 1e-300],
        [1.0, -1.0, 2.0**-126],
        [3.5e38, -3.5e38, 1e300],
        [np.inf, -np.inf, -1e300],
        [0.1, 0.2, 0.3],
    ]
    values[-1] = np.nan

    @wp.kernel
    def both(v: wp.array(dtype=wp.vec3d), low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3)):  # type: ignore[valid-type]
        i = wp.tid()
        low[i] = corner_down(v[i])
        high[i] = corner_up(v[i])

    low, high = (wp.zeros(len(values), dtype=wp.vec3, device="cpu") for _ in range(2))
    wp.launch(both, dim=len(values), inputs=[wp.array(values, dtype=wp.vec3d, device="cpu"), low, high], device="cpu")
    lower, upper = low.numpy(), high.numpy()
    assert (lower[-1] < -9e36).all() and (upper[-1] > 9e36).all()  # a corner that is nowhere may be anywhere
    values, lower, upper = values[:-1], lower[:-1], upper[:-1]
    kept = np.clip(values, -1e37, 1e37)  # rounding is monotone beyond, which is all that comparing needs
    near = kept.astype(np.float32)
    assert (np.nextafter(lower, np.float32(np.inf)) <= near).all() and (np.nextafter(upper, np.float32(-np.inf)) >= near).all()
    assert (lower.astype(float) < kept).all() and (upper.astype(float) > kept).all()
    size = np.abs(kept)
    assert (upper.astype(float) - lower <= 1e-6 * size + 3 * float(TINY)).all()


def twisted_mat(search: str, device: str = "cpu", num_envs: int = 1) -> ipc.World:
    """A thin strip that is wound up at one end, beside a pad and a ball that is pressed in."""
    strip = ipc.box_mesh(np.linspace(0, 12e-3, 13), np.linspace(-1e-3, 1e-3, 3), np.linspace(-0.2e-3, 0.2e-3, 2))
    base, end = (ipc.vertices_in_box(strip, (x - 1e-6, -1, -1), (x + 1e-6, 1, 1)) for x in (0.0, 12e-3))
    soft = ipc.SoftBody("strip", strip, ipc.Material(1e5, 0.4), bonded=base, grips={"end": end}, self_contact=True)
    ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((20e-3, 0, 4e-3 + 1.2e-4)))
    pad = bonded_pad(small_pad((4, 4, 2)), pose=ipc.Pose((20e-3, 0, 0)))
    settings = ipc.Settings(d_hat=1e-4, velocity_tolerance=1e-6, linear_tolerance=1e-6, friction=0.3, broad_phase=search)  # type: ignore[arg-type]
    return ipc.World([soft, ball, pad], settings, num_envs=num_envs, device=device)


def wind(world: ipc.World, steps: int) -> np.ndarray:
    """Turn the strip's end by 0.4 rad a step while the ball goes down; positions of everything at the end."""
    for k in range(1, steps + 1):
        half = 0.2 * k
        world.set_target("strip.end", rotation=(np.cos(half), np.sin(half), 0.0, 0.0))
        world.set_target("ball", position=(20e-3, 0, 4e-3 + 1.2e-4 - 0.05e-3 * k))
        report = world.step()
        assert report.converged.all() and report.min_gap.min() > 0
    return np.concatenate([world.positions(name) for name in ("strip", "pad")], axis=1)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_steps_are_the_same_with_lists_and_hierarchies(device: str) -> None:
    """On CUDA the hierarchies are refitted inside the recorded step; the buffers grow meanwhile."""
    results, pairs = [], []
    for search in ("lists", "bvh"):
        world = twisted_mat(search, device, num_envs=2)
        world._potential.collision._size_candidates(16, 16)
        results.append(wind(world, 6))
        pairs.append(len(world.contacts().force))
    assert pairs[0] == pairs[1] > 0
    difference = np.abs(results[0] - results[1]).max()
    assert difference < 1e-8, f"positions differ by {difference:.3g} m"


def test_hierarchies_keep_a_batch_equal_to_single_worlds_and_survive_a_reset() -> None:
    batch, single = twisted_mat("bvh", num_envs=2), twisted_mat("bvh")
    first, alone = wind(batch, 4), wind(single, 4)
    assert (first[1] == alone[0]).all()
    batch.reset([1])
    batch.reset([0])
    assert (wind(batch, 4) == first).all()


def test_choice_by_number_of_edges() -> None:
    def choose(*chosen: ipc.Body, cuda: bool = False) -> bool:
        layout = build_layout(chosen, 0.0, {}, [])
        return trees_pay(layout, [(i, int(a), int(b)) for i, (a, b) in enumerate(layout.pairs)], cuda)

    rubber, tool = ipc.Material(1e5), ipc.KinematicBody("tool", ipc.icosphere(0.5, 1))
    assert not choose(ipc.SoftBody("soft", unit_cell(2), rubber), tool)
    assert not choose(ipc.SoftBody("soft", unit_cell(2), rubber, self_contact=True))
    assert choose(ipc.SoftBody("soft", unit_cell(6), rubber, self_contact=True))
    few = [ipc.AffineBody(str(k), ipc.icosphere(0.5, 0)) for k in range(4)]
    assert choose(*few) and not choose(*few, cuda=True)
    assert choose(ipc.SoftBody("soft", unit_cell(12), rubber), ipc.KinematicBody("tool", ipc.icosphere(0.5, 3)))


def test_unknown_ways_are_refused() -> None:
    with pytest.raises(IpcError, match="broad_phase"):
        ipc.Settings(broad_phase="grid")  # type: ignore[arg-type]


def test_a_world_without_meshes_that_touch_needs_neither() -> None:
    box = ipc.SoftBody("box", unit_cell(1, 0.01), ipc.Material(1e5), pose=ipc.Pose((0, 0, 1e-3)))
    settings = ipc.Settings(gravity=(0, 0, -9.81), broad_phase="bvh")
    world = ipc.World([box, ipc.HalfSpace("floor")], settings, device="cpu")
    assert world._potential.collision._trees is None
    for _ in range(5):
        assert world.step().converged.all()
