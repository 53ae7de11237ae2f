"""How like the ray tracer's images are those of a small U-Net, and how fast? Renders presses, fits the network, tests it on others.

    python experiments/train_unet.py --out runs/unet                                       # a GPU: some minutes
    python experiments/train_unet.py --count 60 --steps 30 --widths 4,8 --device cpu --out runs/unet_small
    python experiments/train_unet.py --network scenes/networks/gelsight_mini_unet.npz --device cpu --out runs/unet_shipped

The presses are those of a sweep (``network`` by default, docs/guide/data-sets.md), rendered in memory. Only the network is stored. Every
tenth press is held out, and the presses of ``--unseen`` are of an object that the sweep does not have. ``--network`` tests a network that
is there already: on as many presses of the sweep as would be held out, drawn with another seed, and on the unseen object.

Adam with a cosine from ``--rate`` lowers the mean of |error|, in which contacts and 2 mm around them count ``--emphasis`` times.

``unet.npz`` is the network, for ``optics=Unet(weights=…)``. ``metrics.json``: ``unet.<set>.<region>_mae`` [levels of 255] with the sets
``held_out`` and ``unseen`` and the regions ``contact``, ``ring`` (2 mm around) and ``frame``, beside ``none.…``, the image at rest;
``unet.ms`` and ``raytrace.ms``, medians of an image from the host's heights to the host, one at a time; ``unet.kilobytes``.
"""

# pyright: reportMissingImports=false
# (The tests do without PyTorch.)

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.running import recorded, run
from raytac.checks import check_whole
from raytac.dataset import DatasetPlan, RenderJob, ShardRenderer
from raytac.device import resolve_device
from raytac.errors import BackendError, InputError
from raytac.gel import GelSurface, PadGrid
from raytac.io import CommonOptions, Progress
from raytac.optics import RayTraced, Unet, UnetMode, UnetWeights, load_unet, look_digest, new_unet, save_unet, view_size
from raytac.specs import SweepSpec, load_press, load_sweep

HELD_OUT = 10
"""One press of so many is held out."""
RING = 2e-3
"""Width of the ring around contacts [m], as in ``raytac compare``."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Fit a U-Net to ray-traced presses."""

    sweep: str = "network"
    """Name of a shipped sweep, or path of a sweep file."""
    count: int | None = None
    """Number of presses; the sweep's if not given."""
    network: Path | None = None
    """File of a network to test; nothing is fitted then."""
    unseen: str = "mesh"
    """Press scene whose object is only tested on, with a tenth of the sweep's presses."""
    widths: str = "12,24,36,48,64"
    """Channels at every level, the finest first, joined by commas."""
    steps: int = 8000
    """Steps of Adam."""
    batch: int = 16
    """Presses of a step."""
    rate: float = 2e-3
    """First step size; it falls to 0 by a cosine."""
    emphasis: float = 5.0
    """Weight of pixels in or near a contact over that of others."""


@dataclass(frozen=True)
class Presses:
    """Surfaces and ray-traced images of N presses of one sensor."""

    height: np.ndarray
    """(N, Ny, Nx) [m]."""
    contact: np.ndarray
    rgb: np.ndarray
    """(N, H, W, 3) uint8."""

    def __len__(self) -> int:
        return len(self.rgb)

    def rows(self, which: np.ndarray | slice) -> Presses:
        """Some of the presses."""
        return Presses(self.height[which], self.contact[which], self.rgb[which])

    def surface(self, grid: PadGrid) -> GelSurface:
        """The surfaces of all presses."""
        return GelSurface(grid, self.height, self.contact, np.full((len(self), 2), np.nan))


