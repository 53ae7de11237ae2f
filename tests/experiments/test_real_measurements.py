"""Tables against measurements: from made-up data whose truth is known they give back that truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import drag_photographs, real_force, real_markers
from experiments.drag_photographs import BallMotion, ball_points, layer_motion
from raytac.calibrate import ball_forces, modulus_factor
from raytac.errors import InputError
from raytac.io.images import write_png
from raytac.io.metrics import read_metrics
from raytac.markers import camera_of
from raytac.markers.registry import markers_config
from raytac.physics import Rigid
from raytac.se3 import rotations
from raytac.specs import SensorSpec, load_sensor

SIZE, PITCH = (320, 240), 0.0532
CIRCLE, BALL = np.array([150.0, 118.0, 36.0]), 3e-3
DRAG, TURN, CONSTANT = np.array([-1.5, 8.0]), np.radians(1.0), np.array([0.6, 2.0])
"""Displacement of the ball, of the whole gel [px], and turn of the ball."""


def measured(folder: Path, force: np.ndarray, depths: tuple[float, ...]) -> Path:
    path = folder / "force.csv"
    rows = [f"{depth},{value}" for depth, value in zip(depths, force, strict=True)]
    path.write_text("\n".join(["# made up", "depth_mm,force_n", *rows]) + "\n", "utf-8")
    return path


def test_a_modulus_is_recovered_from_forces_of_the_pad_itself(tmp_path: Path) -> None:
    """Forces 1.25 times the pad's own are off by a fifth, and by nothing with the modulus fitted to other depths."""
    depths = 0.3, 0.6, 1.0
    (own,) = ball_forces(load_sensor("gelsight_mini"), [Rigid()], 5e-3, 1e-3 * np.array(depths))
    assert own[0] > 0.1 and (np.diff(own) > 0).all()
    data = measured(tmp_path, 1.25 * own, depths)
    args = real_force.Args(data=data, radius_mm=5.0, levels="", poisson_ratios="0.3", out=tmp_path / "run", device="cpu")
    real_force.main(args)
    metrics = read_metrics(tmp_path / "run" / "metrics.json")
    assert metrics["force.rigid.modulus_kpa"] == pytest.approx(1.25 * 430.0, rel=1e-6)
    for depth in depths:
        assert metrics[f"force.rigid.{depth:g}.error"] == pytest.approx(-0.2, abs=1e-6)
        assert metrics[f"force.rigid.{depth:g}.held_out_error"] == pytest.approx(0.0, abs=1e-6)
    # Another Poisson's ratio changes how force grows with depth, which no modulus takes back.
    assert float(metrics["force.rigid.poisson_0.3.held_out_worst"]) > 0.02
    # With the modulus that is right, and a friction that the rigid pad's law does not know, nothing is off.
    right = replace(args, modulus_kpa=1.25 * 430.0, poisson_ratios="0.3", frictions="0.5", out=tmp_path / "right")
    real_force.main(right)
    metrics = read_metrics(tmp_path / "right" / "metrics.json")
    assert float(metrics["force.rigid.worst"]) < 1e-6 < float(metrics["force.rigid.poisson_0.3.worst"])
    assert not [key for key in metrics if "friction_" in key]
    with pytest.raises(InputError, match="modulus_kpa"):
        real_force.main(replace(args, modulus_kpa=0.0))


def test_a_fitted_modulus_is_of_the_other_depths() -> None:
    force, true = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 6.0])
    assert modulus_factor(force, force) == 1.0
    np.testing.assert_allclose(real_force.held_out_errors(force, true)[2], -0.5)
    factor = modulus_factor(force, true)
    off = [np.square(f * force / true - 1.0).sum() for f in (factor - 1e-4, factor, factor + 1e-4)]
    assert off[1] < min(off[0], off[2])


def test_ratios_that_no_gel_has_are_refused(tmp_path: Path) -> None:
    data = measured(tmp_path, np.array([1.0, 2.0]), (1.0, 2.0))
    with pytest.raises(InputError, match="poisson_ratios"):
        real_force.main(real_force.Args(data=data, radius_mm=5.0, levels="", poisson_ratios="0.6", device="cpu"))


