"""The interface that all models share: names, history, perturbations."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers import (
    MARKERS,
    ContactSettings,
    ForceField,
    Fots,
    MarkerPerturbation,
    MarkersConfig,
    MarkerTracker,
    Superposition,
)
from raytac.specs import SensorSpec
from tests.markers.pads import coat_mesh, pose, pressed, with_coat

DEEP = 6e-4


def still(sensor: SensorSpec, grid: PadGrid, batch: int = 1) -> GelSurface:
    mesh = coat_mesh(sensor)
    return with_coat(pressed(grid, *[[]] * batch), mesh, np.repeat(mesh.rest[None], batch, axis=0))


@pytest.mark.parametrize("model", MARKERS.names)
@pytest.mark.renderer
def test_every_model_is_at_rest_on_a_pad_at_rest(model: str, sensor: SensorSpec, grid: PadGrid) -> None:
    frame = MarkerTracker(sensor, model, grid, num_envs=2, device="cpu").update(still(sensor, grid, 2))
    assert frame.displacement.shape == frame.displacement_px.shape == (2, 99, 2)
    assert not frame.displacement.any() and not frame.displacement_px.any()
    np.testing.assert_array_equal(frame.position, frame.rest)
    np.testing.assert_array_equal(frame.pixel, frame.rest_px)
    assert frame.visible.all()


@pytest.mark.parametrize("model", ["fots", "superposition", "force_field"])
@pytest.mark.renderer
def test_reset_clears_history(model: str, sensor: SensorSpec, grid: PadGrid) -> None:
    tracker = MarkerTracker(sensor, model, grid, device="cpu")
    first, last = (pressed(grid, [(x, 0, DEEP)], poses=[pose(x)]) for x in (0.0, 4e-4))
    fresh = tracker.update(last).displacement
    tracker.reset()
    tracker.update(first)
    dragged = tracker.update(last).displacement
    tracker.reset([0])
    again = tracker.update(last).displacement
    np.testing.assert_array_equal(again, fresh)
    assert np.abs(dragged - fresh).max() > 1e-4


def test_unknown_model(sensor: SensorSpec, grid: PadGrid) -> None:
    with pytest.raises(InputError, match="did you mean 'fots'"):
        MarkerTracker(sensor, "fotz", grid)


def test_another_number_of_environments_or_grid(sensor: SensorSpec, grid: PadGrid) -> None:
    from raytac.gel.surface import make_grid

    tracker = MarkerTracker(sensor, "force_field", grid, num_envs=2)
    with pytest.raises(InputError, match="2 environments"):
        tracker.update(pressed(grid, []))
    with pytest.raises(InputError, match="grid"):
        tracker.update(pressed(make_grid(sensor.gelpad, 0.2e-3), [], []))


@pytest.mark.renderer
def test_a_broken_environment_is_nan_and_harms_no_other(sensor: SensorSpec, grid: PadGrid) -> None:
    surface = pressed(grid, [(0, 0, DEEP)], [(0, 0, DEEP)])
    surface.height[0] = np.nan
    for model in ("fots", "force_field", "superposition"):
        frame = MarkerTracker(sensor, model, grid, num_envs=2, device="cpu").update(surface)
        assert np.isnan(frame.displacement[0]).all() and np.isnan(frame.displacement_px[0]).all()
        assert np.isfinite(frame.displacement[1]).all() and frame.displacement[1].any()


def test_noise(sensor: SensorSpec, grid: PadGrid) -> None:
    tracker = MarkerTracker(sensor, ForceField(MarkerPerturbation(noise_px=0.5)), grid, seed=3)
    frames = [tracker.update(pressed(grid, [])) for _ in range(20)]
    noise = np.concatenate([frame.displacement_px for frame in frames])
    assert noise.std() == pytest.approx(0.5, rel=0.05) and abs(noise.mean()) < 0.05
    pitch = sensor.camera.pixel_pitch
    np.testing.assert_allclose(frames[0].displacement, frames[0].displacement_px * pitch, atol=1e-12)
    np.testing.assert_array_equal(frames[0].position, frames[0].rest)


def test_dropout(sensor: SensorSpec, grid: PadGrid) -> None:
    tracker = MarkerTracker(sensor, ForceField(MarkerPerturbation(dropout=0.1)), grid)
    frames = [tracker.update(pressed(grid, [])) for _ in range(30)]
    lost = np.concatenate([~frame.visible for frame in frames])
    assert lost.mean() == pytest.approx(0.1, abs=0.02)
    for frame in frames:
        np.testing.assert_array_equal(np.isnan(frame.displacement_px).all(axis=-1), ~frame.visible)


def test_the_pattern_is_placed_again_at_a_reset(sensor: SensorSpec, grid: PadGrid) -> None:
    shifted = MarkerPerturbation(shift=3e-4, turn=0.02)
    tracker = MarkerTracker(sensor, ForceField(shifted), grid, num_envs=2)
    first = tracker.update(pressed(grid, [], [])).rest.copy()
    assert not np.array_equal(first[0], first[1])
    same = tracker.update(pressed(grid, [], [])).rest
    np.testing.assert_array_equal(same, first)
    tracker.reset([1])
    second = tracker.update(pressed(grid, [], []))
    np.testing.assert_array_equal(second.rest[0], first[0])
    assert not np.array_equal(second.rest[1], first[1])
    assert not second.displacement.any()


def test_what_an_environment_draws_does_not_depend_on_how_many_there_are(sensor: SensorSpec, grid: PadGrid) -> None:
    everything = MarkerPerturbation(noise_px=0.3, dropout=0.05, shift=2e-4, turn=0.01)

    def run(batch: int, seed: int) -> np.ndarray:
        tracker = MarkerTracker(sensor, ForceField(everything), grid, num_envs=batch, seed=seed)
        balls = [[(0.0, 0.0, DEEP)]] * batch
        return np.stack([tracker.update(pressed(grid, *balls)).pixel for _ in range(2)], axis=1)

    np.testing.assert_array_equal(run(3, 7)[:1], run(1, 7))
    assert not np.array_equal(run(1, 7), run(1, 8), equal_nan=True)


@pytest.mark.parametrize("name", MARKERS.names)
def test_a_name_is_its_configuration_with_defaults(name: str) -> None:
    """Configurations are plain values: equal by their fields, and they survive pickling."""
    config = MARKERS.config(name)
    assert isinstance(config, MarkersConfig) and config == MARKERS.config_class(name)() and MARKERS.name_of(config) == name
    assert pickle.loads(pickle.dumps(config)) == config
    noisy = MARKERS.config(name, perturbation=MarkerPerturbation(dropout=0.1))
    assert noisy != config and noisy.perturbation == MarkerPerturbation(dropout=0.1)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Fots(perturbation=0.5), "perturbation = 0.5: must be a MarkerPerturbation or None"),  # type: ignore[arg-type]
        (lambda: Fots(contacts=None), "contacts = None: must be a ContactSettings"),  # type: ignore[arg-type]
        (lambda: ContactSettings(cell=0.0), r"cell = 0.0: must be finite and > 0"),
        (lambda: ContactSettings(reach=float("nan")), r"reach = nan: must be finite and > 0"),
        (lambda: Superposition(level="finest"), "level = 'finest'.*did you mean 'fine'"),
        (lambda: Superposition(rounds=0), "rounds = 0"),
        (lambda: MARKERS.config("fots", rounds=3), "rounds = 3.*perturbation, contacts"),
    ],
)
def test_configurations_refuse_what_cannot_be(make: Callable[[], object], match: str) -> None:
    with pytest.raises(InputError, match=match):
        make()


@pytest.mark.renderer
def test_contact_settings_reach_sampling_and_tracking(sensor: SensorSpec, grid: PadGrid) -> None:
    """A contact 3.1 mm from where the object carries it is the same one with the default reach, and a new one with a short reach."""
    first = pressed(grid, [(0, 0, DEEP)], poses=[pose()])
    jumped = pressed(grid, [(3.2e-3, 0, DEEP)], poses=[pose(1e-4)])
    moved = []
    for settings in (ContactSettings(), ContactSettings(reach=1e-5), ContactSettings(cell=0.1e-3)):
        tracker = MarkerTracker(sensor, ForceField(contacts=settings), grid)
        tracker.update(first)
        moved.append(tracker.update(jumped).displacement)
    fresh = MarkerTracker(sensor, "force_field", grid).update(jumped).displacement
    np.testing.assert_array_equal(moved[1], fresh)
    assert np.abs(moved[0] - fresh).max() > 1e-5 and np.abs(moved[2] - fresh).max() > 1e-5
    cells = [
        MarkerTracker(sensor, Fots(contacts=ContactSettings(cell=c)), grid, device="cpu").update(first).displacement
        for c in (4e-4, 1e-4)
    ]
    assert 0 < np.abs(cells[0] - cells[1]).max() < 4e-6


@pytest.mark.parametrize("bad", [{"noise_px": -1.0}, {"dropout": 1.0}, {"shift": np.nan}])
def test_sizes_out_of_range(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        MarkerPerturbation(**bad)


@pytest.mark.renderer
def test_places_in_space_and_image_are_computed_when_asked_for(
    sensor: SensorSpec, grid: PadGrid, monkeypatch: pytest.MonkeyPatch
) -> None:
    noisy = Fots(perturbation=MarkerPerturbation(noise_px=0.3, dropout=0.2))
    trackers = [MarkerTracker(sensor, noisy, grid, num_envs=2, device="cpu", seed=3) for _ in range(2)]
    surface = pressed(grid, [(0, 0, DEEP)], [(1e-3, 0, DEEP)])
    with monkeypatch.context() as patch:
        patch.setattr("raytac.markers.tracker.height_at", lambda *_: pytest.fail("computed without need"))
        late = trackers[0].update(surface)
        seen = late.displacement.copy()
    frame = trackers[1].update(surface)
    assert frame.displacement_px.shape == (2, 99, 2) and np.isnan(frame.displacement_px).any()
    np.testing.assert_array_equal(seen, frame.displacement)
    trackers[0].update(pressed(grid, [(2e-3, 0, DEEP)], []))  # what comes later changes nothing
    copies = pickle.loads(pickle.dumps(late)), late
    for one in copies:
        for name in ("displacement", "displacement_px", "rest", "rest_px", "position", "visible"):
            np.testing.assert_array_equal(getattr(one, name), getattr(frame, name))


@pytest.mark.renderer
def test_pads_that_nothing_touches_need_no_kernel(sensor: SensorSpec, grid: PadGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = MarkerTracker(sensor, "fots", grid, num_envs=2, device="cpu")
    with monkeypatch.context() as patch:
        patch.setattr("raytac.markers.fots.FotsKernel.displacement", lambda *_: pytest.fail("launched without need"))
        assert not tracker.update(pressed(grid, [], [])).displacement.any()
    assert tracker.update(pressed(grid, [], [(0, 0, DEEP)])).displacement[1].any()