def rendered(sweep: SweepSpec, device: str) -> Presses:
    """All sound presses of ``sweep``."""
    plan = DatasetPlan(sweep)
    renderer, parts = ShardRenderer(RenderJob(plan, device, 64 if device == "cuda" else 8)), []
    for shard in Progress(range(plan.shards), desc="presses", unit="shard"):
        arrays = renderer.render(shard).arrays
        if arrays:
            parts.append([arrays[name] for name in ("height", "contact", "rgb")])
    return Presses(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def regions(contact: np.ndarray, reach: int) -> dict[str, np.ndarray]:
    """Masks (N, H, W) of pixels: in contact, at most ``reach`` pixels from one, all."""
    from scipy.ndimage import maximum_filter

    wide = maximum_filter(contact, (1, 2 * reach + 1, 2 * reach + 1))
    return {"contact": contact, "ring": wide & ~contact, "frame": np.ones_like(contact)}


def seen(mode: UnetMode, presses: Presses, grid: PadGrid) -> Any:
    """Maps (N, 4, H, W) that the network sees, a tensor in half precision on its device."""
    import torch

    return torch.cat([mode.maps(presses.rows(slice(k, k + 64)).surface(grid)).half() for k in range(0, len(presses), 64)])


def trained(network: Any, maps: Any, presses: Presses, rest: np.ndarray, args: Args, reach: int) -> None:
    """Fit ``network`` to the presses, whose image at rest is ``rest`` (H, W, 3)."""
    import torch

    device, draws = maps.device, torch.Generator().manual_seed(args.seed)
    optimizer = torch.optim.Adam(network.parameters(), args.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
    images = torch.from_numpy(presses.rgb)
    background, still = torch.from_numpy(rest).to(device).float(), torch.zeros_like(maps[:1]).float()
    progress = Progress(range(args.steps), desc="fit", unit="step")
    for _ in progress:
        rows = torch.randint(len(maps), (args.batch,), generator=draws)
        seen = maps[rows.to(device)].float()
        change = (images[rows].to(device).float() - background).permute(0, 3, 1, 2)
        near = torch.nn.functional.max_pool2d(seen[:, 3:], 2 * reach + 1, 1, reach)
        weight = 1 + (args.emphasis - 1) * near
        loss = (weight * (network(seen) - network(still) - change).abs()).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 100.0)
        optimizer.step()
        schedule.step()
        if progress.n % 100 == 0:
            progress.set_postfix_str(f"loss {float(loss.detach()):.2f} levels", refresh=False)


def errors(mode: UnetMode, presses: Presses, grid: PadGrid, rest: np.ndarray, reach: int) -> dict[str, float]:
    """Mean absolute errors [levels] by region, of the network and of the image at rest."""
    sums: dict[str, list[float]] = {}
    for k in range(0, len(presses), 32):
        part = presses.rows(slice(k, k + 32))
        surface = part.surface(grid)
        rgb = mode.render(surface).rgb
        assert rgb is not None
        masks = regions(mode.maps(surface)[:, 3].cpu().numpy() > 0, reach)
        for name, image in (("unet", rgb), ("none", np.broadcast_to(rest, rgb.shape))):
            off = np.abs(image.astype(int) - part.rgb).mean(-1)
            for region, mask in masks.items():
                total = sums.setdefault(f"{name}.{{}}.{region}_mae", [0.0, 0.0])
                total[0] += float(off[mask].sum())
                total[1] += float(mask.sum())
    return {key: total / max(count, 1.0) for key, (total, count) in sums.items()}


def milliseconds(mode: Any, surface: GelSurface, repeats: int = 30) -> float:
    """Median time of an image, everything compiled, from and to the host [ms]."""
    times = []
    for _ in range(repeats + 3):
        began = time.perf_counter()
        mode.render(surface)
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times[3:]))


def fitted(
    sweep: SweepSpec, presses: Presses, rest: np.ndarray, args: Args, reach: int, device: str, metrics: dict[str, Any]
) -> UnetWeights:
    """A network fitted to ``presses``, whose image at rest is ``rest`` (H, W, 3); adds what the fit took to ``metrics``."""
    widths = _widths(args.widths)
    sensor, plan = sweep.sensors[0], DatasetPlan(sweep)
    network = new_unet(widths, device)
    provenance = {"source": "ray-traced presses", "sensor": sensor.name, "look": look_digest(sensor)}
    provenance |= {"sweep": args.sweep, "presses": str(len(presses)), "steps": str(args.steps)}
    weights = UnetWeights(widths, network.layers(), rest, provenance, view_size(sensor))
    mode = Unet(weights=weights).build(sensor, resolution=plan.resolution(sensor), device=device)
    began = time.perf_counter()
    trained(network, seen(mode, presses, plan.grid(sensor)), presses, rest, args, reach)
    metrics |= {"unet.fit_s": time.perf_counter() - began, "presses": len(presses), "steps": args.steps, "batch": args.batch}
    return dataclasses.replace(weights, layers=network.layers())


