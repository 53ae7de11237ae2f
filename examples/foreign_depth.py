"""How do I make GelSight images of depth maps of Isaac Lab, Genesis, MuJoCo Warp or ManiSkill? Three lines, no copy.

Run: python examples/foreign_depth.py

``depth_maps`` stands for the other simulator: a camera where the sensor's is, which sees a pin that goes into the gel. With
``device="cuda"`` and a tensor of PyTorch, JAX or Warp on the GPU the same lines work there, and the images stay there.
"""

from pathlib import Path

import numpy as np

from raytac.io import write_png
from raytac.observe import DepthCamera, DepthImages, ObservationSettings, TactileObserver

ENVS, SIZE = 4, (320, 240)


def depth_maps(camera: DepthCamera) -> np.ndarray:
    """Depth [m] of a pin with a round end, 0.2 to 0.8 mm deep in the gel, (B, H, W), float32; inf where nothing is."""
    radius, depth = 2e-3, np.linspace(0.2e-3, 0.8e-3, ENVS)
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    ray = np.stack(
        [(u - camera.principal[0]) / camera.focal[0], (v - camera.principal[1]) / camera.focal[1], np.ones_like(u)], -1
    )
    centre = np.stack([np.zeros(ENVS), np.zeros(ENVS), radius - depth], -1) - camera.position
    along, square = ray @ centre.T, (ray**2).sum(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        d = (along - np.sqrt(along**2 - square * ((centre**2).sum(-1) - radius**2))) / square
    return np.ascontiguousarray(np.nan_to_num(d, nan=np.inf).transpose(2, 0, 1), np.float32)


settings = ObservationSettings(("rgb",), resolution=SIZE, optics="raytrace")
camera = DepthCamera.of("gelsight_mini", SIZE)  # put the other simulator's camera there: position, fovy_deg, resolution
print("camera at z = %.1f mm in the pad frame, %.2f degrees high" % (1e3 * camera.position[2], camera.fovy_deg))
depth = depth_maps(camera)

observer = TactileObserver("gelsight_mini", settings, num_envs=ENVS)
images = DepthImages(observer, camera, device="cpu")
rgb = images.observe(depth)["rgb"]  # torch.from_dlpack(rgb) and jax.numpy.from_dlpack(rgb) take it without a copy

shown = np.from_dlpack(rgb)
write_png(Path("foreign_depth.png"), np.concatenate(shown, axis=1))
deepest = (images.grid.rest - images.height.numpy()).max(axis=(1, 2))
print("images %s %s of imprints %s mm deep" % (shown.shape, shown.dtype, np.round(1e3 * deepest, 2)))