def rings(sensor: SensorSpec, at: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Rings of a ball with layers that lie askew, where the ray of each pixel from the pinhole meets the ball at ``at``."""
    height, pitch = -sensor.camera.position[2], PITCH / 1e3
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    ray = np.stack([(u - SIZE[0] / 2) * pitch / height, (v - SIZE[1] / 2) * pitch / height, np.ones_like(u)], axis=-1)
    start = np.array([0.0, 0.0, -height]) - at
    a, b, c = (ray**2).sum(axis=-1), ray @ start, start @ start - BALL**2
    root = b**2 - a * c
    own = (start + ((-b - np.sqrt(np.maximum(root, 0.0))) / a)[..., None] * ray) @ turned  # axes of the ball
    layers = 6.0 * np.cos(2.0 * np.pi * (own @ np.array([0.25, -0.1, 0.963])) / 0.13e-3)
    return np.where((root > 0.0) & (np.hypot(own[..., 0], own[..., 1]) < 0.75 * BALL), layers, 0.0)


def ringed(dots: tuple[np.ndarray, np.ndarray], fields: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Two photographs of dots with rings and grain."""
    grain = np.random.default_rng(3).normal(size=(2, *SIZE[::-1]))
    return tuple(
        np.clip(photograph(at) + (field + noise)[..., None], 0, 255).astype(np.uint8)
        for at, field, noise in zip(dots, fields, grain, strict=True)
    )


def test_a_rolling_balls_motion_is_read_from_its_layers(dots: np.ndarray) -> None:
    """Rings of a ball whose layers lie askew, which moves and tilts under a pinhole, under dots that do not go along."""
    sensor = real_markers.photographed(load_sensor("gelsight_mini"), SIZE, PITCH / 1e3)
    centre, shear, tilt = np.array([-0.5e-3, 0.2e-3, 1.6e-3]), np.array([0.1e-3, 0.45e-3]), np.array([0.03, 0.06])
    moved = centre + np.array([*shear, 0.0])
    images = ringed((dots, dots), (rings(sensor, centre, np.eye(3)), rings(sensor, moved, rotations(np.array([*tilt, 0.0])))))
    circle = np.array([*camera_of(sensor).project(centre - [0.0, 0.0, BALL]), 38.0])
    read = layer_motion(images, sensor, circle, centre, BALL)
    np.testing.assert_allclose(read.motion.lowest(BALL), shear + BALL * np.array([-tilt[1], tilt[0]]), atol=0.012e-3)
    np.testing.assert_allclose(read.motion.tilt, tilt, atol=0.012)
    np.testing.assert_allclose(read.motion.shear, shear, atol=0.04e-3)
    assert read.correlation > read.without_roll + 0.01
    edges = sorted(read.annuli)
    assert min(read.annuli[edge] for edge in edges if edge < 36.0) > 0.75  # the rings end at 0.75 radii, 42 px
    assert max(abs(read.annuli[edge]) for edge in edges if edge > 43.0) < 0.3
    figures = read.figures(BALL)
    assert figures["centre_y_um"] == pytest.approx(450.0, abs=40.0) and figures["tilt_y_deg"] == pytest.approx(3.4, abs=0.7)


def test_a_ball_is_seen_where_its_points_are_projected() -> None:
    sensor = real_markers.photographed(load_sensor("gelsight_mini"), SIZE, PITCH / 1e3)
    centre = np.array([0.5e-3, -0.3e-3, 1.7e-3])
    u, v = np.array([150.0, 170.0, 190.0]), np.array([110.0, 115.0, 120.0])
    points = ball_points(sensor, u, v, centre, BALL)
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), BALL, rtol=1e-9)
    assert (points[:, 2] < centre[2]).all()  # its near side
    np.testing.assert_allclose(camera_of(sensor).project(points), np.column_stack([u, v]), atol=1e-9)
    assert np.isnan(ball_points(sensor, np.array([20.0]), np.array([20.0]), centre, BALL)).all()