def _widths(text: str) -> tuple[int, ...]:
    widths = tuple(int(part) if part.isdigit() else 0 for part in text.split(","))
    if min(widths) < 1:
        raise InputError("widths", value=text, rule="must be whole numbers >= 1, joined by commas")
    return widths


def main(args: Args) -> None:
    for name, value in (("steps", args.steps), ("batch", args.batch)):
        check_whole(name, value)
    _widths(args.widths)
    try:
        import torch
    except ImportError as error:
        raise BackendError(f"a U-Net needs PyTorch ({error}): `pip install torch`") from error
    sweep = load_sweep(args.sweep)
    if len(sweep.sensors) != 1 or sweep.optics != "raytrace" or not {"rgb", "height", "contact"} <= set(sweep.outputs):
        rule = "must have one sensor, optics 'raytrace', and rgb, height and contact among its outputs"
        raise InputError("sweep", value=args.sweep, rule=rule)
    if args.count is not None:
        check_whole("count", args.count, HELD_OUT)
        sweep = dataclasses.replace(sweep, count=args.count)
    device = resolve_device(args.device)
    tenth = max(sweep.count // HELD_OUT, 1)
    unseen = dataclasses.replace(sweep, objects=(load_press(args.unseen),), count=tenth, seed=sweep.seed + 1)
    weights = None if args.network is None else load_unet(args.network)
    with recorded(args, "train_unet", device=device, owned=("unet.npz",), packages=("torch",)) as (folder, metrics):
        torch.manual_seed(args.seed)
        sensor, plan = sweep.sensors[0], DatasetPlan(sweep)
        grid, size = plan.grid(sensor), plan.resolution(sensor)
        tracer = RayTraced().build(sensor, resolution=size, device=device)
        rest = tracer.render(GelSurface.at_rest(grid)).rgb
        assert rest is not None
        reach = round(RING / sensor.camera.pitch_at(size)[0])
        if weights is None:
            presses = rendered(sweep, device)
            held_out = np.arange(len(presses)) % HELD_OUT == HELD_OUT - 1
            tested = presses.rows(held_out)
            weights = fitted(sweep, presses.rows(~held_out), rest[0], args, reach, device, metrics)
            save_unet(weights, folder / "unet.npz")
            weights = load_unet(folder / "unet.npz")
        else:
            tested = rendered(dataclasses.replace(sweep, count=tenth, seed=sweep.seed + 2), device)
        mode = Unet(weights=weights).build(sensor, resolution=size, device=device)
        other = rendered(unseen, device)
        for name, part in (("held_out", tested), ("unseen", other)):
            metrics[f"{name}.presses"] = len(part)
            metrics |= {key.format(name): value for key, value in errors(mode, part, grid, rest[0], reach).items()}
        one = other.rows(slice(0, 1)).surface(grid)
        metrics |= {"unet.ms": milliseconds(mode, one), "raytrace.ms": milliseconds(tracer, one)}
        file = folder / "unet.npz" if args.network is None else args.network
        metrics |= {"unet.kilobytes": file.stat().st_size / 1e3, "unet.numbers": sum(a.size for a in weights.layers.values())}
        metrics |= {f"widths.{k}": width for k, width in enumerate(weights.widths)}
        for key, value in metrics.items():
            if key.endswith(("_mae", ".ms", ".kilobytes")):
                print(f"{key:32} {value:8.2f}")


if __name__ == "__main__":
    run(main, Args)
