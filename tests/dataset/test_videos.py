"""Presses frame by frame: a video begins above the gel, ends at the peak, and is read like any other press."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from raytac.dataset import DatasetPlan, PressDataset, contact_sheet, render_dataset, verify_dataset
from raytac.specs import PressRanges, SweepSpec

EACH = 4
"""Frames through a stage."""


@pytest.fixture(scope="module")
def data(sweep: SweepSpec, tmp_path_factory: pytest.TempPathFactory) -> dict[bool, PressDataset]:
    """The same presses as videos and at their peaks, without noise."""
    made = {}
    plain = replace(sweep, count=5, randomization={}, marker_perturbation={})
    for video in (False, True):
        folder = tmp_path_factory.mktemp("data") / "data"
        plan = DatasetPlan(replace(plain, frames_per_stage=EACH if video else None))
        render_dataset(plan, folder, device="cpu", batch=4)
        assert not verify_dataset(folder).wrong
        made[video] = PressDataset(folder)
    return made


def test_a_video_ends_where_the_press_does(data: dict[bool, PressDataset]) -> None:
    still, video = data[False], data[True]
    assert still.frames is None and video.frames == 1 + 2 * EACH and len(video) == len(still) == 5
    for peak, press in zip(still, video, strict=True):  # type: ignore[call-overload]
        assert press["rgb"].shape == (9, 24, 32, 3) and press["wrench"].shape == (9, 6)
        for name in ("index", "object", "label", "markers_rest"):
            np.testing.assert_array_equal(press[name], peak[name])
        for name in ("height", "contact", "pad_from_object"):
            np.testing.assert_allclose(press[name][-1], peak[name], atol=1e-9)
        np.testing.assert_allclose(press["wrench"][-1], peak["wrench"], rtol=1e-6, atol=1e-9)
        assert np.abs(press["rgb"][-1].astype(int) - peak["rgb"]).max() <= 1


def test_a_video_begins_above_the_gel_and_presses_ever_deeper(data: dict[bool, PressDataset]) -> None:
    video = data[True]
    for i, press in enumerate(video):  # type: ignore[arg-type]
        rest, depth = video.shared(i), video.manifest["press_depth"][i].as_py()
        np.testing.assert_array_equal(press["height"][0], rest["rest_height"])
        np.testing.assert_array_equal(press["rgb"][0], rest["rest_rgb"])
        assert not press["contact"][0].any() and not press["wrench"][0].any()
        travel = press["travel"]
        assert travel[0] == pytest.approx(-1e-3) and travel[EACH] == pytest.approx(depth)
        assert (np.diff(travel[: EACH + 1]) > 0).all() and np.ptp(travel[EACH:]) < 0.2 * depth
        load = -press["wrench"][: EACH + 1, 2]
        assert (np.diff(load) >= 0).all() and load[-1] > 0.0
        assert (load > 0.0).tolist() == (travel[: EACH + 1] > 0.0).tolist()
        sheared = press["pad_from_object"][-1, :2, 3] - press["pad_from_object"][EACH, :2, 3]
        expected = [video.manifest[name][i].as_py() for name in ("shear_x", "shear_y")]
        np.testing.assert_allclose(sheared, expected, atol=1e-7)


def test_a_camera_keeps_its_exposure_through_a_video_and_its_noise_does_not(sweep: SweepSpec, tmp_path: Path) -> None:
    ranges = PressRanges(depth=(0.3e-3, 0.3e-3))
    gain = {"exposure": 0.3, "noise": 2.0}
    noisy = replace(sweep, count=4, ranges=ranges, randomization=gain, frames_per_stage=8, objects=sweep.objects[:1])
    render_dataset(DatasetPlan(noisy), tmp_path / "data", device="cpu", batch=4)
    gains = []
    for press in PressDataset(tmp_path / "data", ("rgb", "rest_rgb")):  # type: ignore[attr-defined]
        margin = press["rgb"][:, :, :6].astype(float)  # far from the ball
        means = margin.mean(axis=(1, 2, 3))
        assert np.ptp(means) < 1.0  # one exposure
        for one, other in pairwise(margin):
            assert np.std(one - other) / np.sqrt(2.0) == pytest.approx(2.0, rel=0.15)  # noise of its own in every frame
        gains.append(means.mean() / press["rest_rgb"][:, :6].mean())
    assert np.ptp(gains) > 0.02


def test_a_sheet_of_videos_shows_their_last_frames(data: dict[bool, PressDataset]) -> None:
    still, video = (contact_sheet(data[kind], 3, columns=3).astype(int) for kind in (False, True))
    assert still.shape == video.shape and np.abs(still - video).mean() < 1.0
