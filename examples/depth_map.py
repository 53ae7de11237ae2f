"""How do I turn another simulator's depth map into this sensor's image, without its gel?

python examples/depth_map.py
"""

import numpy as np

import raytac

sensor = raytac.TactileSensor("gelsight_mini", outputs=("rgb", "depth"), resolution=(160, 120))

# A rigid-body simulator's orthographic camera behind the gel: 160 x 120 pixels over the sensor's view [m].
px, py = sensor.spec.camera.pitch_at((160, 120))
x, y = px * (np.arange(160) - 79.5), py * (np.arange(120)[:, None] - 59.5)


def underside(radius: float, depth: float, at: tuple[float, float]) -> np.ndarray:
    """Heights of a ball over the pad frame's z = 0, as that camera sees them."""
    across = (x - at[0]) ** 2 + (y - at[1]) ** 2
    return radius - depth - np.sqrt(np.maximum(radius**2 - across, 0.0))


rest = raytac.gel.rest_height(sensor.spec.gelpad, x, y)  # the dome
balls = [underside(4e-3, 0.5e-3, (-3e-3, 0.0)), underside(2e-3, 0.4e-3, (3e-3, 2e-3))]
overlap = np.stack([np.minimum(ball - rest, 0.0) for ball in balls])  # how far each reaches below the resting gel

frame = sensor.render(overlap, overlap=True)  # the gel gives way around the ball
bare = sensor.render(overlap)  # the same map taken as the gel itself
for name, one in (("with the gel's surround", frame), ("as it is", bare)):
    changed = np.abs(one.rgb.astype(int) - sensor.rest().rgb).max(axis=-1) > 4
    print(f"{name}: the ball changes", changed.mean(axis=(1, 2)).round(3), "of the image")
