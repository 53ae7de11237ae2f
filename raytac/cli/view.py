"""``raytac view``: a scene in the browser."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated

import tyro

from raytac.errors import InputError
from raytac.io.options import DeviceName, parse_resolution
from raytac.markers import MARKER_MODELS
from raytac.physics.solver import check_solver, hush_solver
from raytac.sensor import OPTICS, PADS, PHYSICS, TactileSensor
from raytac.specs import PressScene, load_press

__all__ = ["ViewArgs"]


@dataclass(frozen=True, kw_only=True)
class ViewArgs:
    """Show a scene in the browser: 3-D view, tactile image, play, pause and step, and sliders that press; needs raytac[view].

    Prints the address to open and serves until Ctrl-C. On another machine: ssh -L 8080:127.0.0.1:8080 HOST, then open
    http://127.0.0.1:8080 here.
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped press scene, such as sphere, or path of a scene file."""
    sensor: str = "gelsight_mini"
    """Name of a shipped sensor, or path of a sensor file."""
    physics: Annotated[str | None, tyro.conf.arg(metavar="{" + ",".join(PHYSICS) + "}")] = None
    """How the gel deforms: rigid (by geometry and Gaussians) or ipc (simulated; needs raytac[ipc]); as the scene says if not given, else
    rigid."""
    pad: Annotated[str | None, tyro.conf.arg(metavar="{" + ",".join(PADS) + "}")] = None
    """How finely a simulated pad is cut, so that physics is ipc if not given; as the scene says if not given, else coarse."""
    optics: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(OPTICS) + "}")] = "raytrace"
    """How images are made: raytrace, taxim (a table, baked at first use: minutes) or phong."""
    markers: Annotated[str | None, tyro.conf.arg(metavar="{" + ",".join(MARKER_MODELS) + "}")] = None
    """How the sensor's markers move; the sensor must have markers, as gelsight_mini_7x9 has. None if not given."""
    resolution: str = "320x240"
    """WIDTHxHEIGHT of the tactile image in pixels."""
    host: str = "127.0.0.1"
    """Address to serve at. Whoever can reach it can move the sliders: 127.0.0.1 is this machine only, 0.0.0.0 everyone."""
    port: int = 8080
    """Port to serve at; 0 takes any that is free."""
    device: DeviceName = "auto"
    """Where to compute; auto is CUDA if it works, else the CPU."""
    seed: int = 0
    """Seed of every random number. In [0, 2^32)."""
    verbose: bool = False
    """Let Warp, on which the contact solver runs, list devices and the kernels that it loads."""

    def run(self) -> int:
        from raytac.view.viewer import Viewer, check_address, check_viewer

        check_viewer()
        check_address(self.host, self.port)
        if self.optics not in OPTICS:
            raise InputError("optics", value=self.optics, rule="must be a known name", choices=OPTICS)
        scene = load_press(self.scene)
        session = self._press(scene)
        with Viewer(session, host=self.host, port=self.port) as viewer:
            print(f"raytac: {session.title}")
            print(
                f"raytac: open {viewer.url} (elsewhere: ssh -L {viewer.port}:127.0.0.1:{viewer.port} HOST); Ctrl-C ends",
                flush=True,
            )
            try:
                while True:
                    time.sleep(3600.0)
            except KeyboardInterrupt:
                print("raytac: viewer closed")
        return 0

    def _press(self, scene: PressScene):
        from raytac.view.press_session import PressSession

        physics = self.physics or ("ipc" if self.pad is not None else scene.physics or "rigid")
        if physics == "ipc":
            check_solver("physics='ipc'")
            if not self.verbose:
                hush_solver()
        sensor = TactileSensor(
            self.sensor,
            physics=physics,
            pad=self.pad or scene.pad if physics == "ipc" else self.pad,
            optics=self.optics,
            outputs=("rgb", "wrench", "traction"),
            resolution=parse_resolution(self.resolution),
            device=self.device,
            seed=self.seed,
            markers=self.markers,
        )
        return PressSession(sensor, scene)
