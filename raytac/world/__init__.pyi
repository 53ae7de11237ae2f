from .environment_models import Variation as Variation
from .pad_stepper import PadStepper as PadStepper
from .pads import WORLD_PADS as WORLD_PADS
from .pads import WorldPads as WorldPads
from .scene_camera import SceneCamera as SceneCamera
from .tactile_reader import TactileReader as TactileReader
from .world import TactileWorld as TactileWorld
from .world_state import WorldState as WorldState
