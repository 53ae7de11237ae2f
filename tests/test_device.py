"""The device is chosen once and alike by everything: what the libraries say first, and what a traced ray says last."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from raytac import device
from raytac.device import cuda_missing, resolve_device
from raytac.doctor import PROBES, run_probe
from raytac.errors import BackendError, InputError
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec


def pretend(
    monkeypatch: pytest.MonkeyPatch, *, count: int = 1, optix: str | None = "here", version: tuple[int, int] = (12, 8)
) -> None:
    """A machine with these answers of its driver."""
    monkeypatch.setattr(device, "cuda_device_count", lambda: count)
    monkeypatch.setattr(device, "optix_library", lambda: optix)
    monkeypatch.setattr(device, "cuda_driver_version", lambda: version)


def test_cuda_that_should_work_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch)
    assert cuda_missing() == "" and resolve_device() == resolve_device("cuda") == "cuda" and resolve_device("cpu") == "cpu"


@pytest.mark.parametrize(
    ("machine", "reason"),
    [
        ({"count": 0}, "no NVIDIA driver, or no CUDA device"),
        ({"optix": None}, "brings no OptiX"),
        ({"version": (11, 4)}, r"CUDA 11\.4, and Dr\.Jit needs 12\.2 \(driver R535"),
        ({"version": (12, 7)}, r"CUDA 12\.7 .*refuses"),
    ],
)
def test_what_cuda_lacks_is_told_alike_by_all(
    machine: dict, reason: str, monkeypatch: pytest.MonkeyPatch, sensor_spec: SensorSpec
) -> None:
    pretend(monkeypatch, **machine)
    assert resolve_device() == "cpu"
    with pytest.raises(BackendError, match=f"'cuda' does not work here: .*{reason}"):
        resolve_device("cuda")
    with pytest.raises(BackendError, match=reason):
        TactileSensor(sensor_spec, device="cuda")
    (probe,) = (p for p in PROBES if p.name == "mitsuba-cuda")
    check = run_probe(probe)
    assert not check.ok and check.detail == cuda_missing()


def test_without_ray_tracing_a_device_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, optix=None, version=(11, 8))
    assert resolve_device(ray_tracing=False) == "cuda"


def test_an_unknown_device_is_refused_with_the_choices(sensor_spec: SensorSpec) -> None:
    with pytest.raises(InputError, match="auto, cpu, cuda"):
        TactileSensor(sensor_spec, device="gpu")


_FALLS_BACK = """
import sys, warnings
import raytac.optics.runtime as variant
from raytac.errors import BackendError
variant.resolve_device = lambda device: "cuda" if device == "auto" else device  # the libraries load, and nothing runs
if sys.argv[1] == "cuda":
    try:
        variant.load_mitsuba("cuda")
    except BackendError as error:
        assert "cuda_ad_rgb does not work here: " in str(error) and "raytac doctor" in str(error), error
    else:
        raise SystemExit("a device that does not work was taken")
    mi, device = variant.load_mitsuba("cpu")
else:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        mi, device = variant.load_mitsuba("auto")
    assert ["CUDA does not trace here" in str(w.message) for w in told] == [True], told
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert variant.load_mitsuba("auto") == (mi, "cpu")  # it stays with it, and says nothing twice
assert device == "cpu" and mi.variant() == "llvm_ad_rgb"
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
assert scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))[0]
"""


@pytest.mark.parametrize("asked", ["auto", "cuda"])
def test_cuda_that_loads_and_does_not_trace(asked: str) -> None:
    """``auto`` goes on with the CPU and says so; ``cuda`` is an error, after which the CPU can still be had."""
    env = os.environ | {"DRJIT_LIBCUDA_PATH": "/nowhere/libcuda.so"}
    done = subprocess.run([sys.executable, "-c", _FALLS_BACK, asked], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stdout + done.stderr


class Untraceable:
    """Stands in for Mitsuba where every variant can be set and CUDA does not trace."""

    Ray3f = staticmethod(lambda *args: None)

    def __init__(self) -> None:
        self._variant: str | None = None

    def variant(self) -> str | None:
        return self._variant

    def set_variant(self, variant: str) -> None:
        self._variant = variant

    def load_dict(self, _: dict) -> Untraceable:
        return self

    def ray_test(self, _: object) -> list[bool]:
        return [self._variant != "cuda_ad_rgb"]


@pytest.mark.renderer
def test_a_cuda_that_can_be_set_and_does_not_trace_is_never_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    from raytac.optics import runtime as variant

    monkeypatch.setattr(variant, "_require_llvm", lambda: None)
    mi = Untraceable()
    for _ in range(2):
        with pytest.raises(BackendError, match="cuda_ad_rgb does not work here: a ray missed"):
            variant._started(mi, "cuda", "cuda")
    with pytest.warns(RuntimeWarning, match="CUDA does not trace here"):
        assert variant._started(mi, "auto", "cuda") == "cpu"
    assert mi.variant() == "llvm_ad_rgb" and variant._started(mi, "auto", "cuda") == "cpu"
    with pytest.raises(BackendError, match="already renders with llvm_ad_rgb"):
        variant._started(mi, "cuda", "cuda")
    after_cuda = Untraceable()
    with pytest.raises(BackendError):
        variant._started(after_cuda, "cuda", "cuda")
    assert variant._started(after_cuda, "cpu", "cpu") == "cpu"


def test_an_optix_that_the_user_named_is_the_only_one_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    monkeypatch.setattr(device, "_load", lambda names: tried.append(names))
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", "/nowhere/libnvoptix.so")
    device.optix_library.cache_clear()
    try:
        assert device.optix_library() is None and tried == [("/nowhere/libnvoptix.so",)]  # as Dr.Jit does
    finally:
        device.optix_library.cache_clear()


@pytest.mark.renderer
def test_auto_stays_with_the_device_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    from raytac.optics.runtime import load_mitsuba

    load_mitsuba("cpu")
    monkeypatch.setattr("raytac.optics.runtime.resolve_device", lambda device: "cuda")
    assert load_mitsuba("auto")[1] == "cpu"