def test_a_turn_by_dots_is_what_the_balls_motion_leaves(dots: np.ndarray) -> None:
    """Dots of a ball that moves, tilts and turns: the turn is read, whatever the rest of the motion; dots beside it do not matter."""
    sensor = real_markers.photographed(load_sensor("gelsight_mini"), SIZE, PITCH / 1e3)
    centre, motion = np.array([-0.5e-3, 0.0, 1.6e-3]), BallMotion(np.array([0.1e-3, 0.5e-3]), np.array([0.04, 0.06]))
    circle = np.array([*camera_of(sensor).project(centre - [0.0, 0.0, BALL]), 44.0])
    within = np.hypot(*(dots - circle[:2]).T) < circle[2]
    u, v = dots[within].T
    points = ball_points(sensor, u, v, centre, BALL)
    after = dots.copy() + 3.0
    x, y = (dots[within] - circle[:2]).T
    after[within] = camera_of(sensor).project(motion.of(points, centre)) + 0.02 * np.column_stack([-y, x])
    drag = drag_photographs.Drag(dots, after, 0, SIZE)
    places, farther = real_markers.over_ball(sensor, drag, circle, centre, BALL, motion)
    np.testing.assert_array_equal(places, dots[within])
    moved, turn = drag_photographs.rigid_motion(places, farther, circle[:2])
    assert turn == pytest.approx(0.02, abs=1e-9) and np.abs(moved).max() < 1e-9


def test_detection_is_judged_by_other_thresholds(dots: np.ndarray) -> None:
    """Clean dots hardly depend on them; with a grey spot beside each, which stays where it was, they do."""
    after = dots + np.array([0.4, 1.3])
    clean = photograph(dots), photograph(after)
    spoilt = tuple(image.copy() for image in clean)
    for image in spoilt:
        for x, y in (dots + np.array([2.0, 0.0])).astype(int):
            image[y - 4 : y + 5, x : x + 6] = 125
    errors = []
    for images in (clean, spoilt):
        before, later = (drag_photographs.dot_centres(image, at)[0] for image, at in zip(images, (dots, after), strict=True))
        errors.append(drag_photographs.detection_error(drag_photographs.Drag(before, later, 0, SIZE, images)))
    print(errors)
    assert errors[0] < 0.1 and 1.5 * errors[0] < errors[1]


def test_smooth_parts_name_the_motion_that_explains_a_difference(dots: np.ndarray) -> None:
    x, y = ((dots - dots.mean(axis=0)) / 100.0).T
    turned = np.column_stack([0.3 - 0.5 * y + 0.2 * x, 0.1 + 0.5 * x + 0.2 * y])
    assert max(real_markers.smooth_parts(dots, turned).values()) < 1e-9
    sheared = real_markers.smooth_parts(dots, np.column_stack([0.5 * y, 0.0 * y]))
    assert sheared["affine"] < 1e-9 < 0.05 < sheared["turn_and_scale"]
    bent = real_markers.smooth_parts(dots, np.column_stack([x * y, 0.5 * x * x]))
    assert bent["quadratic"] < 1e-9 < 0.05 < bent["affine"]
    noise = np.random.default_rng(2).normal(size=dots.shape)  # held-out dots gain nothing from what is fitted to noise
    assert all(rms > 0.98 * np.sqrt((noise**2).sum(axis=1).mean()) for rms in real_markers.smooth_parts(dots, noise).values())


UNKNOWN = (
    ("vary", "radius_px=40,a"),
    ("vary", "colour=1,2"),
    ("vary", "friction=1"),
    ("vary", "friction=a,b"),
    ("vary", "bonded=back,glue"),
)
"""Variations of the gelpad that are refused."""


