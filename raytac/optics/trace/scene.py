"""The Mitsuba scene of a sensor, loaded once; then only vertices and LED powers change.

Repeated ``load_dict`` leaks memory (mitsuba3 #1890), so a process builds this once a sensor. This is the only file that touches
mesh parameters, whose names change in Mitsuba 3.10.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import PadGrid
from raytac.optics.ink import inked_albedo
from raytac.optics.refraction import Slab
from raytac.optics.trace.led import PLUGIN, Lamp, lobe_gain
from raytac.specs.sensor import CoatSpec, LedSpec, SensorSpec

UNIT = 1e3
"""Scene units per metre: millimetres, since Mitsuba starts secondary rays 9e-5 units off.
In metres that (``offset_p``) is 0.09 mm, more than a pixel on the pad."""

PLATES = ("wall_left", "wall_right", "wall_top", "wall_bottom", "floor")
"""The rectangles of the case: its walls at −x, x, −y and y, and its floor."""


def coat_bsdf(coat: CoatSpec, *, dotted: bool = False) -> dict[str, Any]:
    """Mitsuba's dictionary of the coat: Lambertian, blended with a rough perfect conductor.

    The blend gives f = (1 − s) ρ / π + s · D G / (4 cos θ_i cos θ_o), the same f that the fast integrator evaluates. With ``dotted``, ρ
    is the mesh's attribute ``vertex_albedo``.
    """
    plain = {"type": "rgb", "value": list(coat.reflectance)}
    diffuse = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_albedo"} if dotted else plain}
    if coat.specular == 0:
        return diffuse
    mirror = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": coat.roughness}
    return {"type": "blendbsdf", "weight": coat.specular, "first": diffuse, "second": mirror}


def grid_faces(nx: int, ny: int) -> np.ndarray:
    """Triangles (2 (nx−1) (ny−1), 3) over nodes in row order, normals to −z, x right, y down."""
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)[None, :]).ravel()
    lower = np.stack([corner, corner + nx, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + nx, corner + nx + 1], axis=1)
    return np.stack([lower, upper], axis=1).reshape(-1, 3).astype(np.uint32)


class SensorScene:
    """One sensor's geometry and lights in Mitsuba; ``set_surface`` and ``set_layers`` change it."""

    def __init__(self, mi: Any, sensor: SensorSpec, grid: PadGrid, *, glass: bool = False) -> None:
        """``grid``: nodes of the coat mesh [m], which starts at rest.

        ``glass`` puts the slab's face into the scene as a dielectric rectangle, for Mitsuba's integrators; ours take it in formulas.
        """
        self.mi, self.sensor, self.grid = mi, sensor, grid
        ny, nx = grid.shape
        self._dotted = sensor.markers.rows > 0
        x, y = np.meshgrid(grid.x, grid.y)
        self._xy = (UNIT * np.stack([x.ravel(), y.ravel()], axis=1)).astype(np.float32)
        scene: dict[str, Any] = {"type": "scene", "coat": self._coat_mesh(grid_faces(nx, ny))}
        self.slab = Slab.from_spec(sensor, UNIT)
        self._glowing = any(led.glow for led in sensor.lights.leds)
        scene.update(self._case())
        if glass and self.slab is not None:
            scene["glass"] = self._glass(self.slab)
        for index, spec in enumerate(sensor.lights.leds):
            scene[f"led_{index}"] = self._led(spec)
        # Without this, Mitsuba merges equal LEDs into one emitter and then finds it attached to two shapes.
        self.scene = mi.load_dict(scene, optimize=False)
        self.params = mi.traverse(self.scene)
        shapes = {shape.id(): shape for shape in self.scene.shapes()}
        self._coat = mi.ShapePtr(shapes["coat"])
        self._coat_bsdf = shapes["coat"].bsdf()
        self._leds = [mi.ShapePtr(shapes[f"led_{k}"]) for k in range(len(sensor.lights.leds))]
        # Opaque, or their addresses become constants of the kernels, which then compile again for every scene.
        dr.make_opaque(self._coat, *self._leds)
        self._context = mi.BSDFContext()

    def _coat_mesh(self, faces: np.ndarray) -> Any:
        mi = self.mi
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(coat_bsdf(self.sensor.coat, dotted=self._dotted))
        mesh = mi.Mesh("coat", len(self._xy), len(faces), has_vertex_normals=True, props=props)
        self._shown = {"vertex_positions": self._vertices(self.grid.rest)}
        """Present values of the coat's nodes."""
        if self._dotted:
            self._shown["vertex_albedo"] = self._albedo(None)
            mesh.add_attribute("vertex_albedo", 3, self._shown["vertex_albedo"])
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(self._shown["vertex_positions"])
        params["faces"] = mi.UInt32(faces.ravel())
        params.update()
        return mesh

    def _case(self) -> dict[str, Any]:
        """Four walls from the gel plane down to the floor, and the floor; inner sides diffuse."""
        T = self.mi.ScalarTransform4f
        case = self.sensor.case
        hx, hy, depth = UNIT * case.size[0] / 2, UNIT * case.size[1] / 2, -UNIT * case.floor_z
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [case.reflectance] * 3}}

        def plate(origin: Sequence[float], normal: Sequence[float], half: Sequence[float], up: Sequence[float]) -> dict[str, Any]:
            target = [o + n for o, n in zip(origin, normal, strict=True)]
            frame = T().look_at(origin=list(origin), target=target, up=list(up))
            rectangle = {"type": "rectangle", "to_world": frame @ T().scale([half[0], half[1], 1]), "bsdf": bsdf}
            if self._glowing:  # for Mitsuba's own integrators; ours take it from the lamps
                rectangle["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": self._glow(None)}}
            return rectangle

        walls = (((-1, 0), hy), ((1, 0), hy), ((0, -1), hx), ((0, 1), hx))
        plates = [plate((x * hx, y * hy, -depth / 2), (-x, -y, 0), (half, depth / 2), (0, 0, 1)) for (x, y), half in walls]
        return dict(zip(PLATES, [*plates, plate((0, 0, -depth), (0, 0, 1), (hx, hy), (0, 1, 0))], strict=True))

    def _glass(self, slab: Slab) -> dict[str, Any]:
        """The slab's face; its normal points to the air, −z, so that the gel is the interior."""
        T = self.mi.ScalarTransform4f
        hx, hy = (UNIT * s / 2 for s in self.sensor.case.size)
        frame = T().look_at(origin=[0, 0, slab.z], target=[0, 0, slab.z - 1], up=[0, 1, 0])
        bsdf = {"type": "dielectric", "int_ior": slab.ior, "ext_ior": 1.0}
        return {"type": "rectangle", "to_world": frame @ T().scale([hx, hy, 1]), "bsdf": bsdf}

    def _led(self, led: LedSpec) -> dict[str, Any]:
        T = self.mi.ScalarTransform4f
        u, v = np.array(led.edges)
        to_world = np.eye(4)
        to_world[:3, 0], to_world[:3, 1] = 0.5 * UNIT * led.size[0] * u, 0.5 * UNIT * led.size[1] * v
        to_world[:3, 2], to_world[:3, 3] = led.axis, UNIT * np.asarray(led.position)
        area = led.size[0] * led.size[1]
        return {
            "type": "rectangle",
            "to_world": T(to_world),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}},
            "emitter": {"type": PLUGIN, "radiance": [p / area for p in led.power], "lobe": led.lobe},
        }

    def _glow(self, leds: Sequence[str] | None) -> list[float]:
        """Even radiance of walls and floor (RGB) while the LEDs of these names (None: all) are lit."""
        lit = [led for led in self.sensor.lights.leds if leds is None or led.name in leds]
        return [float(sum(led.glow * led.power[c] for led in lit)) for c in range(3)]

    def _vertices(self, height: np.ndarray) -> np.ndarray:
        z = UNIT * np.asarray(height, dtype=np.float32).reshape(-1, 1)
        return np.concatenate([self._xy, z], axis=1).ravel().astype(np.float32)

    def _albedo(self, ink: np.ndarray | None) -> np.ndarray:
        """Diffuse albedo of every node and channel, flat, under ``ink`` (Ny, Nx)."""
        share = np.zeros(self.grid.shape, np.float32) if ink is None else ink
        return np.stack(inked_albedo(self.sensor, share), axis=-1).astype(np.float32).ravel()

    def set_surface(self, height: np.ndarray, ink: np.ndarray | None = None) -> None:
        """Move the coat's nodes to ``height`` (Ny, Nx) [m], with the share ``ink`` of dots.

        Where they are there already, the hierarchy of the scene is not built again.
        """
        moved = {"vertex_positions": self._vertices(height)}
        if self._dotted:
            moved["vertex_albedo"] = self._albedo(ink)
        moved = {name: values for name, values in moved.items() if not np.array_equal(values, self._shown[name])}
        for name, values in moved.items():
            self.params[f"coat.{name}"] = self.mi.Float(values)
        if moved:
            self.params.update()
            self._shown |= moved

    def height_at(self, x: Any, y: Any) -> Any:
        """z of the coat mesh at device points x, y, in scene units, by a ray along +z."""
        mi = self.mi
        below = -UNIT * self.sensor.gelpad.thickness
        hit = self.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(x, y, below), mi.Vector3f(0, 0, 1)))
        return dr.select(hit.is_valid(), below + hit.t, 0)

    def set_layers(self, leds: Sequence[str] | None = None) -> None:
        """Light only the LEDs of these names (None: all)."""
        for k, led in enumerate(self.sensor.lights.leds):
            lit = leds is None or led.name in leds
            area = led.size[0] * led.size[1]
            self.params[f"led_{k}.emitter.radiance"] = self.mi.Color3f([p / area if lit else 0.0 for p in led.power])
        if self._glowing:
            for plate in PLATES:
                self.params[f"{plate}.emitter.radiance.value"] = self.mi.Color3f(self._glow(leds))
        self.params.update()

    def reflect(self, si: Any, wo: Any) -> Any:
        """f(wi, wo) cos θ_o (RGB) of coat, wall or LED (0); faster than by Mitsuba's virtual calls."""
        mi = self.mi
        coat = self._coat_bsdf.eval(self._context, si, wo)
        wall = mi.Color3f(self.case_albedo(si) / dr.pi * dr.maximum(wo.z, 0))
        return dr.select(si.shape == self._coat, coat, dr.select(si.wi.z > 0, wall, 0))

    def sample_reflection(self, si: Any, choice: Any, square: Any) -> tuple[Any, Any]:
        """Direction ``wo`` (local) sampled from the hit material and its weight f cos θ / pdf (RGB)."""
        mi = self.mi
        sample, weight = self._coat_bsdf.sample(self._context, si, choice, square)
        cosine = mi.warp.square_to_cosine_hemisphere(square)
        wall = mi.Color3f(dr.select(si.wi.z > 0, self.case_albedo(si), 0))
        on_coat = si.shape == self._coat
        return dr.select(on_coat, sample.wo, cosine), dr.select(on_coat, weight, wall)

    def led_radiance(self, si: Any, index: int, lamp: Lamp) -> Any:
        """Radiance (RGB) of LED ``index`` (``lamp`` in scene units) back along the ray to ``si``."""
        area = 4 * dr.norm(lamp.half_u) * dr.norm(lamp.half_v)
        front = (si.shape == self._leds[index]) & (si.wi.z > 0)
        lobe = lobe_gain(dr, si.wi.z, lamp.lobe - 1)
        return lamp.power * dr.select(front, lobe / area, 0)

    def on_coat(self, si: Any) -> Any:
        return si.shape == self._coat

    def on_case(self, si: Any) -> Any:
        """True if ``si`` lies on the inner side of a wall or the floor."""
        case = si.is_valid() & (si.wi.z > 0)
        for other in (self._coat, *self._leds):
            case &= si.shape != other
        return case

    def case_albedo(self, si: Any) -> Any:
        """Albedo of wall or floor at ``si``; 0 on the coat and on LEDs."""
        albedo = self.mi.Float(self.sensor.case.reflectance)
        for other in (self._coat, *self._leds):
            albedo = dr.select(si.shape == other, 0, albedo)
        return albedo
