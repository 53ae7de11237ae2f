"""``PressTensors``: samples of a data set as tensors of PyTorch, with transforms."""

# pyright: reportMissingImports=false
# (PyTorch is the user's own; the tests do without it.)

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from raytac.errors import InputError

_IMAGES = ("rgb", "rest_rgb", "normals", "traction")
"""Arrays with three channels: last in NumPy, before height and width in PyTorch."""


class PressTensors(Dataset):
    """Samples as tensors, for ``torch.utils.data.DataLoader``.

    .. code-block:: python

        presses = PressDataset("runs/dataset", ("rgb", "rest_rgb", "wrench", "label"))
        data = PressTensors(presses, image_transform=v2.ToDtype(torch.float32, scale=True))  # torchvision.transforms.v2
        data[0]["rgb"]  # (3, H, W), float32 in [0, 1]; of a video (T, 3, H, W)

    Images and maps with three channels have them before height and width. 8-bit images, masks and whole numbers keep their types, other
    numbers become float32, and texts stay texts, of which a loader makes lists.
    """

    def __init__(
        self,
        data: Sequence[Mapping[str, Any]] | Any,
        *,
        image_transform: Callable[[torch.Tensor], Any] | None = None,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        """Wrap ``data``; nothing is read yet.

        Args:
            data: a ``PressDataset``, or any sequence of samples by name.
            image_transform: function of each 8-bit image (3, H, W) or video (T, 3, H, W).
            transform: function of the whole sample, after that; its result is given.

        Raises:
            InputError: a transform that is no function.
        """
        for name, function in (("image_transform", image_transform), ("transform", transform)):
            if function is not None and not callable(function):
                raise InputError(name, value=function, rule="must be a function")
        self.data, self.image_transform, self.transform = data, image_transform, transform

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, i: int) -> Any:
        """Sample ``i``; raises as the data set does."""
        sample = {name: self._tensor(name, value) for name, value in self.data[i].items()}
        return sample if self.transform is None else self.transform(sample)

    def _tensor(self, name: str, value: Any) -> Any:
        if isinstance(value, str):
            return value
        value = np.asarray(value)
        is_image = name in _IMAGES
        if is_image:
            value = np.moveaxis(value, -1, -3)
        if value.dtype == np.float64:
            value = value.astype(np.float32)
        tensor = torch.from_numpy(np.ascontiguousarray(value).reshape(value.shape))  # a contiguous copy of () has shape (1,)
        if is_image and tensor.dtype == torch.uint8 and self.image_transform is not None:
            return self.image_transform(tensor)
        return tensor