def photograph(centres: np.ndarray, radius: float = 4.6) -> np.ndarray:
    """Dark round dots on a bright ground that is uneven, with edges one pixel wide."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    ground = 180.0 + 0.15 * u - 0.1 * v
    for x, y in centres:
        ground = ground * (1.0 - 0.85 * np.clip(radius + 0.5 - np.hypot(u - x, v - y), 0.0, 1.0))
    return np.repeat(np.rint(ground).astype(np.uint8)[..., None], 3, axis=2)


def drag_folder(folder: Path, before: np.ndarray, after: np.ndarray) -> Path:
    for k, centres in enumerate((before, after)):
        write_png(folder / f"{k}.png", photograph(centres))
        start = np.rint(before)
        rows = np.column_stack([start, np.rint(centres - start)]).astype(int)
        lines = ["Mx,My,dx,dy", *(",".join(map(str, row)) for row in rows)]
        (folder / f"{k}.csv").write_text("\n".join(lines) + "\n", "utf-8")
    return folder


@pytest.fixture(scope="module")
def dots() -> np.ndarray:
    x, y = np.meshgrid(np.arange(25.0, 310.0, 26.0), np.arange(20.0, 230.0, 24.0))
    return np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(1).uniform(-0.5, 0.5, (x.size, 2))


def test_centroids_of_dots_are_right_below_a_pixel(dots: np.ndarray) -> None:
    centres, areas = drag_photographs.dot_centres(photograph(dots), np.rint(dots) + np.array([3.0, -2.0]))
    assert np.abs(centres - dots).max() < 0.04 and areas.min() > 50.0
    _, none = drag_photographs.dot_centres(photograph(dots[:1]), dots[:1] + 60.0)
    assert none[0] < drag_photographs.LEAST


def test_a_rigid_motion_is_recovered() -> None:
    places = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 8.0]])
    turned = 0.01 * np.column_stack([-(places[:, 1] - 2.0), places[:, 0] - 1.0])
    moved, turn = drag_photographs.rigid_motion(places, turned + np.array([3.0, -1.0]), np.array([1.0, 2.0]))
    np.testing.assert_allclose(moved, (3.0, -1.0), atol=1e-12)
    assert turn == pytest.approx(0.01)


def test_a_model_recovers_its_own_drag_with_its_constant(tmp_path: Path, dots: np.ndarray) -> None:
    """Dots that FOTS moves on a gel that slides as a whole: FOTS with a constant leaves the centroids' noise, others more."""
    sensor = real_markers.photographed(load_sensor("gelsight_mini"), SIZE, PITCH / 1e3)
    ball = real_markers.pressed_ball(sensor, CIRCLE, BALL, "cpu")
    assert ball.surface is not None
    dragged = real_markers.Dragged(sensor, ball, BALL, "coarse", "cpu")
    motion = dragged.motion(markers_config("fots"), dots, BallMotion(DRAG * PITCH / 1e3, turn=TURN)) + CONSTANT
    data = drag_folder(tmp_path, dots, dots + motion)
    args: dict[str, Any] = {
        "circle_px": ",".join(map(str, CIRCLE)),
        "ball_radius_mm": 1e3 * BALL,
        "pitch_mm": PITCH,
        "device": "cpu",
    }
    real_markers.main(real_markers.Args(data=data, models="fots,force_field", out=tmp_path / "run", **args))
    metrics = read_metrics(tmp_path / "run" / "metrics.json")
    assert (metrics["markers.dots"], metrics["markers.lost"]) == (len(dots), 0)
    assert metrics["markers.ball_um"] == pytest.approx(1e3 * PITCH * np.hypot(*(DRAG + CONSTANT)), rel=0.03)
    assert metrics["markers.turn_deg"] == pytest.approx(1.0, abs=0.4)
    assert (tmp_path / "run" / "residuals.png").stat().st_size > 10_000
    assert float(metrics["markers.fots.constant.smooth_quadratic_um"]) < 8.0
    fots = {key: float(metrics[f"markers.fots.{key}"]) for key in ("rms_um", "constant.rms_um", "constant.x_um", "constant.y_um")}
    assert fots["constant.rms_um"] < 8.0 < 50.0 < fots["rms_um"]
    np.testing.assert_allclose((fots["constant.x_um"], fots["constant.y_um"]), 1e3 * PITCH * CONSTANT, atol=6.0)
    assert float(metrics["markers.force_field.constant.rms_um"]) > 4.0 * fots["constant.rms_um"]


