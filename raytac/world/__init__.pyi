from .pads import WORLD_PADS as WORLD_PADS
from .pads import WorldPads as WorldPads
from .scene_camera import SceneCamera as SceneCamera
from .state import WorldState as WorldState
from .variation import Variation as Variation
from .world import TactileWorld as TactileWorld
