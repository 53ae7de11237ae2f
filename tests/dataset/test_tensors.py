"""Samples as tensors: channels first, types that networks take, transforms, loaders with processes. Skipped without PyTorch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from raytac.dataset import DatasetPlan, PressDataset, render_dataset
from raytac.errors import InputError
from raytac.specs import SweepSpec

torch = pytest.importorskip("torch")
NAMES = ("rgb", "rest_rgb", "height", "contact", "wrench", "press_depth", "object", "label")


@pytest.fixture(scope="module")
def presses(sweep: SweepSpec, tmp_path_factory: pytest.TempPathFactory) -> PressDataset:
    folder = tmp_path_factory.mktemp("data") / "data"
    render_dataset(DatasetPlan(sweep), folder, device="cpu", batch=4)
    return PressDataset(folder, NAMES)


def tensors(presses: PressDataset, **options: Any) -> Any:
    from raytac.dataset import PressTensors

    return PressTensors(presses, **options)


def test_tensors_hold_the_press_with_channels_first(presses: PressDataset) -> None:
    data = tensors(presses)
    assert isinstance(data, torch.utils.data.Dataset) and len(data) == len(presses)
    for i in range(len(data)):
        ours, press = data[i], presses[i]
        assert list(ours) == list(NAMES)
        np.testing.assert_array_equal(ours["rgb"].numpy().transpose(1, 2, 0), press["rgb"])
        np.testing.assert_array_equal(ours["height"].numpy(), press["height"])
        np.testing.assert_allclose(ours["wrench"].numpy(), press["wrench"], rtol=1e-6)
        assert ours["label"].item() == press["label"] and ours["object"] == press["object"]
    types = {name: value.dtype for name, value in data[0].items() if name != "object"}
    numbers = {"height": torch.float32, "wrench": torch.float32, "press_depth": torch.float32}
    assert types == {"rgb": torch.uint8, "rest_rgb": torch.uint8, "contact": torch.bool, "label": torch.int64, **numbers}
    assert data[0]["press_depth"].shape == data[0]["label"].shape == ()


def halved(image: Any) -> Any:
    return image.float() / 510.0


def difference(sample: dict[str, Any]) -> tuple[Any, Any]:
    return sample["rgb"] - sample["rest_rgb"], sample["label"]


def test_transforms_work_in_the_processes_of_a_loader(presses: PressDataset) -> None:
    data = tensors(presses, image_transform=halved, transform=difference)
    loader = torch.utils.data.DataLoader(data, batch_size=4, num_workers=2)
    batches = list(loader)
    images, labels = torch.cat([batch[0] for batch in batches]), torch.cat([batch[1] for batch in batches])
    assert images.shape == (len(presses), 3, 24, 32) and labels.dtype == torch.int64
    for image, label, press in zip(images, labels, presses, strict=True):  # type: ignore[call-overload]
        expected = (press["rgb"].astype(np.float32) - press["rest_rgb"]) / 510.0
        np.testing.assert_allclose(image.numpy().transpose(1, 2, 0), expected, atol=1e-6)
        assert label == press["label"]
    assert set(labels.tolist()) == {0, 1}
    plain = next(iter(torch.utils.data.DataLoader(tensors(presses), batch_size=3)))
    assert plain["object"] == [presses[i]["object"] for i in range(3)]


def test_a_sequence_of_samples_will_do_and_a_transform_is_a_function(presses: PressDataset) -> None:
    video = {"rgb": np.arange(2 * 4 * 5 * 3, dtype=np.uint8).reshape(2, 4, 5, 3), "time": np.array([0.0, 0.1])}
    made = tensors([video], image_transform=halved)[0]  # type: ignore[arg-type]
    assert made["rgb"].shape == (2, 3, 4, 5) and made["rgb"].dtype == torch.float32 and made["time"].shape == (2,)
    np.testing.assert_allclose(made["rgb"][1, 2].numpy(), video["rgb"][1, :, :, 2] / 510.0)
    with pytest.raises(InputError, match="transform = 'v2'"):
        tensors(presses, transform="v2")
