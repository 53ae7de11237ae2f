from .environment_models import Variation as Variation
from .scene_camera import SceneCamera as SceneCamera
from .world import TactileWorld as TactileWorld
from .world_state import WorldState as WorldState