def test_models_are_told_the_motion_that_rings_show(tmp_path: Path, dots: np.ndarray) -> None:
    """A ball that moves on and leans, under dots that hardly go along: models follow the ball, and leave its drag in the dots."""
    sensor = real_markers.photographed(load_sensor("gelsight_mini"), SIZE, PITCH / 1e3)
    ball = real_markers.pressed_ball(sensor, CIRCLE, BALL, "cpu")
    assert ball.surface is not None
    x, y = ball.surface.contact_centre[0]
    centre, shear, tilt = np.array([x, y, BALL - ball.depth]), np.array([0.05e-3, 0.4e-3]), np.array([0.0, 0.05])
    after = dots + np.array([0.3, 0.6])
    turned, moved = rotations(np.array([*tilt, 0.0])), centre + np.array([*shear, 0.0])
    data = drag_folder(tmp_path, dots, after)
    fields = rings(sensor, centre, np.eye(3)), rings(sensor, moved, turned)
    for k, image in enumerate(ringed((dots, after), fields)):
        write_png(data / f"{k}.png", image)
    args: dict[str, Any] = {
        "circle_px": ",".join(map(str, CIRCLE)),
        "ball_radius_mm": 1e3 * BALL,
        "pitch_mm": PITCH,
        "device": "cpu",
        "models": "fots",
    }
    for name, layers in (("dots", False), ("rings", True)):
        real_markers.main(real_markers.Args(data=data, layers=layers, out=tmp_path / name, **args))
    by_dots, by_rings = (read_metrics(tmp_path / name / "metrics.json") for name in ("dots", "rings"))
    assert float(by_rings["markers.layers.centre_y_um"]) == pytest.approx(400.0, abs=40.0)
    assert float(by_rings["markers.layers.tilt_y_deg"]) == pytest.approx(np.degrees(0.05), abs=0.7)
    assert float(by_rings["markers.fots.rms_um"]) > 2.0 * float(by_dots["markers.fots.rms_um"])


@dataclass(frozen=True)
class Scaled:
    """Dots of one value of a varied gelpad: they go along by a share, the second half by another."""

    shares: tuple[float, float]
    sensor = load_sensor("gelsight_mini")

    def motion(self, _: Any, before: np.ndarray, own: BallMotion) -> np.ndarray:
        across = own.shear / np.asarray(self.sensor.camera.pixel_pitch) * (before[:, :1] - before[:, 0].mean()) / 100.0
        return across * np.array([self.shares[k % 2] for k in range(len(before))])[:, None]


def test_a_value_is_chosen_on_one_half_of_the_dots_and_tested_on_the_other(dots: np.ndarray) -> None:
    """Photographs in which the first half goes along by 1 and the second by 2: each is tested with the other's choice."""
    own = BallMotion(np.array([2.0, 8.0]) * np.asarray(Scaled.sensor.camera.pixel_pitch))
    pads: Any = {str(k): Scaled((share, share)) for k, share in enumerate((0.5, 1.0, 2.0))}
    seen = Scaled((1.0, 2.0)).motion(None, dots, own)
    drag = drag_photographs.Drag(dots, dots + seen, 0, SIZE)
    metrics = real_markers.chosen_by_halves(drag, pads, "surface", "friction", own, 10.0)
    assert (metrics["varied.surface.tested_first"], metrics["varied.surface.tested_second"]) == ("2", "1")
    assert float(metrics["varied.surface.1.first_um"]) < 1.0 and float(metrics["varied.surface.2.second_um"]) < 1.0
    apart = np.linalg.norm(seen[::2], axis=1)  # by as much as the second half's share is larger
    assert float(metrics["varied.surface.tested_first_um"]) == pytest.approx(10.0 * np.sqrt((apart**2).mean()), rel=0.03)


def test_drags_without_their_files_are_refused(tmp_path: Path, dots: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"0\.png and 1\.png"):
        drag_photographs.Drag.read(tmp_path)
    data = drag_folder(tmp_path, dots, dots)
    drag = drag_photographs.Drag.read(data)
    with monkeypatch.context() as patch:
        patch.setattr(drag_photographs.Drag, "read", lambda _: drag)  # finding the dots takes longer than all the rest
        check_refused(data, tmp_path)
    (data / "1.csv").write_text("Mx,My\n1,2\n", "utf-8")
    with pytest.raises(InputError, match="Mx, My, dx, dy"):
        drag_photographs.Drag.read(data)


def check_refused(data: Path, tmp_path: Path) -> None:
    """Options that are wrong are named."""
    for name, text in (("circle_px", "1,2"), ("circle_px", "20,20,3"), ("models", "none"), ("level", "huge"), *UNKNOWN):
        args: dict[str, Any] = {"circle_px": "150,118,36", "ball_radius_mm": 3.0, "pitch_mm": PITCH, "device": "cpu"} | {
            name: text
        }
        with pytest.raises(InputError, match=name):
            real_markers.main(real_markers.Args(data=data, out=tmp_path / "run", **args))
