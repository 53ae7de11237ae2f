"""``raytac view``: a scene in the browser."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import raytac
from raytac.checks import check_known, check_whole
from raytac.cli.shared import ShadowOptions, chosen_physics, named
from raytac.errors import InputError
from raytac.io.options import DeviceName, parse_names, parse_resolution
from raytac.markers import MARKERS
from raytac.observe import ObservationSettings
from raytac.optics import OPTICS
from raytac.physics import PHYSICS, PhysicsConfig
from raytac.sensor import TactileSensor
from raytac.specs import PADS, PressScene, TaskScene, available, load_scene, load_sensor
from raytac.specs.sensor_file import sensor_spec
from raytac.specs.task import COUPLINGS
from raytac.warp_messages import quiet_warp

if TYPE_CHECKING:
    from raytac.specs.sensor import SensorSpec
    from raytac.view.session import Session, SessionMenu

_OUTPUTS = ("rgb", "wrench", "traction", "normals")
_LONGEST = 320
"""Side of a tactile image [px] that is drawn quickly and large enough to be seen."""


@dataclass(frozen=True, kw_only=True)
class ViewArgs(ShadowOptions):
    """Show a scene in the browser: 3-D view, tactile images, and sliders that press or steer.

    Needs raytac[view]. Prints the address to open and serves until Ctrl-C. On another machine: ssh -L 8080:127.0.0.1:8080 HOST, then
    open http://127.0.0.1:8080 here.
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped press or task, such as sphere or lift_cube, or path of a scene file.

    A recording (.npz) that the page has saved, the folder of a data set, and a policy (.pt, or a shipped one's name, as lift_cube_ppo) are
    played. With --policy: a task's name, as LiftCube."""
    policy: Annotated[str | None, named(("scripted",))] = None
    """Policy that plays the task SCENE: scripted, which is written by hand."""
    sensor: str | None = None
    """Name of a shipped sensor, or path of a file; the task's, or gelsight_mini, if not given."""
    physics: Annotated[str | None, named(PHYSICS.names)] = None
    """Model of the gel: rigid or ipc (finite elements); as the scene says, else rigid."""
    level: Annotated[str | None, named(PADS)] = None
    """Resolution of a soft pad's mesh, makes physics ipc; as the scene says, else coarse."""
    optics: Annotated[str, named(OPTICS.names)] = "raytrace"
    """Optical mode: raytrace, taxim (a table, baked at first use: minutes) or phong."""
    markers: Annotated[str | None, named(MARKERS.names)] = None
    """Model that moves markers, of a sensor that has some, as gelsight_mini_7x9."""
    coupling: Annotated[str | None, named(COUPLINGS)] = None
    """Coupling of soft pads to the robot, two_way if forces act back; else as the task says."""
    steps: int | None = None
    """Control steps from one shown state to the next; 1, or 4 with rigid pads without markers."""
    resolution: str | None = None
    """WIDTHxHEIGHT of the tactile image [px]; the sensor's, scaled to at most 320, if not given."""
    out: Path = Path("runs/view")
    """Folder that the page's buttons save to; nothing is written before."""
    host: str = "127.0.0.1"
    """Address to serve at: 127.0.0.1 is this machine, 0.0.0.0 lets everyone move the sliders."""
    allow_host: str | None = None
    """Names that browsers may open the page by beside the addresses, joined by commas.

    As gpu3.example.org, or NAME:PORT where something forwards another port. All other names are refused."""
    port: int = 8080
    """Port to serve at; 0 takes any that is free."""
    device: DeviceName = "auto"
    """Device that computes; auto is CUDA if it works, else the CPU."""
    seed: int = 0
    """Seed of every random number. In [0, 2^32)."""
    verbose: bool = False
    """Let Warp, on which the contact solver runs, list devices and the kernels that it loads."""

    def run(self) -> int:
        from raytac.view.availability import check_viewer

        check_viewer()
        from raytac.view.viewer import Viewer, check_address

        allowed = () if self.allow_host is None else parse_names(self.allow_host, "allow_host")
        check_address(self.host, self.port, allowed)
        OPTICS.config(self.optics, **self.chosen_shadows())
        session, menu = self._played(), None
        if session is None:
            scene = load_scene(self.scene)
            physics = chosen_physics(self.physics, self.level, scene)
            quiet_warp(not self.verbose)
            session = self._press(scene, physics) if isinstance(scene, PressScene) else self._task(scene, physics)
            menu = self._menu(scene)
        serving = {"folder": self.out, "host": self.host, "port": self.port, "allow_hosts": allowed}
        with Viewer(session, menu=menu, **serving) as viewer:
            print(f"raytac: {session.title}")
            elsewhere = f"elsewhere: ssh -L {viewer.port}:127.0.0.1:{viewer.port} HOST"
            print(f"raytac: open {viewer.url} ({elsewhere}); Ctrl-C ends", flush=True)
            try:
                while True:
                    time.sleep(3600.0)
            except KeyboardInterrupt:
                print("raytac: viewer closed")
        return 0

    def _played(self) -> Session | None:
        """Session of a recording, a data set or a policy; None of a scene."""
        path = _shipped_policy(self.scene) or Path(self.scene)
        is_policy = self.policy is not None or path.suffix == ".pt"
        if not is_policy and path.suffix != ".npz" and not (path.is_dir() and (path / "dataset.json").exists()):
            return None
        own = {
            "sensor": self.sensor,
            "level": self.level,
            "markers": self.markers,
            "coupling": self.coupling,
            "steps": self.steps,
        }
        own |= {} if is_policy else {"physics": self.physics, "resolution": self.resolution}
        for name, value in own.items():
            if value is not None:
                raise InputError(name, value=value, rule=f"is a setting of scenes; {self.scene!r} is played as it is")
        if path.suffix == ".npz":
            from raytac.view.recording import read_recording

            return read_recording(path)
        from raytac.cli.played import dataset_session, policy_session, scripted_session

        if not is_policy:
            return dataset_session(path)
        if self.policy is not None:
            check_known("policy", self.policy, ("scripted",))
        quiet_warp(not self.verbose)
        resolution = (_LONGEST, _LONGEST * 3 // 4) if self.resolution is None else parse_resolution(self.resolution)
        optics = OPTICS.config(self.optics, **self.chosen_shadows())
        shown = ObservationSettings(("rgb", "markers", "wrench"), resolution=resolution, optics=optics)
        settings = {"shown": shown, "device": self.device, "physics": self.physics}
        return scripted_session(self.scene, **settings) if path.suffix != ".pt" else policy_session(path, **settings)

    def _menu(self, scene: PressScene | TaskScene) -> SessionMenu:
        """Drop-downs of what is shipped and fits ``--markers``, and of what was named beside."""
        from raytac.view.session import SessionMenu

        kind, label = ("press scene", "object") if isinstance(scene, PressScene) else ("task scene", "task")
        sensor = self.sensor or ("gelsight_mini" if isinstance(scene, PressScene) else scene.robot.sensor)
        chosen = {label: self.scene, "sensor": str(sensor)}
        sensors = [name for name in available("sensor") if self.markers is None or load_sensor(name).markers.rows]
        shipped = {label: available(kind), "sensor": sensors}
        options = {name: tuple(dict.fromkeys((*names, chosen[name]))) for name, names in shipped.items()}
        return SessionMenu(options, chosen, lambda choice: self._session_of(choice[label], choice["sensor"]))

    def _session_of(self, scene: str, sensor: str) -> Session:
        """Session of another choice in the page; everything else is as on the command line."""
        loaded = load_scene(scene)
        physics = chosen_physics(self.physics, self.level, loaded)
        args = replace(self, scene=scene, sensor=sensor)
        return args._press(loaded, physics) if isinstance(loaded, PressScene) else args._task(loaded, physics)

    def _press(self, scene: PressScene, physics: PhysicsConfig) -> Session:
        from raytac.view.press_session import PressSession

        for name, value in (("coupling", self.coupling), ("steps", self.steps)):
            if value is not None:
                raise InputError(name, value=value, rule=f"is a setting of tasks; {scene.name!r} is a press")
        spec = sensor_spec(self.sensor or "gelsight_mini")
        return PressSession(TactileSensor(spec, physics=physics, **self._settings(spec)), scene)

    def _task(self, scene: TaskScene, physics: PhysicsConfig) -> Session:
        from raytac.view.world_session import WorldSession
        from raytac.world.world import TactileWorld

        if self.steps is not None:
            check_whole("steps", self.steps)
        if self.sensor is not None:
            scene = replace(scene, robot=replace(scene.robot, sensor=self.sensor))
        settings = self._settings(sensor_spec(scene.robot.sensor))
        world = TactileWorld(scene, physics=physics, coupling=self.coupling, **settings)
        return WorldSession(world, steps=self.steps or (4 if not physics.is_simulated and self.markers is None else 1))

    def _settings(self, sensor: SensorSpec) -> dict[str, Any]:
        return {
            "optics": OPTICS.config(self.optics, **self.chosen_shadows()),
            "markers": self.markers,
            "resolution": _fitting(sensor.camera.resolution) if self.resolution is None else parse_resolution(self.resolution),
            "device": self.device,
            "outputs": _OUTPUTS,
            "seed": self.seed,
        }


def _fitting(resolution: tuple[int, int]) -> tuple[int, int]:
    """(width, height) [px] of the same shape, of at most ``_LONGEST`` a side."""
    scale = min(1.0, _LONGEST / max(resolution))
    width, height = (max(1, round(scale * side)) for side in resolution)
    return width, height


def _shipped_policy(name: str) -> Path | None:
    """File of a shipped policy; None for another name. ``BackendError`` without ``envs``."""
    if name not in {path.stem for path in (Path(raytac.__file__).parent / "learn" / "policies").glob("*.pt")}:
        return None  # before the import, which needs Gymnasium
    from raytac.learn.policies import shipped_policies

    return shipped_policies().get(name)
