"""Crossing triangles: what a search finds against exact arithmetic and against ipctk, and that users are told."""

from __future__ import annotations

import itertools
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import trimesh

from raytac.specs import load_press
from raytac.specs import mesh_crossing as module
from raytac.specs.mesh_crossing import find_crossings

CUBE = trimesh.creation.box(extents=(10.0, 8.0, 6.0))


def together(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    vertices = np.concatenate([solid.vertices for solid in solids])
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=False)])
    return trimesh.Trimesh(vertices, faces, process=False)


SCENE = '[object]\nkind = "mesh"\npath = "own.stl"\nscale_m_per_unit = 0.001\n\n[[trajectory]]\nkind = "indent"\ndepth_mm = 0.3\n'


def triple(a, b, c):
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])


def exactly_crosses(s, t, shared) -> bool:
    """Whether an edge of triangle s that has no corner in ``shared`` passes through t, in rational arithmetic; none lies in its plane."""

    def minus(a, b):
        return [x - y for x, y in zip(a, b, strict=True)]

    s, t = ([[Fraction(float(x)) for x in p] for p in corners] for corners in (s, t))
    for k in range(3):
        p, q = s[k], s[(k + 1) % 3]
        if k in shared or (k + 1) % 3 in shared:
            continue
        sides = [triple(minus(e, t[0]), minus(t[1], t[0]), minus(t[2], t[0])) for e in (p, q)]
        around = [triple(minus(q, p), minus(t[j], p), minus(t[(j + 1) % 3], p)) for j in range(3)]
        if sides[0] * sides[1] <= 0 and (min(around) >= 0 or max(around) <= 0):
            return True
    return False


@pytest.mark.parametrize("flatness", [1.0, 1e-6, 1e-9])
def test_pairs_are_those_of_exact_arithmetic(flatness: float) -> None:
    """Thirty triangles over twenty corners, also such as lie within 1e-9 of one plane."""
    rng = np.random.default_rng(7)
    vertices = rng.normal(size=(20, 3)) * [1.0, 1.0, flatness]
    faces = np.array([rng.choice(20, 3, replace=False) for _ in range(30)])
    expected = set()
    for a, b in itertools.combinations(range(30), 2):
        for one, other in ((a, b), (b, a)):
            shared = [k for k in range(3) if faces[one, k] in faces[other]]
            if exactly_crosses(vertices[faces[one]], vertices[faces[other]], shared):
                expected.add((a, b))
    found = find_crossings(vertices, faces)
    assert found.is_complete and len(expected) > 20
    assert {tuple(pair) for pair in found.pairs.tolist()} == expected


@pytest.mark.parametrize("count", [1, 2, 3, 200])
def test_one_pair_in_a_sound_surface_is_found(count: int) -> None:
    """``count`` separate cubes and a sliver through the last: one edge through two of its faces' triangles."""
    cubes = [CUBE.copy().apply_translation([12.0 * k, 0.0, 0.0]) for k in range(count)]
    sound = together(*cubes)
    assert not find_crossings(sound.vertices, sound.faces)
    x = 12.0 * (count - 1) + 1.0
    needle = trimesh.Trimesh([[x, 0.7, -20.0], [x + 0.1, 0.7, 20.0], [x, 0.8, 20.0]], [[0, 1, 2]], process=False)
    both = together(sound, needle)
    found = find_crossings(both.vertices, both.faces)
    assert {int(pair[1]) for pair in found.pairs} == {12 * count} and len(found.pairs) >= 2
    assert find_crossings(both.vertices + 1e3, both.faces).pairs.tolist() == found.pairs.tolist()


def test_triangles_in_one_plane_cross_if_they_overlap() -> None:
    """Boxes that stand face on face, shifted and not, overlap there; boxes side by side with a gap, and a face in two halves, do not."""
    for shift, crosses in (
        ([0.0, 0.0, 6.0], True),
        ([1.0, 2.0, 6.0], True),
        ([0.0, 0.0, 6.0 + 1e-9], False),
        ([0.0, 8.5, 0.0], False),
    ):
        pair = together(CUBE, CUBE.copy().apply_translation(shift))
        assert bool(find_crossings(pair.vertices, pair.faces)) is crosses, shift
    fan = np.array([[0.0, 0.0, 0.0], *([np.cos(k), np.sin(k), 0.3 * np.cos(k)] for k in range(6))])
    assert not find_crossings(fan, np.array([[0, k, k + 1] for k in range(1, 6)]))
    folded = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.4, 0.8, 0.0]])
    assert len(find_crossings(folded, np.array([[0, 1, 2], [0, 3, 1]])).pairs) == 1


def test_the_search_ends_early_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    star = np.concatenate([np.random.default_rng(0).normal(size=(200, 3, 3))])
    vertices, faces = star.reshape(-1, 3), np.arange(600).reshape(-1, 3)
    monkeypatch.setattr(module, "_CHUNK", 64)
    whole = find_crossings(vertices, faces)
    monkeypatch.setattr(module, "_MOST_PAIRS", 10)
    some = find_crossings(vertices, faces)
    assert whole.is_complete and not some.is_complete and 10 < len(some.pairs) < len(whole.pairs)
    assert some.text(1.0, "m").startswith("at least")
    monkeypatch.setattr(module, "_MOST_TESTS", -1)
    monkeypatch.setattr(module, "_meet", lambda corners, faces, pairs: np.zeros(len(pairs), bool))
    assert find_crossings(vertices, faces) and "do not tell" in find_crossings(vertices, faces).text(1.0, "m")


def test_a_user_is_told_how_many_triangles_of_a_mesh_cross_and_where(tmp_path: Path) -> None:
    together(CUBE, CUBE.copy().apply_translation([3.0, 2.0, 1.0])).export(tmp_path / "own.stl")
    (tmp_path / "own.toml").write_text(SCENE)
    with pytest.warns(UserWarning, match=r"own\.stl: \d+ pairs of triangles cross or overlap, the first near \(.*\) mm"):
        load_press(tmp_path / "own.toml")
    CUBE.export(tmp_path / "own.stl")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_press(tmp_path / "own.toml")


def test_a_large_mesh_shows_its_progress_and_a_small_one_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    counts: list[list[int]] = []

    class Counted(module.Progress):
        def __init__(self, *args: object, **options: object) -> None:
            super().__init__(*args, **options)  # type: ignore[arg-type]
            counts.append([self.total, int(not self.disable)])

        def close(self) -> None:
            counts[-1].append(self.n)
            super().close()

    monkeypatch.setattr(module, "Progress", Counted)
    monkeypatch.setattr(module, "_CHUNK", 1 << 10)
    assert not find_crossings(ball.vertices, ball.faces)
    assert counts.pop()[:2] == [1280, 0]
    monkeypatch.setattr(module, "_LARGE", 1280)
    assert not find_crossings(ball.vertices, ball.faces)
    total, shown, done = counts[-1][:3]
    assert (total, shown) == (1280, 1) and done >= 1279  # shares of chunks add up, to rounding
