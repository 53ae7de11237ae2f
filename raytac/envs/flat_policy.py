"""Policies of ``raytac train``, saved by ``torch.save`` and played by NumPy."""

from __future__ import annotations

import io
import itertools
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from raytac.envs.flat import FlatVector
from raytac.errors import InputError

_EPSILON = 1e-2
"""Added to the deviation of an observation, as rsl_rl's ``EmpiricalNormalization`` does."""


class FlatPolicy:
    """Deterministic actions (B, k) from the observation ``actor`` (B, n) of a ``FlatVector``.

    It is rsl_rl's network in NumPy, so that a policy plays without PyTorch: normalised observations, then layers with ELU in between.

    Attributes:
        task, touch, history, physics: what it was trained with, in the words of ``raytac train``.
    """

    def __init__(self, path: Path) -> None:
        """Load a ``policy.pt``. Raises ``InputError`` for a file that is none."""
        saved = read_tensors(path)
        if isinstance(saved, dict) and "recipe" in saved:
            rule = "is a checkpoint of train_ppo.py, not of raytac train: experiments/play.py of a checkout plays it"
            raise InputError("policy", value=path, rule=rule)
        try:
            settings, weights = saved["settings"], saved["actor_state_dict"]
            self.task, self.touch, self.history = str(settings["task"]), str(settings["touch"]), int(settings["history"])
            self.physics = str(settings.get("physics", "rigid"))
            self._mean, self._deviation = weights["obs_normalizer._mean"], weights["obs_normalizer._std"]
            names = sorted((name for name in weights if name.startswith("mlp.") and name.endswith(".weight")), key=_layer)
            self._layers = [(weights[name].T, weights[name.replace("weight", "bias")]) for name in names]
            sizes = [self._mean.shape[1], *(len(bias) for _, bias in self._layers)]
            if [weight.shape for weight, _ in self._layers] != list(itertools.pairwise(sizes)):
                raise ValueError("its layers do not fit each other")
        except Exception as error:
            raise InputError("policy", value=path, rule=f"must be a policy of raytac train ({error})") from error

    @staticmethod
    def is_one(path: Path) -> bool:
        """True if the file says of itself that ``raytac train`` has written it."""
        try:
            return "actor_state_dict" in read_tensors(path)
        except InputError:
            return False  # whoever loads it says what is wrong

    @property
    def tactile(self) -> Any:
        """Tactile observation, as ``TaskBatch`` takes it."""
        return {"none": None, "task": "task"}.get(self.touch, tuple(self.touch.split("+")))

    @property
    def felt(self) -> tuple[str, ...]:
        """Modalities that it is given."""
        import raytac.envs

        return getattr(raytac.envs, self.task).tactile if self.touch == "task" else self.tactile or ()

    def vector(self, num_envs: int, *, hidden: Sequence[str] = (), **options: Any) -> FlatVector:
        """Environments of its task, observed as in training but for ``options``.

        These are of ``TactileVectorEnv``.
        """
        import raytac.envs

        kind = getattr(raytac.envs, f"{self.task}VectorEnv")
        return FlatVector(
            kind, num_envs, history=self.history, hidden=hidden, **{"tactile": self.tactile, "physics": self.physics, **options}
        )

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        values = (observation - self._mean) / (self._deviation + _EPSILON)
        for k, (weight, bias) in enumerate(self._layers):
            if k:
                values = np.where(values > 0.0, values, np.expm1(np.minimum(values, 0.0)))
            values = values @ weight + bias
        return values


def _layer(name: str) -> int:
    """Number of a layer in the name of its weights, ``mlp.<number>.weight``."""
    return int(name.split(".")[1])


_STORAGES = {"FloatStorage": np.float32, "DoubleStorage": np.float64, "LongStorage": np.int64, "IntStorage": np.int32}
_MOST_BYTES = 2**28
"""Of one array of numbers, so that a damaged file cannot ask for more."""


def read_tensors(path: Path) -> Any:
    """Contents of a file of ``torch.save``, with tensors as arrays.

    The file is a zip of a pickle and of the tensors' numbers, little-endian. The pickle may name nothing but tensors and ordered
    dictionaries, and calls nothing else.

    Raises:
        InputError: no such file, or one that holds anything else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            program = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
            return _Unpickler(archive, program).load()
    except FileNotFoundError as error:
        raise InputError("policy", value=path, rule="must be a file that exists") from error
    except Exception as error:  # a damaged file ends in errors of many types
        raise InputError("policy", value=path, rule=f"must be a file of torch.save ({error})") from error


class _Unpickler(pickle.Unpickler):
    """Reader of the pickle ``program`` in an archive, whose numbers lie beside it."""

    def __init__(self, archive: zipfile.ZipFile, program: str) -> None:
        super().__init__(io.BytesIO(archive.read(program)))
        self._archive, self._folder = archive, program.removesuffix("data.pkl") + "data/"

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        raise pickle.UnpicklingError(f"it names {module}.{name}")

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, dtype, key, _, count = pid
        name = f"{self._folder}{int(key)}"
        if kind != "storage" or self._archive.getinfo(name).file_size > _MOST_BYTES:
            raise pickle.UnpicklingError(f"it has a {kind} that is no array of numbers, or too large a one")
        return np.frombuffer(self._archive.read(name), np.dtype(dtype).newbyteorder("<"), count)


def _tensor(storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
    """Tensor of a storage, with its strides in elements; outside of the storage an error."""
    index = np.full(size, offset, np.int64)
    for axis, (count, step) in enumerate(zip(size, stride, strict=True)):
        index += (step * np.arange(count)).reshape((-1, *(1 for _ in size[axis + 1 :])))
    return storage[index]
